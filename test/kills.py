# SPDX-License-Identifier: Apache-2.0
"""The way of chips from image to bus, with its nodes killed at random moments."""

from __future__ import annotations

import hashlib
import json
import os
import random
import signal
import threading
import time
from collections import Counter
from collections.abc import Callable
from collections.abc import Iterable
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
from harness import NodeProcess
from harness import Peer
from harness import Site
from harness import payload_process
from harness import site_at
from rclpy.qos import QoSProfile
from sensor_msgs.msg import Image
from ships import detections
from std_msgs.msg import Header
from vision_msgs.msg import Detection2DArray

from obbhbb_ros.nodes.player_messages import image_message
from obbhbb_ros.spool.books import Status
from obbhbb_ros.spool.console import SpoolConsole

SIDE, CHIPS = 256, 100
# As of `ship_tracker`.
SESSION = 'c0ffee00'
# Of a camera that passes: chips of a frame, and how many ships enter with it. So a ship is seen
# once or twice.
PASSING_CHIPS, ENTERING = 20, 15
# Frames that may be on their way when a node is killed.
IN_FLIGHT = 10
PERIOD = 0.1


class Bus:
    """Takes files from an outbox as the bus does, and checks each."""

    def __init__(self, outbox: Path) -> None:
        self._outbox = outbox
        self.taken: Counter[str] = Counter()
        # Numbers of the views of each object, by chip.
        self.views: dict[str, dict[str, int]] = {}
        self.wrong: list[str] = []
        self._is_stopping = False
        self._thread = threading.Thread(target=self._work)
        self._thread.start()

    def stop(self) -> None:
        self._is_stopping = True
        self._thread.join()

    def _work(self) -> None:
        while not self._is_stopping:
            for path in sorted(self._outbox.glob('*/*.json')):
                if not path.name.startswith('.'):
                    self._take(path)
            time.sleep(0.02)

    def _take(self, path: Path) -> None:
        try:
            facts = json.loads(path.read_text(encoding='utf-8'))
            (file,) = (other for other in path.parent.glob(f'{path.stem}.*') if other != path)
            content = file.read_bytes()
            if hashlib.sha256(content).hexdigest() != facts['sha256']:
                self.wrong.append(f'{path}: another file')
            self.taken[facts['id']] += 1
            self.note(facts, content)
        except (OSError, ValueError) as error:
            self.wrong.append(f'{path}: {error!r}')
            return
        file.unlink()
        path.unlink()

    def note(self, facts: dict[str, Any], content: bytes) -> None:
        """Note what came down; ValueError if that cannot be read."""
        self.views.setdefault(facts['object'], {})[facts['id']] = facts['view']


class Chain(ExitStack):
    """
    `chip_extractor` and `downlink` under load, with a bus that takes what comes.

    They run in a process each, or both in one. The camera sees the same ships all the time, or
    passes over others.
    """

    def __init__(
        self, site: Site, folder: Path, one_process: bool = False, is_passing: bool = False
    ) -> None:
        super().__init__()
        self._site, self._folder = site, folder
        self._chips, self._entering = (PASSING_CHIPS, ENTERING) if is_passing else (CHIPS, 0)
        # No ship of a pass may be evicted.
        self._max_bytes = 0.0 if is_passing else 3e6
        # Not the name of the folder: two underscores in a row, which `tempfile` draws now and
        # then, are no namespace.
        self._namespace = f'/kills_{os.getpid()}'
        self._plan = self._make_plan()
        pixels = np.random.default_rng(3).integers(0, 256, (SIDE, SIDE)).astype(np.uint8)
        self._image = image_message('mono8', pixels, Header())
        self._open_peer()
        self.callback(self._close_peer)
        self.sent = 0
        self.nodes: dict[str, NodeProcess] = {}
        self.programs = ('payload',) if one_process else ('chip_extractor', 'downlink')
        for name in self.programs:
            self.start(name)
        self.bus = Bus(folder / 'outbox')
        self.callback(self.bus.stop)
        self.callback(lambda: [node.close() for node in self.nodes.values()])
        self.books = SpoolConsole(folder / 'spool', print)

    def _open_peer(self) -> None:
        """Make the peer and its publishers, in a participant of their own."""
        self._peer_stack = ExitStack()
        site = self._peer_stack.enter_context(site_at())
        self.peer = self._peer_stack.enter_context(Peer(site.context, self._namespace))
        deep = QoSProfile(depth=100)
        self._plans = self.peer.node.create_publisher(Detection2DArray, 'crop_regions', deep)
        self._images = self.peer.node.create_publisher(Image, 'image', deep)

    def _close_peer(self) -> None:
        self._peer_stack.close()

    def renew_peer(self) -> None:
        """
        Replace the peer.

        Fast DDS never frees the shared memory that a killed subscriber had not read: that of a
        publisher, 64 MB, is used up after some two hundred kills, and it cannot send any more.
        """
        self._close_peer()
        self._open_peer()

    def _make_plan(self) -> Any:
        plan = detections(
            [(8 + 12 * (i % 20), 8 + 12 * (i // 20), 12, 12, 0.0) for i in range(self._chips)]
        )
        for i, detection in enumerate(plan.detections):
            detection.results[0].hypothesis.score = (i + 1) / self._chips
        return plan

    def start(self, name: str) -> None:
        spool = {'spool.path': self._folder / 'spool'}
        parameters = {
            'chip_extractor': spool | {'codec': 'png', 'spool.max_bytes': self._max_bytes},
            'downlink': spool
            | {
                'outbox.path': self._folder / 'outbox',
                'acknowledge': 'removal',
                'outbox.max_bytes': 300_000.0,
            },
        }
        self.nodes[name] = (
            payload_process(self._folder / 'payload', self._namespace, parameters)
            if name == 'payload'
            else self._site.start(name, namespace=self._namespace, parameters=parameters[name])
        )

    def send(self) -> None:
        """Send an image and its plan."""
        for detection, name in zip(self._plan.detections, self._ships(self.sent), strict=True):
            detection.id = name
        self.sent += 1
        for message, publisher in ((self._image, self._images), (self._plan, self._plans)):
            message.header.stamp.sec = self.sent
            publisher.publish(message)

    def _ships(self, frame: int) -> list[str]:
        """Return the ids of the ships in a frame, counted from 0."""
        return [f'{SESSION}-{frame * self._entering + i}' for i in range(self._chips)]

    def ships(self, frames: Iterable[int]) -> set[str]:
        """Return the ids of the ships in frames, counted from 0."""
        return {name for frame in frames for name in self._ships(frame)}

    def run(self, seconds: float) -> None:
        """Keep the load up for some time."""
        self.peer.repeat(seconds, (PERIOD, self.send))

    def run_until(self, condition: Callable[[Status], Any], timeout: float = 90.0) -> Status:
        """Keep the load up until something holds of the books."""
        deadline = time.monotonic() + timeout
        while not condition(status := self.books.status()):
            assert time.monotonic() < deadline, self._state(status)
            self.run(0.2)
        return status

    def _state(self, status: Status) -> str:
        """Tell what is known when it does not go on."""
        logs = [
            f'{name}, pid {node.pid}, {"running" if node.running else "ended"}: {node.log[-2000:]}'
            for name, node in self.nodes.items()
        ]
        return '\n'.join((str(status), *logs))

    def kill(self, *names: str) -> Status:
        """Kill nodes, start them again, and give the books from between."""
        for name in names:
            self.nodes[name].send_signal(signal.SIGKILL)
        for name in names:
            assert self.nodes[name].wait() == -signal.SIGKILL, self.nodes[name].log
        status = self.books.status()
        for name in names:
            self.start(name)
        return status

    def drain(self) -> Status:
        """Stop the load, and wait until everything is delivered."""
        return self._wait(lambda status: not (status.waiting or status.in_outbox or status.in_work))

    def _wait(self, condition: Callable[[Status], Any]) -> Status:
        deadline = time.monotonic() + 120.0
        while not condition(status := self.books.status()):
            assert time.monotonic() < deadline, self._state(status)
            self.peer.spin_to(time.monotonic() + 0.1)
        return status


def run(
    site: Site,
    folder: Path,
    count: int,
    seed: int,
    report: Callable[[str], Any] = print,
    one_process: bool = False,
    is_passing: bool = False,
) -> None:
    """Kill nodes until there are so many kills, and hold the books against what the bus has."""
    draw = random.Random(seed)
    kills = killed_downlinks = 0
    # Frames that nobody was there to take, or whose cutting a kill interrupted.
    excused: set[int] = set()
    is_away, last_heard = True, 0
    with Chain(site, folder, one_process, is_passing) as chain:
        choices = [*((name,) for name in chain.programs), chain.programs]
        if is_passing and not one_process:
            # While `chip_extractor` is away ships are missed.
            choices += [('downlink',)] * 4
        while kills < count:
            before = chain.books.status().counts
            chain.run_until(
                lambda status, before=before: all(
                    status.counts.get(name, 0) > before.get(name, 0)
                    for name in ('planned', 'released')
                )
            )
            if is_away:
                excused |= {*range(last_heard, chain.sent)}
            chain.run(draw.uniform(0.0, 0.4))
            names = draw.choice(choices)
            is_away, last_heard = names != ('downlink',), max(chain.sent - IN_FLIGHT, 0)
            status = chain.kill(*names)
            assert status.balance == 0, status
            kills += len(names)
            killed_downlinks += names[-1] != 'chip_extractor'
            if kills % 100 < len(names):
                chain.renew_peer()
            if kills % 50 < 2:
                report(f'{kills} kills: {dict(status.counts)}')
        # The frame that the last kill interrupted is settled by the next one.
        before = chain.books.status().counts
        chain.run_until(lambda status: status.counts['planned'] > before['planned'])
        if is_away:
            excused |= {*range(last_heard, chain.sent)}
        chain.run(1.0)
        status = chain.drain()
        assert status.balance == 0, status
        chain.bus.stop()
    assert not chain.bus.wrong, chain.bus.wrong
    assert len(chain.bus.taken) == status.counts['delivered'], (len(chain.bus.taken), status)
    sent, due = chain.ships(range(chain.sent)), chain.ships(set(range(chain.sent)) - excused)
    assert chain.bus.views.keys() <= sent
    assert not due - chain.bus.views.keys(), (sorted(due - chain.bus.views.keys()), excused)
    # No view is lost, neither the first one nor one between. A spool of 3 MB, as for a camera that
    # stands still, forgets ships of which no view is among the last 1000 released.
    for name, views in chain.bus.views.items():
        counted = sorted(views.values()) == list(range(1, len(views) + 1))
        assert counted or not is_passing, (name, views)
    twice = sum(number - 1 for number in chain.bus.taken.values())
    # Those whose release was not recorded yet: a batch for each kill, at most.
    assert twice <= 16 * killed_downlinks
    report(
        f'{kills} kills, {chain.sent} frames sent; {dict(status.counts)}; '
        f'{len(chain.bus.taken)} chips taken by the bus, {twice} of them twice; none wrong; '
        f'{len(chain.bus.views)} of {len(sent)} ships, all of the {len(due)} that were to come'
    )
