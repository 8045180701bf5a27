# SPDX-License-Identifier: Apache-2.0
"""Files that would take all memory or never end: one line of text, and the rest is done."""

from __future__ import annotations

import os
import resource
import shutil
import struct
import subprocess
import sys
import tracemalloc
import zlib
from hashlib import sha256
from pathlib import Path
from typing import Any

import pytest
from outboxes import a_chip
from outboxes import put

from obbhbb_ros.cli import main
from obbhbb_ros.files import read_bounded

GIANT = 2**33
MEMORY = 3 * 2**29
SHIPS = Path(__file__).parents[2] / 'data/real_ships_bag'


def run(*words: object) -> subprocess.CompletedProcess[str]:
    """Run a command with little memory and little time."""
    return subprocess.run(
        [sys.executable, '-m', 'obbhbb_ros.cli', *map(str, words)],
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY)),
        env=os.environ | {'OPENBLAS_NUM_THREADS': '1'},
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )


def giant(path: Path, start: bytes = b'') -> Path:
    """Make a file that takes no place on disk."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(start)
    os.truncate(path, GIANT)
    return path


def pipe(path: Path) -> Path:
    """Make a pipe that nobody writes to."""
    path.parent.mkdir(parents=True, exist_ok=True)
    os.mkfifo(path)
    return path


def picture_of_16_bits(side: int) -> bytes:
    """Write a black PNG."""

    def chunk(name: bytes, data: bytes) -> bytes:
        return (
            struct.pack('>I', len(data)) + name + data + struct.pack('>I', zlib.crc32(name + data))
        )

    packer = zlib.compressobj()
    rows = b''.join(packer.compress(bytes(1 + 2 * side)) for _ in range(side)) + packer.flush()
    head = struct.pack('>IIBBBBB', side, side, 16, 0, 0, 0, 0)
    parts = chunk(b'IHDR', head) + chunk(b'IDAT', rows) + chunk(b'IEND', b'')
    return b'\x89PNG\r\n\x1a\n' + parts


def test_a_file_is_read_up_to_a_size_and_only_if_it_is_one(tmp_path: Path) -> None:
    (tmp_path / 'file').write_bytes(b'12345')
    assert read_bounded(tmp_path / 'file', 5) == b'12345'
    with pytest.raises(ValueError, match=r'^5 bytes, the maximum is 4$'):
        read_bounded(tmp_path / 'file', 4)
    for path in (pipe(tmp_path / 'pipe'), tmp_path, Path('/dev/zero')):
        with pytest.raises(ValueError, match=r'^not a regular file$'):
            read_bounded(path, 5)


def test_a_small_file_takes_little_memory_to_read(tmp_path: Path) -> None:
    (tmp_path / 'file').write_bytes(b'12345')
    tracemalloc.start()
    try:
        assert read_bounded(tmp_path / 'file', 1 << 30) == b'12345'
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert peak < 1 << 20


def test_a_gallery_shows_what_can_be_shown(tmp_path: Path) -> None:
    pytest.importorskip('jinja2')
    box = tmp_path / 'box'
    huge = picture_of_16_bits(6000)
    facts, _ = a_chip('png', roi=[0, 0, 6000, 6000], bytes=len(huge), id='huge')
    put(box, facts | {'sha256': sha256(huge).hexdigest()}, huge)
    sparse = put(box, a_chip(bytes=2**32 - 1, id='sparse')[0], b'')
    os.truncate(sparse.with_suffix('.jpg'), 2**32 - 1)
    giant(box / 'giant.json')
    put(box, *a_chip(id='good'))
    done = run('gallery', box, '-o', tmp_path / 'page.html')
    assert done.returncode == 0, done.stderr
    for words in (
        'giant.json: 8589934592 bytes, the maximum is ',
        'sparse.jpg: damaged: 4294967295 bytes, the maximum is ',
        'huge.png: no picture (',
    ):
        assert words in done.stderr
    assert len(done.stderr.splitlines()) == 3
    assert (tmp_path / 'page.html').read_text(encoding='utf-8').count('<img') == 2


def bomb(path: Path, said: int, packed: int) -> Path:
    """Write an MCAP file with a chunk that says another size than it has when it is unpacked."""
    mcap = pytest.importorskip('mcap.writer')
    zstandard = pytest.importorskip('zstandard')
    with path.open('wb') as stream:
        writer = mcap.Writer(stream)
        writer.start(profile='ros2', library='')
        writer.finish()
    sound = path.read_bytes()
    end = 17 + struct.unpack_from('<Q', sound, 9)[0]
    packer = zstandard.ZstdCompressor().compressobj()
    data = b''.join(packer.compress(bytes(2**20)) for _ in range(packed >> 20)) + packer.flush()
    body = struct.pack('<QQQII4sQ', 0, 1, said, 0, 4, b'zstd', len(data)) + data
    chunk = b'\x06' + struct.pack('<Q', len(body)) + body
    path.write_bytes(sound[:end] + chunk + sound[end:])
    return path


BAGS = {
    'a chunk of 2 GB': lambda path: bomb(path / 'a.mcap', 2**31, 2**31),
    'a chunk of 2 GB that says less': lambda path: bomb(path / 'a.mcap', 1000, 2**31),
    'a giant record': lambda path: giant(
        path / 'a.mcap', b'\x89MCAP0\r\n\x01' + struct.pack('<Q', GIANT)
    ),
    'a giant metadata.yaml': lambda path: giant(path / 'bag/metadata.yaml').parent,
    'a pipe as metadata.yaml': lambda path: pipe(path / 'bag/metadata.yaml').parent,
    'a pipe': lambda path: pipe(path / 'a.mcap'),
}


@pytest.mark.parametrize('make', BAGS.values(), ids=BAGS)
def test_a_hostile_bag_ends_in_one_line(tmp_path: Path, make: Any) -> None:
    pytest.importorskip('rosbags')
    done = run('bag', make(tmp_path), tmp_path / 'out')
    assert done.returncode == 1
    *before, last = done.stderr.splitlines()
    assert last.startswith('obbhbb: ')
    assert all(line.startswith('obbhbb: ') for line in before), done.stderr
    assert not (tmp_path / 'out').exists()


def test_a_bag_for_which_the_disk_has_no_room_is_not_decompressed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip('rosbags')
    zstandard = pytest.importorskip('zstandard')
    folder = tmp_path / 'bag'
    folder.mkdir()
    (folder / 'metadata.yaml').write_text('{}')
    packer = zstandard.ZstdCompressor().compressobj()
    data = b''.join(packer.compress(bytes(2**20)) for _ in range(64)) + packer.flush()
    (folder / 'a.db3.zstd').write_bytes(data)
    # A disk with room for 32 MB besides what is to stay free of it.
    real = shutil.disk_usage
    monkeypatch.setattr(shutil, 'disk_usage', lambda path: real(path)._replace(free=2**28 + 2**25))
    assert main(['bag', str(folder), str(tmp_path / 'out')]) == 1
    told, *_, last = capsys.readouterr().err.splitlines()
    assert 'a.db3.zstd: it takes more than 33554432 bytes' in told
    assert last.startswith('obbhbb: ')


def test_a_nested_metadata_is_damaged(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip('rosbags')
    (tmp_path / 'bag').mkdir()
    (tmp_path / 'bag' / 'metadata.yaml').write_text('[' * 20_000)
    (tmp_path / 'bag' / 'a.mcap').touch()
    assert main(['bag', str(tmp_path / 'bag'), str(tmp_path / 'out')]) == 1
    assert 'is damaged' in capsys.readouterr().err


@pytest.mark.parametrize('make', [giant, pipe], ids=['giant', 'pipe'])
def test_a_hostile_parameter_file_ends_in_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], make: Any
) -> None:
    pytest.importorskip('rosbags')
    file = make(tmp_path / 'params.yaml')
    assert main(['bag', str(SHIPS), str(tmp_path / 'out'), '--params-file', str(file)]) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f'obbhbb: {file}: ')


@pytest.mark.parametrize(
    ('suffix', 'start', 'words'),
    [
        ('.txt', b'0 .1 .1 .2 .1 .2 .2 .1 .2\n', 'a line of more than 67108864 bytes'),
        ('.geojson', b'', '8589934592 bytes, the maximum is 1073741824'),
        ('.xml', b'<annotation>', '8589934592 bytes, the maximum is 1073741824'),
    ],
)
def test_a_giant_label_file_ends_in_one_line(
    tmp_path: Path, suffix: str, start: bytes, words: str
) -> None:
    file = giant(tmp_path / f'a{suffix}', start)
    done = run('convert', file, tmp_path / 'out.csv', '--strict')
    assert done.returncode == 1
    assert words in done.stderr
    assert 'Traceback' not in done.stderr


@pytest.mark.parametrize(
    ('error', 'words'),
    [(MemoryError(), 'not enough memory'), (RecursionError(), 'the input is nested too deeply')],
    ids=['memory', 'depth'],
)
def test_what_no_reader_bounds_ends_in_one_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], error: Any, words: str
) -> None:
    def fail(*_: Any) -> int:
        raise error

    monkeypatch.setattr('obbhbb_ros.commands.run', fail)
    assert main(['demo']) == 1
    assert capsys.readouterr().err == f'obbhbb: {words}\n'
