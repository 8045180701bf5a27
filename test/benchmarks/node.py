# SPDX-License-Identifier: Apache-2.0
"""
Round trip through the node over DDS, against a raw echo and a typed min/max node.

All nodes run at once, each in a process and a namespace of its own, and are asked in turn, so
that whatever slows the machine slows them all. `python test/benchmarks/node.py --help`
"""

from __future__ import annotations

import argparse
import os
import struct
import sys
import time
from collections.abc import Iterator
from collections.abc import Sequence
from contextlib import ExitStack
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from vision_msgs.msg import Detection2DArray

sys.path.insert(0, str(Path(__file__).parents[1]))

from harness import TIMEOUT
from harness import NodeProcess
from harness import Peer
from harness import site_at
from ships import detector_message

from obbhbb_ros.text_tables import text_table
from obbhbb_ros.wire.detections import Detections

TICKS = os.sysconf('SC_CLK_TCK')
PEERS = [sys.executable, str(Path(__file__).with_name('peers.py'))]
# Pixels by which the image moves between two messages.
STEP = 60.0
IMAGE = {'image_width': 4096, 'image_height': 4096}
# The tracker is to follow every box.
PARAMETERS = {
    'obb_to_hbb': IMAGE,
    'ship_tracker': IMAGE | {'ids': 'assign'},
}
TOPICS = {'tracker': ['tracked_detections'], 'ours + crops': ['boxes', 'crop_regions']}
NODES: dict[str, str | list[str]] = {
    'echo': [*PEERS, 'echo'],
    'typed': [*PEERS, 'typed'],
    'ours': 'obb_to_hbb',
    'ours + crops': 'obb_to_hbb',
    'tracker': 'ship_tracker',
}


class Asked:
    """A node in a process of its own, and the topics to ask it by."""

    def __init__(self, name: str, peer: Peer) -> None:
        self.name = name
        namespace = f'{peer.node.get_namespace()}/{"".join(filter(str.isalpha, name))}'
        node = NODES[name]
        given = PARAMETERS[node] if isinstance(node, str) else {}
        self.process = NodeProcess(node, parameters=given, namespace=namespace)
        self._peer = peer
        self._answers = self._asked = 0
        topics = TOPICS.get(name, ['boxes'])
        self._wanted = len(topics)
        self._publisher = peer.node.create_publisher(
            Detection2DArray, f'{namespace}/detections', 10
        )
        for topic in topics:
            peer.node.create_subscription(
                Detection2DArray, f'{namespace}/{topic}', self._count, 10, raw=True
            )

    def _count(self, data: bytes) -> None:
        self._answers += 1

    def ask(self, messages: Sequence[bytes], timeout: float = 5.0) -> float:
        """Send the next message and wait for all that comes of it; seconds, NaN if nothing does."""
        self._answers = 0
        self._asked += 1
        data = stamped(messages[self._asked % len(messages)], self._asked)
        started = time.perf_counter()
        self._publisher.publish(data)
        while self._answers < self._wanted:
            self._peer.spin(0.1)
            if time.perf_counter() - started > timeout:
                return float('nan')
        return time.perf_counter() - started

    def warm_up(self, messages: Sequence[bytes]) -> None:
        """Ask until answers come."""
        deadline = time.monotonic() + TIMEOUT
        while np.isnan(self.ask(messages, 0.5)):
            if time.monotonic() > deadline:
                raise TimeoutError(f'{self.name} does not answer')
        for _ in range(20):
            self.ask(messages)


def moving(data: bytes) -> list[bytes]:
    """Write a message as it looks while the camera passes; who leaves enters on the other side."""
    detections = Detections(data)
    rows, ids = detections.xywhr(), detections.ids()
    messages = []
    for _ in range(40):
        rows[:, 0] = (rows[:, 0] + STEP) % IMAGE['image_width']
        messages.append(detections.with_ids(ids, rows))
    return messages


def stamped(data: bytes, number: int) -> bytes:
    """Give a little-endian message the stamp of an image at ten a second."""
    seconds, tenths = divmod(number, 10)
    return data[:4] + struct.pack('<iI', seconds, tenths * 100_000_000) + data[12:]


@contextmanager
def all_asked() -> Iterator[list[Asked]]:
    """Run all nodes as long as the `with` block lasts."""
    with (
        site_at() as site,
        Peer(site.context, f'/bench_{os.getpid()}') as peer,
        ExitStack() as stack,
    ):
        asked = [Asked(name, peer) for name in NODES]
        for node in asked:
            stack.enter_context(node.process)
        yield asked


def measure(asked: Sequence[Asked], count: int, rounds: int) -> list[list[str]]:
    """Ask all nodes in turn with messages of `count` detections; one row per node."""
    messages = moving(detector_message(count))
    for node in asked:
        node.warm_up(messages)
    times: dict[str, list[float]] = {node.name: [] for node in asked}
    cpu = {node.name: 0.0 for node in asked}
    for _ in range(rounds):
        for node in asked:
            before = node.process.cpu_seconds()
            times[node.name] += [node.ask(messages) for _ in range(20)]
            cpu[node.name] += node.process.cpu_seconds() - before
    medians = {name: np.nanmedian(values) for name, values in times.items()}
    rows = []
    for node in asked:
        values = np.array(times[node.name])
        rows.append(
            [
                str(count),
                node.name,
                f'{medians[node.name] * 1e3:.2f}',
                f'{np.nanpercentile(values, 99) * 1e3:.2f}',
                f'{medians[node.name] / medians["echo"]:.2f}',
                f'{medians["typed"] / medians[node.name]:.1f}',
                f'{cpu[node.name] / values.size * 1e3:.2f}',
                f'{cpu["typed"] / max(cpu[node.name], 1 / TICKS):.1f}',
                f'{node.process.resident_megabytes():.0f}',
                str(int(np.isnan(values).sum())),
            ]
        )
    return rows


HEAD = (
    'detections',
    'node',
    'median [ms]',
    'p99 [ms]',
    'times echo',
    'typed / this',
    'CPU [ms/message]',
    'typed CPU / this',
    'resident [MB]',
    'lost',
)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parser.add_argument('--sizes', type=int, nargs='+', default=[1, 10, 100, 1000])
    parser.add_argument('--rounds', type=int, default=25, help='of 20 messages to each node')
    options = parser.parse_args()
    rows = []
    with all_asked() as asked:
        for count in options.sizes:
            rows += measure(asked, count, options.rounds)
    print(text_table(HEAD, rows))


if __name__ == '__main__':
    main()
