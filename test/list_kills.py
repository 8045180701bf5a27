# SPDX-License-Identifier: Apache-2.0
"""The way of ships from detections to the lists of a bus, its nodes killed at random moments."""

from __future__ import annotations

import os
import random
import signal
import time
from collections import defaultdict
from collections.abc import Callable
from collections.abc import Iterable
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
from geometry_msgs.msg import PoseStamped
from harness import NodeProcess
from harness import Peer
from harness import Site
from harness import payload_process
from harness import site_at
from kills import Bus
from rclpy.qos import QoSProfile
from sensor_msgs.msg import CameraInfo
from ships import detections
from vision_msgs.msg import Detection2DArray

from obbhbb_ros import OrientedBoxes
from obbhbb_ros.earth.ellipsoid import to_ecef
from obbhbb_ros.earth.pinhole import Pinhole
from obbhbb_ros.earth.placement import place
from obbhbb_ros.earth.pose import CameraPose
from obbhbb_ros.reports.ship_list import read_ship_list
from obbhbb_ros.reports.ship_report import ShipReport
from obbhbb_ros.spool.list_spool import ListSpool
from obbhbb_ros.spool.list_spool import ListStatus

# As of `ship_tracker`.
SESSION = 'c0ffee00'
PERIOD, REPORT_PERIOD = 0.1, 0.3
# Ships of a frame, and how many of them are new.
SHIPS, ENTERING = 20, 15
# A ship has one of so many places in the image, by its number.
COLUMNS = 40
# Frames that may be on their way, or wait for the end of a period, when a node is killed: three
# seconds, for a machine that is busy.
IN_FLIGHT = 30
SIDE = 1024
# 500 km above the equator, looking down.
POSITION, ATTITUDE = (6878137.0, 0.0, 0.0), (0.5, 0.5, -0.5, -0.5)
K = (1e6 / 3, 0.0, 511.5, 0.0, 1e6 / 3, 511.5, 0.0, 0.0, 1.0)
BOXES = [(24.0 + 24.0 * column, 300.0 + 10.0 * column, 20.0, 6.0, 0.3) for column in range(COLUMNS)]


class ListBus(Bus):
    """Takes ship lists, and remembers what they say of each ship."""

    def __init__(self, outbox: Path) -> None:
        self.reports: dict[str, list[ShipReport]] = defaultdict(list)
        super().__init__(outbox)

    def note(self, facts: dict[str, Any], content: bytes) -> None:
        """Read a list that is complete; the same one again says nothing new."""
        ships = read_ship_list(content)
        if len(ships) != facts['ships']:
            self.wrong.append(f'{facts["id"]}: {len(ships)} ships of {facts["ships"]}')
        if self.taken[facts['id']] == 1:
            for ship in ships:
                self.reports[ship.id].append(ship)


class ListChain(ExitStack):
    """`ship_tracker` and `downlink` under load, in a process each or both in one."""

    def __init__(self, site: Site, folder: Path, one_process: bool) -> None:
        super().__init__()
        self._site, self._folder = site, folder
        self._namespace = f'/list_kills_{os.getpid()}'
        self._open_peer()
        self.callback(self._close_peer)
        self.sent = 0
        self.nodes: dict[str, NodeProcess] = {}
        self.programs = ('payload',) if one_process else ('ship_tracker', 'downlink')
        for name in self.programs:
            self.start(name)
        self.bus = ListBus(folder / 'outbox')
        self.callback(self.bus.stop)
        self.callback(lambda: [node.close() for node in self.nodes.values()])
        self.books = ListSpool(folder / 'spool', print)

    def _open_peer(self) -> None:
        self._peer_stack = ExitStack()
        site = self._peer_stack.enter_context(site_at())
        self._peer = self._peer_stack.enter_context(Peer(site.context, self._namespace))
        create = self._peer.node.create_publisher
        deep = QoSProfile(depth=100)
        self._publishers = [
            create(kind, topic, deep)
            for kind, topic in (
                (CameraInfo, 'camera_info'),
                (PoseStamped, 'camera_pose'),
                (Detection2DArray, 'detections'),
            )
        ]

    def _close_peer(self) -> None:
        self._peer_stack.close()

    def renew_peer(self) -> None:
        """Replace the peer; `kills.Chain.renew_peer` says why."""
        self._close_peer()
        self._open_peer()

    def start(self, name: str) -> None:
        spool = {'spool.path': self._folder / 'spool'}
        parameters = {
            'ship_tracker': spool | {'pose_type': 'PoseStamped', 'report_period': REPORT_PERIOD},
            'downlink': spool | {'outbox.path': self._folder / 'outbox', 'acknowledge': 'removal'},
        }
        self.nodes[name] = (
            payload_process(self._folder / 'payload', self._namespace, parameters)
            if name == 'payload'
            else self._site.start(name, namespace=self._namespace, parameters=parameters[name])
        )

    def send(self) -> None:
        """Send the camera, its pose and the detections of a frame."""
        numbers = numbers_of(self.sent)
        self.sent += 1
        message = detections([BOXES[number % COLUMNS] for number in numbers])
        for detection, number in zip(message.detections, numbers, strict=True):
            detection.id = f'{SESSION}-{number}'
        pose = PoseStamped()
        pose.header.frame_id = 'earth'
        where, attitude = pose.pose.position, pose.pose.orientation
        where.x, where.y, where.z = POSITION
        attitude.x, attitude.y, attitude.z, attitude.w = ATTITUDE
        camera = CameraInfo(width=SIDE, height=SIDE, k=K)
        for publisher, stamped in zip(self._publishers, (camera, pose, message), strict=True):
            stamped.header.stamp.sec = self.sent
            publisher.publish(stamped)

    def run(self, seconds: float) -> None:
        """Keep the load up for some time."""
        self._peer.repeat(seconds, (PERIOD, self.send))

    def run_until(self, condition: Callable[[ListStatus], Any]) -> ListStatus:
        """Keep the load up until something holds of the books."""
        return self._wait(condition, lambda: self.run(0.2))

    def drain(self) -> ListStatus:
        """Stop the load, and wait until everything is delivered."""

        def is_empty(status: ListStatus) -> bool:
            return not (status.ships_waiting or status.ships_claimed or status.in_outbox)

        # The ships of the last period come first.
        self._peer.spin_to(time.monotonic() + 3 * REPORT_PERIOD)
        return self._wait(is_empty, lambda: self._peer.spin_to(time.monotonic() + 0.1))

    def _wait(self, condition: Callable[[ListStatus], Any], step: Callable[[], Any]) -> ListStatus:
        deadline = time.monotonic() + 90.0
        while not condition(status := self.books.status()):
            logs = [f'{name}: {node.log[-2000:]}' for name, node in self.nodes.items()]
            assert time.monotonic() < deadline, '\n'.join((str(status), *logs))
            step()
        return status

    def kill(self, *names: str) -> ListStatus:
        """Kill nodes, start them again, and give the books from between."""
        for name in names:
            self.nodes[name].send_signal(signal.SIGKILL)
        for name in names:
            assert self.nodes[name].wait() == -signal.SIGKILL, self.nodes[name].log
        status = self.books.status()
        for name in names:
            self.start(name)
        return status


def numbers_of(frame: int) -> range:
    """Return the numbers of the ships in a frame, counted from 0."""
    return range(frame * ENTERING, frame * ENTERING + SHIPS)


def ships_of(frames: Iterable[int]) -> set[str]:
    """Return the ids of the ships in frames."""
    return {f'{SESSION}-{number}' for frame in frames for number in numbers_of(frame)}


def run(
    site: Site,
    folder: Path,
    count: int,
    seed: int,
    report: Callable[[str], Any] = print,
    one_process: bool = False,
) -> None:
    """
    Kill nodes until there are so many kills, and hold the books against what the bus has.

    A kill of `ship_tracker` costs the ships since its last list, and those that nobody was there
    to take. All others must be in a list, in their place.
    """
    draw = random.Random(seed)
    kills = killed_downlinks = 0
    excused: set[int] = set()
    is_away, last_listed = True, 0
    with ListChain(site, folder, one_process) as chain:
        choices = [*((name,) for name in chain.programs), chain.programs]
        while kills < count:
            before = chain.books.status().counts
            chain.run_until(
                lambda status, before=before: all(
                    status.counts.get(name, 0) > before.get(name, 0)
                    for name in ('ships_added', 'released')
                )
            )
            if is_away:
                excused |= {*range(last_listed, chain.sent)}
            chain.run(draw.uniform(0.0, 6.0))
            names = draw.choice(choices)
            is_away, last_listed = names != ('downlink',), max(chain.sent - IN_FLIGHT, 0)
            status = chain.kill(*names)
            assert status.balance == 0, status
            kills += len(names)
            killed_downlinks += names[-1] != 'ship_tracker'
            if kills % 100 < len(names):
                chain.renew_peer()
            if kills % 50 < 2:
                report(f'{kills} kills: {dict(status.counts)}')
        before = chain.books.status().counts
        chain.run_until(lambda status: status.counts['ships_added'] > before['ships_added'])
        if is_away:
            excused |= {*range(last_listed, chain.sent)}
        chain.run(1.0)
        status = chain.drain()
        assert status.balance == 0, status
        chain.bus.stop()
    check(chain, status, excused)
    twice = sum(number - 1 for number in chain.bus.taken.values())
    # Those whose release was not recorded yet: one for each kill, at most.
    assert twice <= killed_downlinks
    due = ships_of({*range(chain.sent)} - excused)
    report(
        f'{kills} kills, {chain.sent} frames sent; {dict(status.counts)}; '
        f'{len(chain.bus.taken)} lists taken by the bus, {twice} of them twice; none wrong; '
        f'{len(chain.bus.reports)} of {len(ships_of(range(chain.sent)))} ships, all of the '
        f'{len(due)} that were to come'
    )


def check(chain: ListChain, status: ListStatus, excused: set[int]) -> None:
    """Hold what the bus has against the books, what was sent, and where that was."""
    bus = chain.bus
    assert not bus.wrong, bus.wrong
    assert len(bus.taken) == status.counts['delivered'], (len(bus.taken), status)
    listed = sum(map(len, bus.reports.values()))
    assert listed == status.counts['ships_released'], (listed, status)
    due = ships_of({*range(chain.sent)} - excused)
    assert bus.reports.keys() <= ships_of(range(chain.sent))
    missing = sorted(due - bus.reports.keys())
    assert not missing, (len(missing), missing[:5], missing[-5:])
    pose = CameraPose.from_message(POSITION, ATTITUDE)
    truth = place(OrientedBoxes.from_xywhr(BOXES), Pinhole(K), pose).points
    for name, reports in bus.reports.items():
        for ship in reports:
            there = to_ecef(ship.latitude, ship.longitude, 0.0)
            off = float(np.linalg.norm(there - truth[int(name.partition('-')[2]) % COLUMNS]))
            assert off < 1.0, (ship, off)
