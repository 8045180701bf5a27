# SPDX-License-Identifier: Apache-2.0
"""Rescue of damaged bags: the messages that can be read become an intact bag."""

from __future__ import annotations

import glob
import os
import re
import shutil
import sqlite3
import struct
import tempfile
import zlib
from collections.abc import Callable
from collections.abc import Iterable
from collections.abc import Iterator
from contextlib import closing
from io import BytesIO
from pathlib import Path
from typing import Any
from typing import BinaryIO
from typing import NamedTuple
from typing import TypeAlias

import lz4.frame
import yaml
import zstandard
from mcap.exceptions import EndOfFile
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.records import Channel
from mcap.records import Chunk
from mcap.records import Message
from mcap.records import Schema
from mcap.stream_reader import StreamReader
from mcap.summary import Summary
from rosbags.interfaces import Connection
from rosbags.interfaces import ConnectionExtRosbag2
from rosbags.interfaces import MessageDefinition
from rosbags.interfaces import MessageDefinitionFormat
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer
from rosbags.rosbag2.metadata import parse_qos

from obbhbb_ros.bags.topics import VERSION
from obbhbb_ros.bags.topics import add_topic
from obbhbb_ros.damaged_sqlite import Gap
from obbhbb_ros.damaged_sqlite import lossy_text
from obbhbb_ros.damaged_sqlite import rows_around_damage
from obbhbb_ros.files import read_bounded

_STORAGE_NAME = re.compile(r'.\.(mcap|db3)(\.(.*\.)?zstd)?$')
# Opcode, length, first and last time, size, checksum, length of the compression's name.
_CHUNK_HEAD = struct.Struct('<BQQQQII')
MAX_BYTES = 2**28
"""Maximum size of a record, a chunk or a message that is read, packed or not, bytes."""
MAX_METADATA_BYTES = 2**24
"""Maximum size of a metadata.yaml that is read, bytes."""
# Bytes of a chunk that are decompressed at once.
_PIECE = 256
# What a bag that is decompressed leaves free of a disk, bytes.
_DISK_RESERVE = 2**28
_MCAP_MAGIC = b'\x89MCAP0\r\n'
_RECORD_HEAD = struct.Struct('<BQ')
_ZSTD_MAGIC = b'\x28\xb5\x2f\xfd'
# What reading a damaged table may raise.
_TABLE_ERRORS = (sqlite3.Error, UnicodeError, LookupError)

Report: TypeAlias = Callable[[str], None]


class _Topic(NamedTuple):
    """A topic as a storage file describes it."""

    name: str
    msgtype: str
    encoding: str
    definition: str
    digest: str
    qos: str


def storage_files(source: Path) -> list[Path]:
    """List the storage files of a bag in their order."""
    paths = source.iterdir() if source.is_dir() else [source]
    files = (path for path in paths if path.is_file() and _STORAGE_NAME.search(path.name))
    return sorted(files, key=_parts_of_name)


def _parts_of_name(path: Path) -> list[str | int]:
    """Divide a file name into text and numbers: bag_10.db3 comes after bag_9.db3."""
    parts = re.split(r'(\d+)', path.name)
    return [int(part) if part.isdecimal() else part for part in parts]


def rescue(source: Path, target: Path, report: Report) -> int:
    """
    Write the readable messages of a bag to a new bag, without compression.

    It needs no metadata, no index and not the end of a file.

    Parameters
    ----------
    source : Path
        The bag, or one of its storage files.
    target : Path
        The bag to write.
    report : callable
        Called with a line of text about every loss.

    Returns
    -------
    int
        Number of messages lost, if the metadata tell how many there were; else of losses reported.

    Raises
    ------
    ValueError
        If there are no storage files.
    """
    files = storage_files(source)
    if not files:
        raise ValueError(f'{source}: no .mcap and no .db3 file there')
    losses: list[str] = []

    def lose(text: str) -> None:
        losses.append(text)
        report(text)

    read = 0
    plugin = StoragePlugin.MCAP if '.mcap' in files[0].suffixes else StoragePlugin.SQLITE3
    with (
        tempfile.TemporaryDirectory(dir=target.parent.parent) as folder,
        Writer(target, version=VERSION, storage_plugin=plugin) as writer,
    ):
        connections: dict[tuple[str, str, str], Connection | None] = {}
        for topic, moment, data in _messages(files, Path(folder), lose):
            key = topic.name, topic.msgtype, topic.qos
            if key not in connections:
                connections[key] = _added(writer, topic, lose)
            plain = decompressed(data)
            if plain is None:
                lose(f'a message on {topic.name} at {moment} is damaged')
            elif connection := connections[key]:
                writer.write(connection, moment, plain)
                read += 1
    missing = _promised(source) - read
    if missing > 0:
        lose(f'{missing} messages are missing')
    return max(len(losses), missing)


def _promised(source: Path) -> int:
    """Return how many messages a bag has according to its metadata, 0 if they do not say."""
    try:
        text = read_bounded(source / 'metadata.yaml', MAX_METADATA_BYTES)
        metadata = yaml.safe_load(text.decode())
        return int(metadata['rosbag2_bagfile_information']['message_count'])
    except (OSError, yaml.YAMLError, LookupError, TypeError, ValueError, RecursionError):
        return 0


def _messages(
    files: Iterable[Path], folder: Path, lose: Report
) -> Iterator[tuple[_Topic, int, bytes]]:
    """Read the messages of storage files."""
    for path in files:
        copy = _working_copy(path, folder, lose)
        read = _mcap_messages if copy.suffix == '.mcap' else _sqlite_messages
        yield from read(copy, lose)


def _added(writer: Writer, topic: _Topic, lose: Report) -> Connection | None:
    """Add a topic to a bag; None if its description is damaged."""
    kinds = {'ros2msg': MessageDefinitionFormat.MSG, 'ros2idl': MessageDefinitionFormat.IDL}
    kind = kinds.get(topic.encoding, MessageDefinitionFormat.NONE)
    try:
        return add_topic(
            writer,
            Connection(
                id=0,
                topic=topic.name,
                msgtype=topic.msgtype,
                msgdef=MessageDefinition(kind, topic.definition),
                digest=topic.digest,
                msgcount=0,
                ext=ConnectionExtRosbag2('cdr', parse_qos(topic.qos)),
                owner=None,
            ),
        )
    # Broken bytes can raise anything in a library.
    except Exception as error:
        lose(f'the topic {topic.name} is lost: {_text(error)}')
        return None


def _working_copy(path: Path, folder: Path, lose: Report) -> Path:
    """Copy a storage file to a folder where it may change; decompress it if it is compressed."""
    copy = folder / path.name.removesuffix('.zstd')
    if path.suffix != '.zstd':
        if path.suffix == '.mcap':
            return path
        # With the log that SQLite had not yet moved into the file when the recorder ended.
        for part in path.parent.glob(f'{glob.escape(path.name)}*'):
            if part.is_file():
                shutil.copy(part, folder / part.name)
        return copy
    with path.open('rb') as stream, copy.open('wb') as out:
        try:
            for block in file_blocks(stream, folder):
                out.write(block)
        except (zstandard.ZstdError, ValueError) as error:
            lose(f'{path.name}: damaged at or before byte {stream.tell()}: {error}')
    return copy


def file_blocks(stream: BinaryIO, folder: Path) -> Iterator[bytes]:
    """
    Decompress a storage file, block by block.

    Parameters
    ----------
    stream : file
        The compressed file.
    folder : Path
        Where it is going to be written.

    Raises
    ------
    ValueError
        If it is larger than what the disk of the folder has room for.
    zstandard.ZstdError
        If it is damaged.
    """
    room, size = shutil.disk_usage(folder).free - _DISK_RESERVE, 0
    for block in zstandard.ZstdDecompressor().read_to_iter(stream, write_size=2**20):
        size += len(block)
        if size > room:
            raise ValueError(
                f'it takes more than {max(room, 0)} bytes, for which {folder} has no room'
            )
        yield block


def decompressed(data: bytes) -> bytes | None:
    """
    Decompress a message if it is compressed; no plain message begins so.

    Return None if that fails, or if it is larger than `MAX_BYTES`.
    """
    if not data.startswith(_ZSTD_MAGIC):
        return data
    plain = bytearray()
    try:
        stream = zstandard.ZstdDecompressor().stream_reader(data)
        while len(plain) <= MAX_BYTES and (block := stream.read(2**16)):
            plain += block
    except zstandard.ZstdError:
        return None
    return bytes(plain) if len(plain) <= MAX_BYTES else None


def _mcap_messages(path: Path, lose: Report) -> Iterator[tuple[_Topic, int, bytes]]:
    """Read the messages of an MCAP file in the order of the file."""
    with path.open('rb') as stream:
        summary = summary_of(stream)
        schemas, channels = summary.schemas, summary.channels
        for record in _records(stream, path.name, lose):
            if isinstance(record, Schema):
                schemas[record.id] = record
            elif isinstance(record, Channel):
                channels[record.id] = record
            elif isinstance(record, Message):
                channel = channels.get(record.channel_id)
                schema = schemas.get(channel.schema_id) if channel else None
                if channel is None or schema is None:
                    lose(f'{path.name}: a message at {record.log_time} is of an unknown topic')
                    continue
                definition = schema.data.decode(errors='replace')
                digest = channel.metadata.get('topic_type_hash', '')
                qos = channel.metadata.get('offered_qos_profiles', '')
                names = channel.topic, schema.name, schema.encoding
                yield _Topic(*names, definition, digest, qos), record.log_time, record.data


def has_oversized_records(stream: BinaryIO) -> bool:
    """Check whether an MCAP file has a record that is too large to be read at once."""
    stream.seek(len(_MCAP_MAGIC))
    while len(head := stream.read(_RECORD_HEAD.size)) == _RECORD_HEAD.size:
        opcode, length = _RECORD_HEAD.unpack(head)
        if length > MAX_BYTES:
            return True
        # No record begins with a zero: the rest of the file has been lost.
        if not opcode:
            return False
        stream.seek(length, os.SEEK_CUR)
    return False


def summary_of(stream: BinaryIO) -> Summary:
    """Read the summary at the end of an MCAP file; an empty one if it cannot be read."""
    is_bounded = not has_oversized_records(stream)
    stream.seek(0)
    try:
        summary = make_reader(stream).get_summary() if is_bounded else None
    # Broken bytes can raise anything.
    except Exception:
        summary = None
    stream.seek(0)
    return summary or Summary()


def _records(stream: BinaryIO, name: str, lose: Report) -> Iterator[Any]:
    """Read the records of an MCAP file, also those in chunks, up to the first damaged one."""
    reader = StreamReader(stream, emit_chunks=True, record_size_limit=MAX_BYTES)
    records = iter(reader.records)
    while True:
        start = stream.tell()
        try:
            record = next(records, None)
        # Broken bytes can raise anything.
        except Exception as error:
            lose(f'{name}: nothing, or not all, can be read from byte {start} on: {_text(error)}')
            stream.seek(start)
            yield from _beginning_of_chunk(stream.read(MAX_BYTES))
            return
        if record is None:
            return
        if not isinstance(record, Chunk):
            yield record
            continue
        if record.uncompressed_size > MAX_BYTES:
            lose(f'{name}: the chunk from byte {start} on is lost: more than {MAX_BYTES} bytes')
            continue
        content = unpack_chunk(record.compression, record.data, record.uncompressed_size + 1)
        crc = record.uncompressed_crc
        if len(content) != record.uncompressed_size or (crc and zlib.crc32(content) != crc):
            lose(f'{name}: the chunk of messages from byte {start} on is damaged')
        yield from _inner_records(content)


def _beginning_of_chunk(data: bytes) -> Iterator[Any]:
    """Read the records of a chunk whose end is missing."""
    if len(data) < _CHUNK_HEAD.size or data[0] != Opcode.CHUNK:
        return
    *_, length = _CHUNK_HEAD.unpack_from(data)
    start = _CHUNK_HEAD.size + length
    compression = data[_CHUNK_HEAD.size : start].decode(errors='replace')
    # After the eight bytes of the size.
    yield from _inner_records(unpack_chunk(compression, data[start + 8 :]))


def _inner_records(content: bytes) -> Iterator[Any]:
    """Read records up to the first that is damaged or incomplete."""
    try:
        yield from StreamReader(BytesIO(content), skip_magic=True).records
    # The end of the content raises as well.
    except Exception:
        return


def unpack_chunk(compression: str, data: bytes, enough: int = MAX_BYTES) -> bytes:
    """Decompress a chunk, up to where it is damaged, and not much more than enough."""
    if not compression:
        return data
    unpacked = bytearray()
    try:
        if compression == 'lz4':
            decompressor = lz4.frame.LZ4FrameDecompressor()
            # In pieces: a damaged piece yields nothing at all.
            for start in range(0, len(data), _PIECE):
                unpacked += decompressor.decompress(data[start : start + _PIECE])
                if len(unpacked) >= enough:
                    break
        else:
            stream = zstandard.ZstdDecompressor().stream_reader(data)
            while len(unpacked) < enough and (block := stream.read(2**16)):
                unpacked += block
    except (RuntimeError, zstandard.ZstdError):
        pass
    return bytes(unpacked)


def _text(error: Exception) -> str:
    """Say what went wrong; an error without a text is named by its type."""
    if isinstance(error, EndOfFile):
        return 'the file ends there'
    if isinstance(error, KeyError):
        return f'{error} is missing'
    return str(error) or type(error).__name__


def _sqlite_messages(path: Path, lose: Report) -> Iterator[tuple[_Topic, int, bytes]]:
    """Read the messages of an SQLite3 file in the order in which they were recorded."""
    with closing(sqlite3.connect(path)) as base:
        # A wrong byte in a definition must not cost the rest of it.
        base.text_factory = lossy_text
        try:
            # With it, SQLite reads a file that has lost its end.
            base.execute('PRAGMA writable_schema = ON')
            topics = _sqlite_topics(base, path.name, lose)
        except _TABLE_ERRORS as error:
            lose(f'{path.name}: nothing can be read: {_text(error)}')
            return
        columns = ('id', 'topic_id', 'timestamp', 'data')
        for number, topic_id, moment, data in rows_around_damage(
            base, 'messages', columns, lambda gap: lose(f'{path.name}: {_lost(gap)}')
        ):
            if not (isinstance(moment, int) and moment >= 0 and isinstance(data, bytes)):
                lose(f'{path.name}: message {number} is lost: it is damaged')
            elif topic_id not in topics:
                lose(f'{path.name}: message {number} is lost: it is of an unknown topic')
            else:
                yield topics[topic_id], moment, data


def _lost(gap: Gap) -> str:
    """Say which messages cannot be read, and why."""
    if gap.first == gap.last:
        return f'message {gap.first} is lost: {gap.error}'
    until = 'and on' if gap.last is None else f'to {gap.last}'
    return f'messages {gap.first} {until} are lost: {gap.error}'


def _sqlite_topics(base: sqlite3.Connection, name: str, lose: Report) -> dict[int, _Topic]:
    """Read the topics; older versions say less of them."""
    definitions = _sqlite_definitions(base, name, lose)
    topics = {}
    for row in _rows(base, 'topics'):
        definition = definitions.get(row['type'], ('', ''))
        digest, qos = row.get('type_description_hash', ''), row.get('offered_qos_profiles', '')
        topics[row['id']] = _Topic(row['name'], row['type'], *definition, digest, qos)
    return topics


def _sqlite_definitions(
    base: sqlite3.Connection, name: str, lose: Report
) -> dict[str, tuple[str, str]]:
    """Read encoding and text of the types; messages can be converted without them."""
    try:
        return {
            row['topic_type']: (row['encoding'], row['encoded_message_definition'] or '')
            for row in _rows(base, 'message_definitions')
        }
    except _TABLE_ERRORS as error:
        lose(f'{name}: the definitions of the types are lost: {_text(error)}')
        return {}


def _rows(base: sqlite3.Connection, table: str) -> list[dict[str, Any]]:
    """Read a table, if it is there."""
    if not base.execute('SELECT 1 FROM sqlite_master WHERE name = ?', (table,)).fetchone():
        return []
    cursor = base.execute(f'SELECT * FROM {table}')
    names = [column[0] for column in cursor.description]
    return [dict(zip(names, row, strict=True)) for row in cursor]
