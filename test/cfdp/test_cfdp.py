# SPDX-License-Identifier: Apache-2.0
"""An outbox survives the way down: CFDP class 2 over a link that loses every tenth PDU."""

import json
import socket
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from hashlib import sha256
from pathlib import Path
from random import Random

import pytest
from bus import Bus
from bus import waiting
from ground import Ground
from link import Link
from outboxes import a_chip
from outboxes import make_outbox
from outboxes import put
from spooled import CAMERA

from obbhbb_ros.cli import main
from obbhbb_ros.spool.compact_json import without_camera
from obbhbb_ros.spool.outbox import Outbox

# Long, and about DDS, SQLite and files rather than NumPy and Pillow.
pytestmark = pytest.mark.once

HERE = Path(__file__).parent
LOSS = 0.1
# Seconds; short, as nothing is far away.
TIMEOUT = 0.05
# Of the bus, where nothing gets lost: the ground may be kept from answering.
PATIENCE = 5.0


@contextmanager
def station(folder: Path, loss: float = LOSS) -> Iterator[tuple[Ground, Link, Link]]:
    """Run a ground station; gives it, and both ends of the link."""
    below = Link(('127.0.0.1', 0), None, loss, seed=1)
    above = Link(('127.0.0.1', 0), below.address, loss, seed=2)
    ground = Ground(below, folder, TIMEOUT)
    stop = threading.Event()

    def serve() -> None:
        while not stop.is_set():
            ground.serve(TIMEOUT / 4.0)

    thread = threading.Thread(target=serve)
    thread.start()
    try:
        yield ground, above, below
    finally:
        stop.set()
        thread.join()
        above.close()
        below.close()


def digests(folder: Path) -> dict[str, str]:
    """Give the sha256 of each file by its name in the folder."""
    return {
        str(path.relative_to(folder)): sha256(path.read_bytes()).hexdigest()
        for path in folder.rglob('*')
        if path.is_file()
    }


def deliver_all(bus: Bus, outbox: Path) -> None:
    """Deliver what is in an outbox; a few files take more than one try."""
    for _ in range(500):
        if waiting(outbox):
            bus.deliver(outbox)


def test_every_file_arrives_whole_and_only_then_leaves_the_outbox(tmp_path) -> None:
    outbox, down = tmp_path / 'outbox', tmp_path / 'down'
    stated = {
        path.stem: json.loads(path.read_bytes())['sha256'] for path in make_outbox(outbox, 24)
    }
    released = digests(outbox)
    with station(down) as (_, above, below):
        deliver_all(Bus(above, TIMEOUT), outbox)
        assert above.lost > 10
        assert below.lost > 5
    assert digests(outbox) == {}
    assert digests(down) == released
    chips = {Path(name).stem: digest for name, digest in released.items() if '.jpg' in name}
    assert chips == stated


def test_level_0_comes_first_and_a_json_after_its_chip(tmp_path) -> None:
    for value in (0.1, 0.9, 0.6, 0.95):
        put(tmp_path / 'outbox', *a_chip(id=f'of_{value}', value=value))
    with station(tmp_path / 'down') as (ground, above, _):
        deliver_all(Bus(above, TIMEOUT), tmp_path / 'outbox')
    # In level 0 in the order of release.
    names = ['0/of_0.9', '0/of_0.95', '1/of_0.6', '2/of_0.1']
    first = list(dict.fromkeys(ground.arrived))
    assert first == [f'{name}{suffix}' for name in names for suffix in ('.jpg', '.json')]


def test_a_chip_released_to_level_0_meanwhile_is_next(tmp_path) -> None:
    for value in (0.1, 0.2):
        put(tmp_path / 'outbox', *a_chip(id=f'of_{value}', value=value))
    with station(tmp_path / 'down', loss=0.0) as (ground, above, _):
        bus = Bus(above, PATIENCE)
        assert bus.deliver(tmp_path / 'outbox')
        put(tmp_path / 'outbox', *a_chip(id='late', value=0.9))
        assert bus.deliver(tmp_path / 'outbox')
    assert ground.arrived[-1] == '0/late.json'


@pytest.mark.parametrize('name', ['0/a.jpg', '0/.a.json', '0/.a.jpg', 'notes.json', 'other/a.json'])
def test_what_is_not_complete_or_no_chip_is_not_sent(tmp_path, name) -> None:
    (tmp_path / name).parent.mkdir(exist_ok=True)
    (tmp_path / name).touch()
    assert waiting(tmp_path) == []


def test_nothing_leaves_the_outbox_while_nobody_answers(tmp_path) -> None:
    make_outbox(tmp_path, 1)
    released = digests(tmp_path)
    with station(tmp_path / 'down', loss=1.0) as (ground, above, _):
        assert not Bus(above, TIMEOUT).deliver(tmp_path)
    assert digests(tmp_path) == released
    assert ground.arrived == []


def test_a_removal_that_was_interrupted_is_completed_without_sending_again(tmp_path) -> None:
    (record,) = make_outbox(tmp_path / 'outbox', 1)
    record.with_suffix('.jpg').unlink()
    with station(tmp_path / 'down', loss=0.0) as (ground, above, _):
        assert Bus(above, TIMEOUT).deliver(tmp_path / 'outbox')
    assert not record.exists()
    assert above.sent == 0
    assert ground.arrived == []


def test_noise_on_the_link_does_no_harm(tmp_path) -> None:
    make_outbox(tmp_path / 'outbox', 3)
    released = digests(tmp_path / 'outbox')
    with (
        station(tmp_path / 'down', loss=0.0) as (_, above, below),
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as noise,
    ):
        bus, random = Bus(above, PATIENCE), Random(3)
        while waiting(tmp_path / 'outbox'):
            for end in (above, below):
                noise.sendto(random.randbytes(40), ('127.0.0.1', end.address[1]))
            assert bus.deliver(tmp_path / 'outbox')
    assert digests(tmp_path / 'down') == released


@pytest.mark.parametrize('name', ['../a', '0/../../a', '/tmp/not_ours'])
def test_the_ground_takes_no_file_outside_its_folder(tmp_path, name) -> None:
    (tmp_path / 'file').write_text('chip')
    with station(tmp_path / 'in' / 'down', loss=0.0) as (_, above, _):
        assert not Bus(above, TIMEOUT).send(tmp_path / 'file', name)
    assert list(digests(tmp_path)) == ['file']
    assert not Path('/tmp/not_ours').exists()


def test_the_two_programs_fill_the_gallery(tmp_path, capsys) -> None:
    make_outbox(tmp_path / 'outbox', 4)
    # The fifth pair is a camera: to the bus it is one like any other.
    _, camera = without_camera({'camera': CAMERA})
    outbox = Outbox(tmp_path / 'outbox')
    outbox.add(camera.id, 'camera', camera.content, camera.json_bytes(), 0)
    outbox.finish()
    lossy = ['--loss', str(LOSS), '--timeout', str(TIMEOUT)]
    with subprocess.Popen(
        [sys.executable, str(HERE / 'ground.py'), str(tmp_path / 'down'), '--port', '0', *lossy],
        stdout=subprocess.PIPE,
        text=True,
    ) as ground:
        address = ground.stdout.readline().split()[-1]
        said = subprocess.run(
            [
                sys.executable,
                str(HERE / 'bus.py'),
                str(tmp_path / 'outbox'),
                '--to',
                address,
                '--once',
                *lossy,
            ],
            check=True,
            capture_output=True,
            text=True,
            timeout=60,
        ).stdout
        ground.terminate()
    assert said.startswith('5 chips delivered, ')
    assert digests(tmp_path / 'outbox') == {}
    assert main(['gallery', str(tmp_path / 'down'), '-o', str(tmp_path / 'page.html')]) == 0
    assert 'chips: 4, problems: 0\ncameras: 1\n' in capsys.readouterr().out
