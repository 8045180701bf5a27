# SPDX-License-Identifier: Apache-2.0
"""A bag with what the node would have sent, message for message."""

from __future__ import annotations

import gc
import multiprocessing
import os
import shutil
import signal
import sqlite3
import tempfile
from collections import Counter
from collections import deque
from collections.abc import Callable
from collections.abc import Iterable
from collections.abc import Iterator
from collections.abc import Mapping
from collections.abc import Sequence
from concurrent.futures import BrokenExecutor
from concurrent.futures import Future
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from dataclasses import field
from functools import partial
from pathlib import Path
from typing import Any
from typing import NamedTuple
from typing import TypeAlias

import lz4.frame
import zstandard
from rosbags.interfaces import Connection
from rosbags.rosbag2 import CompressionFormat
from rosbags.rosbag2 import CompressionMode
from rosbags.rosbag2 import Reader
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer
from rosbags.rosbag2 import storage_mcap

from obbhbb_ros.bags.rescue import MAX_BYTES
from obbhbb_ros.bags.rescue import MAX_METADATA_BYTES
from obbhbb_ros.bags.rescue import decompressed
from obbhbb_ros.bags.rescue import file_blocks
from obbhbb_ros.bags.rescue import has_oversized_records
from obbhbb_ros.bags.rescue import rescue
from obbhbb_ros.bags.rescue import storage_files
from obbhbb_ros.bags.rescue import summary_of
from obbhbb_ros.bags.topics import CAMERA_INFO_TYPE
from obbhbb_ros.bags.topics import OUTPUTS
from obbhbb_ros.bags.topics import VERSION
from obbhbb_ros.bags.topics import Topics
from obbhbb_ros.bags.topics import add_output
from obbhbb_ros.bags.topics import add_topics
from obbhbb_ros.bags.topics import choose
from obbhbb_ros.downlink.cameras import CameraChoice
from obbhbb_ros.downlink.cameras import CameraMemory
from obbhbb_ros.errors import ObbhbbError
from obbhbb_ros.files import making
from obbhbb_ros.pipeline.conversion import Outputs
from obbhbb_ros.pipeline.conversion import answer
from obbhbb_ros.pipeline.conversion import outside_complaint
from obbhbb_ros.pipeline.outcome import Outcome
from obbhbb_ros.pipeline.outcome import Output
from obbhbb_ros.pipeline.plausibility import OutsideWatch
from obbhbb_ros.settings.obb_to_hbb import OBB_TO_HBB
from obbhbb_ros.settings.obb_to_hbb import ConversionSettings
from obbhbb_ros.settings.parameter_file import Values
from obbhbb_ros.settings.parameter_file import read_values
from obbhbb_ros.wire.buffer import WireError
from obbhbb_ros.wire.camera import WireCamera
from obbhbb_ros.wire.camera import read_camera
from obbhbb_ros.wire.layouts import INPUT_TYPES
from obbhbb_ros.wire.stamp import stamp_at_start

# Converting more messages than this takes longer than starting processes for it.
FEW_MESSAGES = 4000

UNREADABLE = 'unreadable message'

# Parameters that ROS adds to every node, besides `qos_overrides`.
_OF_EVERY_NODE = {'use_sim_time', 'start_type_description_service'}

# Messages are converted in stretches of this size.
STRETCH_BYTES = 2**20
# Stretches that may wait for the one to be written next.
MAX_WAITING_STRETCHES = 8

Report: TypeAlias = Callable[[str], None]
Progress: TypeAlias = Callable[[Iterable[Any], int], Iterable[Any]]

_Input: TypeAlias = tuple[bytes, CameraChoice[WireCamera] | None]
"""A message to be converted, and its camera: of its stamp, else the last one before it."""


class DamagedBagError(ObbhbbError, ValueError):
    """A bag that cannot be read to its end."""


@dataclass(frozen=True)
class ReplayOptions:
    """
    What to convert and how.

    Attributes
    ----------
    topic, camera_info : str
        As `choose` takes them.
    params_file : Path, optional
        ROS parameter file of the node; the defaults apply without one.
    node : str
        Full name of the node in that file; `obb_to_hbb` in the namespace of the input by default.
    storage, compression : str
        Names of a `StoragePlugin` and of a `CompressionMode`, in lower case; as the source by
        default.
    replace : bool
        Whether boxes and crop regions in the source are left out.
    """

    topic: str = ''
    camera_info: str = ''
    params_file: Path | None = None
    node: str = ''
    storage: str = ''
    compression: str = ''
    replace: bool = False


@dataclass
class BagTally:
    """
    What became of a bag.

    Attributes
    ----------
    topics : Topics
        What was converted.
    counts : Counter of str
        As in the diagnostics of the node.
    published : Counter of str
        Messages written, by topic of the answers.
    copied : int
        Messages of the source that were written.
    lost : int
        Messages, or parts of the bag with an unknown number of them, that could not be read.
    """

    topics: Topics
    counts: Counter[str] = field(default_factory=Counter)
    published: Counter[str] = field(default_factory=Counter)
    copied: int = 0
    lost: int = 0

    @property
    def complete(self) -> bool:
        """Whether every message was read, and every detection converted."""
        bad = ('messages_unreadable', 'messages_without_image_size', 'detections_dropped')
        return not self.lost and not any(name.startswith(bad) for name in self.counts)

    def __str__(self) -> str:
        """Return the counts as lines of text."""
        topics, rows = self.topics, {'messages copied': self.copied}
        rows |= {f'messages on {topic}': self.published[topic] for topic in topics.outputs}
        rows |= dict(sorted(self.counts.items()))
        if self.lost:
            rows['messages or parts lost'] = self.lost
        first = f'{topics.detections} ({topics.input_type.package}/{topics.input_type.name})'
        return '\n'.join([first, *(f'  {name}: {count}' for name, count in rows.items())])


def add_boxes(
    source: Path,
    target: Path,
    options: ReplayOptions,
    report: Report = print,
    progress: Progress = lambda messages, total: messages,
) -> BagTally:
    """
    Write a copy of a bag, with the boxes and crop regions that the node would have sent.

    Parameters
    ----------
    source : Path
        A bag, or a storage file of one.
    target : Path
        The bag to write; it appears when it is complete.
    options : ReplayOptions
        What to convert and how.
    report : callable
        Gets a line of text for everything that is wrong with the bag or with a message.
    progress : callable
        Gets the messages and their number; passes the messages on and shows the progress.

    Returns
    -------
    BagTally
        What was read, written and lost.

    Raises
    ------
    ValueError
        If nothing in the source can be read, the topic is ambiguous, or parameters cannot be used.
    OSError
        If a file cannot be read or written, or the target exists.
    """
    if not source.exists():
        raise FileNotFoundError(f'no bag: {source}')
    with making(target) as partial_bag, _sqlite_errors_are_os_errors(target):
        try:
            return _replay(source, partial_bag, options, report, progress)
        except DamagedBagError as error:
            report(f'{source} is damaged: {error}; converting what can be read')
        shutil.rmtree(partial_bag, ignore_errors=True)
        rescued = partial_bag.parent / 'rescued' / partial_bag.name
        lost = rescue(source, rescued, report)
        tally = _replay(rescued, partial_bag, options, report, progress)
        tally.lost += lost
        return tally


@contextmanager
def _sqlite_errors_are_os_errors(target: Path) -> Iterator[None]:
    """Report a full disk in the same way for every storage."""
    try:
        yield
    except sqlite3.Error as error:
        raise OSError(f'{target}: {error}') from error


def _replay(
    source: Path, target: Path, options: ReplayOptions, report: Report, progress: Progress
) -> BagTally:
    """Write a copy of a bag that can be read to its end."""
    with _opened(source) as reader:
        topics = choose(reader.connections, options.topic, options.camera_info)
        settings = _settings(topics, options, report)
        kept = _kept(reader.connections, topics, options.replace)
        with _writer(source, target, reader, options) as writer:
            replay = _Replay(reader, settings, report, BagTally(topics))
            copies = add_topics(writer, kept)
            answers = [add_output(writer, topic, kept) for topic in topics.outputs]
            replay.write(writer, copies, answers, progress)
    return replay.tally


@contextmanager
def _opened(source: Path) -> Iterator[Reader]:
    """Open a bag for reading."""
    _require_bounded(source)
    try:
        reader = Reader(source)
        reader.open()
    except PermissionError:
        raise
    # Any exception: the libraries raise errors of many kinds for broken bytes.
    except Exception as error:
        raise DamagedBagError(str(error)) from error
    try:
        yield reader
    finally:
        reader.close()


def _require_bounded(source: Path) -> None:
    """Raise DamagedBagError if the library would wait, or read more than fits into memory."""
    metadata = source / 'metadata.yaml'
    if source.is_dir() and not metadata.exists():
        raise DamagedBagError('no metadata.yaml')
    for path in source.iterdir() if source.is_dir() else [source]:
        if path.exists() and not (path.is_file() or path.is_dir()):
            raise DamagedBagError(f'{path.name} is not a regular file')
        if path.suffix == '.mcap' and path.is_file():
            with path.open('rb') as stream:
                if has_oversized_records(stream):
                    raise DamagedBagError(f'{path.name}: a record of more than {MAX_BYTES} bytes')
        if path.suffix == '.zstd' and path.is_file():
            _require_room(path)
    if metadata.is_file() and metadata.stat().st_size > MAX_METADATA_BYTES:
        raise DamagedBagError(f'metadata.yaml has more than {MAX_METADATA_BYTES} bytes')


def _require_room(path: Path) -> None:
    """Raise DamagedBagError if the disk has no room for a storage file that is compressed."""
    with path.open('rb') as stream:
        try:
            for _ in file_blocks(stream, Path(tempfile.gettempdir())):
                pass
        except (zstandard.ZstdError, ValueError) as error:
            raise DamagedBagError(f'{path.name}: {error}') from error


def _bounded_chunk(compression: str, data: bytes, size: int) -> bytes:
    """Decompress a chunk that should have `size` bytes, and at most one byte more than that."""
    if size > MAX_BYTES:
        raise DamagedBagError(f'a chunk of {size} bytes, the maximum is {MAX_BYTES}')
    if compression == 'lz4':
        plain: bytes = lz4.frame.LZ4FrameDecompressor().decompress(data, size + 1)
        return plain
    return zstandard.ZstdDecompressor().stream_reader(data).read(size + 1)


# The library's own decompress whatever a chunk holds.
storage_mcap.DECOMPRESSORS.update({name: partial(_bounded_chunk, name) for name in ('lz4', 'zstd')})


def _settings(topics: Topics, options: ReplayOptions, report: Report) -> ConversionSettings:
    """Read the parameters as the node would."""
    values: Values = {}
    if options.params_file:
        namespace = topics.detections.rpartition('/')[0]
        values = read_values(options.params_file, options.node or f'{namespace}/obb_to_hbb')
    classes = [*OBB_TO_HBB.mentioned_classes(values), *OBB_TO_HBB.class_ids(values)]
    names = OBB_TO_HBB.parameters(classes).keys() | _OF_EVERY_NODE
    extra = sorted(name for name in values.keys() - names if not name.startswith('qos_overrides.'))
    if extra:
        report(f'{options.params_file}: unknown parameters, ignored: {", ".join(extra)}')
    return OBB_TO_HBB.settings(values)


def _kept(connections: Sequence[Connection], topics: Topics, replace: bool) -> list[Connection]:
    """List what is copied: everything but earlier boxes and crop regions."""
    outputs = topics.outputs
    earlier = [connection.topic for connection in connections if connection.topic in outputs]
    if earlier and not replace:
        raise ValueError(f'the bag has {" and ".join(earlier)} already; --replace leaves them out')
    return [connection for connection in connections if connection.topic not in earlier]


def _writer(source: Path, target: Path, reader: Reader, options: ReplayOptions) -> Writer:
    """Create a writer that stores the bag like the source, unless options say otherwise."""
    files = storage_files(source)
    is_mcap = any('.mcap' in file.suffixes for file in files)
    storage = options.storage or ('mcap' if is_mcap else 'sqlite3')
    compression = options.compression or reader.compression_mode or ''
    if not compression and storage == 'mcap' and is_mcap and _has_compressed_chunks(files[0]):
        compression = 'storage'
    if (storage, compression) == ('sqlite3', 'storage'):
        raise ValueError('compression storage needs mcap, not sqlite3')
    writer = Writer(target, version=VERSION, storage_plugin=StoragePlugin[storage.upper()])
    mode = CompressionMode[(compression or 'none').upper()]
    writer.set_compression(mode, CompressionFormat.ZSTD)
    for key, value in (reader.storage.metadata.custom or {}).items():
        # The text of nested aliases grows with each level.
        if not isinstance(value, dict | list):
            writer.set_custom_data(key, str(value))
    return writer


def _has_compressed_chunks(path: Path) -> bool:
    """Return whether the messages of an MCAP file are compressed."""
    with path.open('rb') as stream:
        return any(chunk.compression for chunk in summary_of(stream).chunk_indexes)


class _Stretch(NamedTuple):
    """Consecutive messages of a bag, and those of them that are to be converted."""

    messages: list[tuple[Connection, int, bytes]]
    inputs: list[_Input]


class _Answer(NamedTuple):
    """What the node would send for a message, by output, and what became of the message."""

    messages: dict[int, bytes]
    outcome: Outcome


def answers_to(
    input_type: str, settings: ConversionSettings, inputs: Iterable[_Input]
) -> list[_Answer]:
    """Convert messages as the node would."""
    answers = []
    for data, camera in inputs:
        messages: dict[int, bytes] = {}
        outputs = Outputs(*(Output(partial(messages.__setitem__, i)) for i in range(len(OUTPUTS))))
        try:
            outcome = answer(data, INPUT_TYPES[input_type], settings, camera, outputs)
        except WireError as error:
            complaints = {UNREADABLE: f'cannot be read: {error}'}
            messages, outcome = {}, Outcome({'messages_unreadable': 1}, complaints)
        answers.append(_Answer(messages, outcome))
    return answers


@dataclass
class _Replay:
    """Copies the messages of one bag, and adds the answers of the node."""

    reader: Reader
    settings: ConversionSettings
    report: Report
    tally: BagTally
    cameras: CameraMemory[WireCamera] = field(default_factory=CameraMemory[WireCamera])
    camera_messages: int = 0
    complaints: set[str] = field(default_factory=set)
    outside: OutsideWatch = field(default_factory=OutsideWatch)

    def write(
        self,
        writer: Writer,
        copies: Mapping[int, Connection],
        outputs: Sequence[Connection],
        progress: Progress,
    ) -> None:
        """Write all messages in their order, each followed by its answers."""
        stretches = self._stretches(progress(self._messages(), self.reader.message_count))
        convert = partial(answers_to, self.tally.topics.input_type.name, self.settings)
        inputs = filter(self._is_input, self.reader.connections)
        expected = sum(connection.msgcount for connection in inputs)
        for stretch, answers in _converted(stretches, convert, expected > FEW_MESSAGES):
            waiting = iter(answers)
            for connection, moment, data in stretch.messages:
                if copy := copies.get(connection.id):
                    writer.write(copy, moment, data)
                    self.tally.copied += 1
                if self._is_input(connection):
                    for i, message in self._noted(next(waiting)).items():
                        writer.write(outputs[i], moment, message)
                        self.tally.published[outputs[i].topic] += 1

    def _is_input(self, connection: Connection) -> bool:
        """Return whether the messages of a topic are converted."""
        topics = self.tally.topics
        named: bool = connection.topic == topics.detections
        return named and connection.msgtype.endswith(f'/{topics.input_type.name}')

    def _is_camera_info(self, connection: Connection) -> bool:
        """Return whether the messages of a topic hold the size of the image."""
        named: bool = connection.topic == self.tally.topics.camera_info
        return named and connection.msgtype == CAMERA_INFO_TYPE

    def _messages(self) -> Iterator[tuple[Connection, int, bytes]]:
        """Read all messages."""
        count = 0
        try:
            for connection, moment, data in self._stored_messages():
                yield connection, moment, data
                count += 1
        # Any exception: the libraries raise errors of many kinds for broken bytes.
        except Exception as error:
            raise DamagedBagError(f'after {count} messages: {error}') from error
        if count != (expected := self.reader.message_count):
            raise DamagedBagError(f'it has {count} messages, but its metadata says {expected}')

    def _stored_messages(self) -> Iterator[tuple[Connection, int, bytes]]:
        """Read the messages of the library, but decompress them within bounds."""
        storage = self.reader.storage
        if storage.metadata.compression_mode != 'message':
            yield from self.reader.messages()
            return
        storage.metadata = storage.metadata._replace(compression_mode=None)
        for connection, moment, data in self.reader.messages():
            plain = decompressed(data)
            if plain is None:
                raise DamagedBagError('a message cannot be decompressed')
            yield connection, moment, plain

    def _stretches(self, messages: Iterable[tuple[Connection, int, bytes]]) -> Iterator[_Stretch]:
        """Divide the messages into stretches of about `STRETCH_BYTES`."""
        stretch, size = _Stretch([], []), 0
        for message in messages:
            connection, moment, data = message
            stretch.messages.append(message)
            size += len(data)
            if self._is_input(connection):
                stretch.inputs.append((data, self.cameras.choice(stamp_at_start(data))))
            elif self._is_camera_info(connection):
                self._keep_camera(connection, moment, data)
            if size > STRETCH_BYTES:
                yield stretch
                stretch, size = _Stretch([], []), 0
        yield stretch

    def _keep_camera(self, connection: Connection, moment: int, data: bytes) -> None:
        """Keep a camera for the detections that follow it."""
        self.camera_messages += 1
        try:
            camera = read_camera(data)
        except WireError as error:
            self.tally.counts['messages_unreadable'] += 1
            self.report(
                f'message {self.camera_messages} on {connection.topic} cannot be read: {error}'
            )
        else:
            self.cameras.add(camera.stamp, camera, moment / 1e9)

    def _noted(self, answer: _Answer) -> dict[int, bytes]:
        """Count and report what became of a message; complaints about every message only once."""
        counts, topic = self.tally.counts, self.tally.topics.detections
        counts['messages_received'] += 1
        outcome = answer.outcome
        counts.update(outcome.counts)
        outside = outside_complaint(self.outside, outcome)
        for kind, text in (outcome.complaints | outside).items():
            if kind == UNREADABLE or kind not in self.complaints:
                self.report(f'message {counts["messages_received"]} on {topic}: {text}')
            self.complaints.add(kind)
        return answer.messages


def _converted(
    stretches: Iterable[_Stretch], convert: Callable[[list[_Input]], list[_Answer]], many: bool
) -> Iterator[tuple[_Stretch, list[_Answer]]]:
    """Convert stretches in their order; if there are many messages, in parallel processes."""
    processors = os.cpu_count() or 1
    if not many or processors == 1:
        for stretch in stretches:
            yield stretch, convert(stretch.inputs)
        return
    context = multiprocessing.get_context('spawn')
    try:
        # Garbage collection would take a tenth of the time.
        with ProcessPoolExecutor(processors, context, initializer=gc.disable) as pool:
            _start(pool, processors)
            waiting: deque[tuple[_Stretch, Future[list[_Answer]]]] = deque()
            for stretch in stretches:
                waiting.append((stretch, pool.submit(convert, stretch.inputs)))
                if len(waiting) > MAX_WAITING_STRETCHES:
                    done, future = waiting.popleft()
                    yield done, future.result()
            for done, future in waiting:
                yield done, future.result()
    except BrokenExecutor as error:
        raise ChildProcessError(f'a process that converts messages has died: {error}') from None


def _start(pool: ProcessPoolExecutor, processes: int) -> None:
    """Start the processes without SIGINT, which a terminal sends to each of them."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        for _ in range(processes):
            pool.submit(int)
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
