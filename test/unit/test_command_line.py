# SPDX-License-Identifier: Apache-2.0
"""The commands when something goes wrong: full disks, closed pipes, Ctrl-C, hostile input."""

from __future__ import annotations

import json
import os
import resource
import signal
import subprocess
import sys
import time
import tracemalloc
from pathlib import Path

import pytest
from PIL import Image

from obbhbb_ros import __version__
from obbhbb_ros.cli import main
from obbhbb_ros.commands import COMMANDS
from obbhbb_ros.files import replacing
from obbhbb_ros.labels import read_labels

OBBHBB = [sys.executable, '-m', 'obbhbb_ros.cli']
HEAD = 'image,instance,class,x1,y1,x2,y2,x3,y3,x4,y4,hx1,hy1,hx2,hy2\n'
ROW = 'P{},{},ship,0,0,40,6,38,20,-2,14,-2,0,40,20\n'


@pytest.fixture
def ships(tmp_path: Path) -> Path:
    path = tmp_path / 'ships.csv'
    path.write_text(HEAD + ''.join(ROW.format(i % 10, i) for i in range(400)))
    return path


# Without a command ----------------------------------------------------------------------------


def test_without_a_command_all_of_them_are_listed(capsys: pytest.CaptureFixture[str]) -> None:
    assert main([]) == 2
    assert set(COMMANDS) <= set(capsys.readouterr().out.split())


def test_version_is_that_of_the_package(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main(['--version'])
    assert ended.value.code == 0
    assert capsys.readouterr().out == f'obbhbb {__version__}\n'


@pytest.mark.parametrize(
    ('module', 'advice'),
    [
        ('geopandas', "pip install '.[geo]'"),
        ('matplotlib.pyplot', "pip install '.[plots]'"),
        ('diagnostic_msgs', 'this needs ROS 2 Jazzy, or the extra jazzy'),
        ('no_such_module', 'see the extras in the README'),
    ],
)
def test_a_missing_module_is_reported_with_its_extra(
    module: str, advice: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def run(arguments: list[str]) -> int:
        raise ModuleNotFoundError(f'No module named {module!r}', name=module)

    monkeypatch.setattr('obbhbb_ros.commands.run', run)
    assert main(['convert']) == 1
    line = capsys.readouterr().err
    assert line.startswith(f'obbhbb: No module named {module!r}; ')
    assert advice in line


# A full disk ----------------------------------------------------------------------------------

OUTPUTS = {
    'coco': ['convert', 'SHIPS', 'OUT.json', '--to', 'coco'],
    'geojson': ['convert', 'SHIPS', 'OUT.geojson'],
    'csv': ['convert', 'SHIPS', 'OUT.csv'],
    'shapefile': ['convert', 'SHIPS', 'OUT.shp'],
    'scores as JSON': ['evaluate', 'SHIPS', '--bootstrap', '10', '--json', 'OUT.json'],
    'scores as CSV': ['evaluate', 'SHIPS', '--bootstrap', '10', '--csv', 'OUT.csv'],
    'a chart': ['evaluate', 'SHIPS', '--bootstrap', '10', '--plot', 'OUT.png'],
    'a report': ['report', 'SHIPS', '--gallery', '2', '-o', 'OUT.html'],
    'a parameter file': ['calibrate', 'SHIPS', '--folds', '0', '-o', 'OUT.yaml'],
    'a picture': ['chips', '--picture', 'OUT.png'],
}


@pytest.mark.parametrize('arguments', OUTPUTS.values(), ids=OUTPUTS)
def test_a_full_disk_leaves_the_old_file_and_one_line(ships: Path, arguments: list[str]) -> None:
    folder = ships.parent / 'out'
    folder.mkdir()
    suffix = next(Path(each).suffix for each in arguments if each.startswith('OUT'))
    old = folder / f'OUT{suffix}'
    old.write_text('good')
    command = [
        str(ships) if each == 'SHIPS' else str(folder / each) if each.startswith('OUT') else each
        for each in arguments
    ]
    done = subprocess.run(
        [*OBBHBB, *command],
        capture_output=True,
        text=True,
        check=False,
        timeout=120,
        # Files end after 300 bytes, as they do on a disk that has no more.
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (300, 300)),
        env={**os.environ, 'PYTHONDONTWRITEBYTECODE': '1'},
    )
    assert done.returncode == 1, done.stderr
    last = done.stderr.splitlines()[-1]
    assert last.startswith('obbhbb: ')
    assert str(old) in last
    assert 'Traceback' not in done.stderr
    assert old.read_text() == 'good'
    assert list(folder.iterdir()) == [old]


def test_output_that_cannot_be_written_is_reported(ships: Path) -> None:
    with open('/dev/full', 'w') as full:
        done = subprocess.run(
            [*OBBHBB, 'convert', ships, ships.with_name('out.json'), '--to', 'coco'],
            stdout=full,
            stderr=subprocess.PIPE,
            text=True,
            check=False,
        )
    assert done.returncode == 1
    assert done.stderr.splitlines()[-1] == 'obbhbb: [Errno 28] No space left on device'


def test_a_file_is_replaced_through_a_link_and_keeps_its_mode(tmp_path: Path) -> None:
    file, link = tmp_path / 'file', tmp_path / 'link'
    file.write_text('old')
    file.chmod(0o640)
    link.symlink_to(file)
    with replacing(link) as partial:
        partial.write_text('new')
        assert file.read_text() == 'old'
    assert file.read_text() == 'new'
    assert file.stat().st_mode & 0o777 == 0o640
    assert link.is_symlink()


def test_a_device_is_written_to_directly() -> None:
    with replacing(Path('/dev/null')) as whole:
        whole.write_text('gone')
    assert not Path('/dev/null').is_file()


def test_a_picture_without_a_suffix_is_a_png(tmp_path: Path) -> None:
    assert main(['chips', '--picture', str(tmp_path / 'harbour')]) == 0
    assert (tmp_path / 'harbour').read_bytes().startswith(b'\x89PNG')
    assert len(list(tmp_path.iterdir())) == 1


def test_the_index_of_a_replaced_shapefile_is_deleted(ships: Path) -> None:
    out = ships.with_name('out.shp')
    out.write_text('old')
    for suffix in ('.qix', '.txt'):
        out.with_suffix(suffix).write_text('old')
    assert main(['convert', str(ships), str(out)]) == 0
    made = {each.suffix for each in ships.parent.glob('out.*')}
    assert made == {'.shp', '.shx', '.dbf', '.cpg', '.txt'}


def test_a_file_that_is_read_only_is_not_replaced(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / 'file'
    file.write_text('old')
    # The tests may run as root, who may write to any file.
    monkeypatch.setattr(os, 'access', lambda path, mode: False)
    with pytest.raises(PermissionError), replacing(file):
        pass


@pytest.mark.parametrize('closed', ['>&-', '2>&-', '>&- 2>&-'])
def test_a_command_works_with_closed_output(ships: Path, closed: str) -> None:
    out = ships.with_name('out.csv')
    command = f'exec {sys.executable} -m obbhbb_ros.cli convert {ships} {out} {closed}'
    assert subprocess.run(['sh', '-c', command], check=False).returncode == 0
    assert out.stat().st_size > 1000


# Interrupted ----------------------------------------------------------------------------------

LONG = {
    'convert': ['convert', 'SHIPS', 'OUT.csv'],
    'evaluate': ['evaluate', 'SHIPS', '--bootstrap', '1000000'],
    'calibrate': ['calibrate', 'SHIPS', '--grid', 'wide', '--folds', '200', '--per-class'],
    'report': ['report', 'SHIPS', '--gallery', '10000', '-o', 'OUT.html'],
    'chips': ['chips', 'SHIPS'],
}


# The signal comes from the command's own process: from here it may come when all is done. Before
# NumPy is loaded, Python itself may be interrupted.
INTERRUPTED = """
import os, signal, sys, threading, time
from obbhbb_ros.cli import main

def interrupt():
    while 'numpy' not in sys.modules:
        time.sleep(0.01)
    time.sleep(0.3)
    os.kill(os.getpid(), signal.SIGINT)

threading.Thread(target=interrupt, daemon=True).start()
sys.exit(main())
"""


def scattered_row(number: int) -> str:
    """Lay a ship apart from those before it in its image, so that their chips are not merged."""
    row = ROW.format(number % 10, number).strip().split(',')
    at = (97 * number % 4000, 61 * number % 4000)
    return ','.join([*row[:3], *(str(int(xy) + at[i % 2]) for i, xy in enumerate(row[3:]))]) + '\n'


@pytest.mark.parametrize('arguments', LONG.values(), ids=LONG)
def test_ctrl_c_ends_a_command_silently(ships: Path, arguments: list[str]) -> None:
    ships.write_text(HEAD + ''.join(map(scattered_row, range(100_000))))
    for i in range(10):
        Image.new('L', (4096, 4096)).save(ships.with_name(f'P{i}.png'))
    command = [
        {'SHIPS': str(ships)}.get(each, each.replace('OUT', str(ships.with_name('out'))))
        for each in arguments
    ]
    process = subprocess.Popen(
        [sys.executable, '-c', INTERRUPTED, *command],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        # A shell that starts it in the background has SIGINT ignored.
        preexec_fn=lambda: signal.signal(  # noqa: PLW1509
            signal.SIGINT, signal.default_int_handler
        ),
    )
    _, printed = process.communicate(timeout=60)
    # To a shell both are 130. Python ends itself by the signal, whatever the code, if it came while
    # an extension was imported.
    assert process.returncode in (130, -signal.SIGINT)
    assert 'Traceback' not in printed
    assert 'KeyboardInterrupt' not in printed
    assert not list(ships.parent.glob('out*'))


def test_a_terminated_command_leaves_nothing_behind(ships: Path) -> None:
    ships.write_text(HEAD + ''.join(ROW.format(i % 10, i) for i in range(100_000)))
    folder = ships.with_name('target')
    folder.mkdir()
    # On a disk that takes long, so that it does not end before it is told to.
    program = (
        'import os, sys, time; from obbhbb_ros.cli import main; '
        'os.fsync = lambda _: time.sleep(60); sys.exit(main())'
    )
    process = subprocess.Popen(
        [sys.executable, '-c', program, 'convert', str(ships), str(folder / 'out.csv')]
    )
    while not any(folder.iterdir()):
        assert process.poll() is None
        time.sleep(0.001)
    process.terminate()
    assert process.wait(timeout=60) == 128 + signal.SIGTERM
    assert list(folder.iterdir()) == []


def test_a_reader_may_close_the_output_early(ships: Path) -> None:
    reading, writing = os.pipe()
    process = subprocess.Popen(
        [*OBBHBB, 'evaluate', ships, '--bootstrap', '10'],
        stdout=writing,
        stderr=subprocess.PIPE,
        text=True,
    )
    os.close(writing)
    os.close(reading)
    _, printed = process.communicate(timeout=60)
    assert printed == ''
    assert process.returncode == 128 + signal.SIGPIPE


def test_a_file_may_be_the_standard_output(ships: Path) -> None:
    done = subprocess.run(
        [*OBBHBB, 'convert', ships, '/dev/stdout', '--to', 'csv'],
        check=True,
        stdout=subprocess.PIPE,
        text=True,
        timeout=60,
    )
    assert len(done.stdout.splitlines()) > 400


# Hostile input ---------------------------------------------------------------------------------


def test_a_pipe_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    os.mkfifo(tmp_path / 'labels.csv')
    assert main(['convert', str(tmp_path / 'labels.csv'), str(tmp_path / 'out.csv')]) == 1
    assert capsys.readouterr().err == (
        f'obbhbb: {tmp_path / "labels.csv"}: neither a regular file nor a folder\n'
    )


SQUARE = [10, 10, 30, 10, 30, 30, 10, 30]
BAD_ANNOTATIONS = {
    'a polygon far out': {'segmentation': [[1e308, 0, 0, 1e308, -1e308, 5]]},
    'a box far out': {'segmentation': [], 'bbox': [1e308, 1e308, 1e308, 1e308]},
    'a class with half a character': {'category_id': 2},
    'an image with half a character': {'image_id': 2},
    'an id with half a character': {'id': 'x\ud800'},
}


@pytest.mark.parametrize('suffix', ['json', 'csv', 'geojson', 'shp'])
@pytest.mark.parametrize('bad', BAD_ANNOTATIONS.values(), ids=BAD_ANNOTATIONS)
def test_only_the_bad_record_of_a_coco_file_is_lost(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], bad: dict[str, object], suffix: str
) -> None:
    good = {'id': 1, 'image_id': 1, 'category_id': 1, 'segmentation': [SQUARE]}
    images = [{'id': 1, 'file_name': 'a.png', 'width': 99, 'height': 99}]
    images.append({**images[0], 'id': 2, 'file_name': 'b\ud800.png'})
    document = {
        'images': images[: 1 + ('image_id' in bad)],
        'categories': [{'id': 1, 'name': 'ship'}, {'id': 2, 'name': 'a\ud800'}][
            : 1 + ('category_id' in bad)
        ],
        'annotations': [good, {**good, **bad}, good],
    }
    path = tmp_path / 'all.json'
    path.write_text(json.dumps(document))
    out = tmp_path / f'out.{suffix}'
    to = {'json': 'coco', 'shp': 'shapefile'}.get(suffix, suffix)
    assert main(['convert', str(path), str(out), '--to', to]) == 0
    printed = capsys.readouterr()
    assert '2 boxes converted' in printed.out
    assert 'annotations[1]' in printed.err or 'box 2 left out' in printed.err
    assert sum(len(labels.class_ids) for labels in read_labels(out, to)) == 2


def test_boxes_whose_area_overflows_are_left_out_and_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / 'all.csv'
    far = 'a,7,ship,1e308,0,-1e308,0,9,5,0,5,,,,\n'
    path.write_text(HEAD + ROW.format(1, 1) + far + ROW.format(1, 2))
    assert main(['convert', str(path), str(tmp_path / 'out.json'), '--to', 'coco']) == 0
    assert "image 'a': box 1 left out: overflow" in capsys.readouterr().err


def test_chips_holds_few_pictures_at_a_time(tmp_path: Path) -> None:
    size = 1000
    for i in range(20):
        Image.new('RGB', (size, size)).save(tmp_path / f'{i}.png')
        (tmp_path / f'{i}.txt').write_text('10 10 90 10 90 40 10 40 ship 0\n')
    tracemalloc.start()
    try:
        assert main(['chips', str(tmp_path)]) == 0
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert peak < 10 * 3 * size**2
