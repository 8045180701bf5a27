# SPDX-License-Identifier: Apache-2.0
"""Several nodes in one process: they work, change and end as they do alone."""

from __future__ import annotations

import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from harness import Node
from harness import Site
from harness import payload_process
from harness import values_of
from lifecycle_msgs.msg import Transition
from sensor_msgs.msg import CompressedImage
from sensor_msgs.msg import Image
from ships import detections
from vision_msgs.msg import Detection2DArray

from obbhbb_ros.nodes.player_messages import image_message
from obbhbb_ros.nodes.running.executables import PAYLOAD_NODES
from obbhbb_ros.nodes.running.last_run import read_run

# They depend on rclpy alone, which is the same in all environments.
pytestmark = pytest.mark.once

CHAIN = ('obb_to_hbb', 'chip_extractor', 'downlink')
PAYLOAD = [sys.executable, '-m', 'obbhbb_ros.nodes', 'payload']


class Payload(Node):
    """The chain in one process; `of` gives the other nodes of it."""

    def __init__(self, site: Site, folder: Path, command: list[str] = PAYLOAD) -> None:
        super().__init__(site, CHAIN[0])
        self._folder, self._command = folder, command
        self.chips = self.peer.collect(CompressedImage, 'chip/compressed')
        self.run()

    def run(self) -> None:
        """Start the process."""
        spool = {'spool.path': self._folder / 'spool'}
        facts: dict[str, dict[str, Any]] = {
            'obb_to_hbb': {'image_width': 120, 'image_height': 100},
            'chip_extractor': spool,
            'downlink': spool | {'outbox.path': self._folder / 'outbox'},
        }
        parameters = {
            name: {'state.path': self.state_file(name), 'watchdog_timeout': 2.0} | facts[name]
            for name in CHAIN
        }
        self.process = payload_process(self._folder, self.namespace, parameters, self._command)

    def state_file(self, name: str) -> Path:
        return self._folder / f'{name}.json'

    def of(self, name: str) -> Node:
        """Return a node of the process, to call and to read."""
        node = Node(self._site, name, self.namespace)
        node.process = self.process
        return node

    def connect(self) -> None:
        self.images = self.peer.publisher(Image, 'image')
        self.detections = self.peer.publisher(Detection2DArray, 'detections')
        self.send_until(self.send, lambda: self.chips, 'a first chip')

    def send(self) -> None:
        """Publish an image and a ship in it."""
        message = detections([(60, 50, 40, 20, 0)])
        self.stamped(message)
        pixels = np.full((100, 120), 128, np.uint8)
        self.images.publish(image_message('mono8', pixels, message.header))
        self.detections.publish(message)


@pytest.fixture
def payload(site: Site, tmp_path: Path) -> Iterator[Payload]:
    with Payload(site, tmp_path) as node:
        yield node


def test_the_whole_chain_runs_in_one_process(payload: Payload, tmp_path: Path) -> None:
    payload.connect()
    payload.wait(lambda: list((tmp_path / 'outbox').glob('*/*.jpg')), 'a chip in the outbox')
    for name in CHAIN:
        with_name = payload.of(name)
        assert with_name.next_report().name == f'{payload.namespace}/{name}'.lstrip('/')
        assert with_name.state() == 'active'


def test_every_node_has_its_own_parameters_and_lifecycle(payload: Payload) -> None:
    converter, cutter = payload.of('obb_to_hbb'), payload.of('chip_extractor')
    converter.set({'input_timeout': 7.0})
    cutter.set({'input_timeout': 9.0})
    assert (converter.get('input_timeout'), cutter.get('input_timeout')) == ([7.0], [9.0])
    assert cutter.change_state(Transition.TRANSITION_DEACTIVATE)
    assert (converter.state(), cutter.state()) == ('active', 'inactive')


@pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_all_nodes_cleanly(payload: Payload, number: int) -> None:
    payload.connect()
    payload.process.send_signal(number)
    payload.process.send_signal(number)
    assert payload.process.wait() == 0
    for name in CHAIN:
        run = read_run(payload.state_file(name).read_bytes())
        assert (run.ended, run.asked) == (signal.Signals(number).name, True)


def test_after_a_crash_every_node_reports_it(payload: Payload) -> None:
    payload.connect()
    payload.process.send_signal(signal.SIGSEGV)
    assert payload.process.wait() == -signal.SIGSEGV
    payload.run()
    for name in CHAIN:
        values = values_of(payload.of(name).next_report())
        assert values['last_run.ended'] == 'crashed: Segmentation fault (SIGSEGV)'
        assert values['restarts'] == '1'


STUCK = """
import signal, sys, time
# Before libraries start threads, as the executables do.
signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT, signal.SIGTERM])
from obbhbb_ros.nodes import __main__ as nodes
from obbhbb_ros.nodes.chip_topics import FrameTopics
real, count = FrameTopics.publish, []
def publish(self, chip, data):
    real(self, chip, data)
    count.append(1)
    if len(count) == 3:
        time.sleep(1_000_000)
FrameTopics.publish = publish
sys.exit(nodes.run_executable('payload'))
"""


def test_a_node_that_is_stuck_ends_the_process_and_is_named(site: Site, tmp_path: Path) -> None:
    with Payload(site, tmp_path, [sys.executable, '-c', STUCK]) as payload:
        payload.connect()
        payload.peer.spin_until(lambda: payload.send() or not payload.process.running, 'the end')
        assert payload.process.wait() == 70
        for name in CHAIN:
            run = read_run(payload.state_file(name).read_bytes())
            assert run.ended.startswith(
                'watchdog: no turn of the executor of chip_extractor for 2 s, in '
            )


# How it cannot start --------------------------------------------------------------------------


@pytest.mark.parametrize(
    ('arguments', 'reason'),
    [
        (['--nodes', 'obb_to_hbb', 'player'], '--nodes: player is none of obb_to_hbb, '),
        (['--nodes', 'overlay', 'overlay'], 'each of them once'),
        (['--nodes'], 'at least one'),
        (['--node', 'overlay'], 'unknown arguments: --node overlay'),
        (['--ros-args', '-p', 'q:=0.5'], 'obb_to_hbb: q must be 1 to inf'),
        (['--ros-args', '-p', 'spool.path:=here'], 'chip_extractor: spool.path'),
        (
            ['--nodes', 'obb_to_hbb', 'overlay', '--ros-args', '-r', '__node:=payload'],
            'several nodes are named /payload',
        ),
    ],
)
def test_what_stops_the_start_is_named(arguments: list[str], reason: str) -> None:
    done = subprocess.run(
        [*PAYLOAD, *arguments], check=False, capture_output=True, text=True, timeout=60
    )
    assert (done.returncode, done.stdout) == (1, '')
    (line,) = (line for line in done.stderr.splitlines() if 'cannot start' in line)
    assert reason in line


def test_help_lists_the_nodes() -> None:
    done = subprocess.run([*PAYLOAD, '--help'], check=True, capture_output=True, text=True)
    assert all(name in done.stdout for name in PAYLOAD_NODES)
