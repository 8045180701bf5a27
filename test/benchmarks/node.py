# SPDX-License-Identifier: Apache-2.0
"""
Round trip through the node over DDS, against a raw echo and a typed min/max node.

All nodes run at once, each in a process and a namespace of its own, and are asked in turn, so
that whatever slows the machine slows them all. `python test/benchmarks/node.py --help`
"""

from __future__ import annotations

import argparse
import os
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.serialization import serialize_message
from vision_msgs.msg import Detection2D
from vision_msgs.msg import Detection2DArray
from vision_msgs.msg import ObjectHypothesisWithPose

from obbhbb_ros.study.tables import text_table

HERE = Path(__file__).parent
TICKS = os.sysconf('SC_CLK_TCK')
OURS = [sys.executable, '-m', 'obbhbb_ros.nodes', 'obb_to_hbb']
IMAGE = ['-p', 'image_width:=4096', '-p', 'image_height:=4096']
NODES = {
    'echo': [sys.executable, str(HERE / 'peers.py'), 'echo'],
    'typed': [sys.executable, str(HERE / 'peers.py'), 'typed'],
    'ours': OURS,
    'ours + crops': OURS,
}


def message(count: int, side: int = 4096) -> bytes:
    """Write `count` detections of an image as a detector would: classes and ids differ."""
    random = np.random.default_rng(count)
    array = Detection2DArray()
    array.header.frame_id = 'camera'
    for i in range(count):
        detection = Detection2D(header=array.header, id=str(i))
        box = detection.bbox
        box.center.position.x, box.center.position.y = random.uniform(100, side - 96, 2)
        box.size_x, box.size_y = random.uniform(20, 200), random.uniform(5, 50)
        box.center.theta = random.uniform(-3, 3)
        result = ObjectHypothesisWithPose()
        result.hypothesis.class_id = ('ship', 'tug', 'tanker')[random.integers(3)]
        result.hypothesis.score = random.uniform()
        detection.results.append(result)
        array.detections.append(detection)
    return serialize_message(array)


class Asked:
    """A node in a process of its own, and the topics to ask it by."""

    def __init__(self, name: str, node: rclpy.node.Node, executor: SingleThreadedExecutor) -> None:
        self.name = name
        namespace = f'/bench_{os.getpid()}_{"".join(filter(str.isalpha, name))}'
        arguments = ['--ros-args', '-r', f'__ns:={namespace}']
        self._process = subprocess.Popen(
            [*NODES[name], *arguments, *(IMAGE if name.startswith('ours') else [])]
        )
        self._executor = executor
        self._answers = 0
        topics = ['boxes', 'crop_regions'] if name.endswith('crops') else ['boxes']
        self._wanted = len(topics)
        self._publisher = node.create_publisher(Detection2DArray, f'{namespace}/detections', 10)
        for topic in topics:
            node.create_subscription(
                Detection2DArray, f'{namespace}/{topic}', self._count, 10, raw=True
            )

    def _count(self, data: bytes) -> None:
        self._answers += 1

    def ask(self, data: bytes, timeout: float = 5.0) -> float:
        """Send a message and wait for all that comes of it; seconds, NaN if nothing does."""
        self._answers = 0
        started = time.perf_counter()
        self._publisher.publish(data)
        while self._answers < self._wanted:
            self._executor.spin_once(timeout_sec=0.1)
            if time.perf_counter() - started > timeout:
                return float('nan')
        return time.perf_counter() - started

    def warm_up(self, data: bytes) -> None:
        """Ask until answers come."""
        deadline = time.monotonic() + 30
        while np.isnan(self.ask(data, 0.5)):
            if time.monotonic() > deadline:
                raise TimeoutError(f'{self.name} does not answer')
        for _ in range(20):
            self.ask(data)

    def cpu_seconds(self) -> float:
        """Tell the processor time that the node has used."""
        fields = Path(f'/proc/{self._process.pid}/stat').read_text().rpartition(')')[2].split()
        return (int(fields[11]) + int(fields[12])) / TICKS

    def resident_megabytes(self) -> float:
        """Tell the memory that the node holds."""
        pages = int(Path(f'/proc/{self._process.pid}/statm').read_text().split()[1])
        return pages * os.sysconf('SC_PAGE_SIZE') / 2**20

    def stop(self) -> None:
        """End the process."""
        self._process.send_signal(signal.SIGINT)
        self._process.wait(10)


def measure(asked: Sequence[Asked], count: int, rounds: int) -> list[list[str]]:
    """Ask all nodes in turn with messages of `count` detections; a row a node."""
    data = message(count)
    for node in asked:
        node.warm_up(data)
    times: dict[str, list[float]] = {node.name: [] for node in asked}
    cpu = {node.name: 0.0 for node in asked}
    for _ in range(rounds):
        for node in asked:
            before = node.cpu_seconds()
            times[node.name] += [node.ask(data) for _ in range(20)]
            cpu[node.name] += node.cpu_seconds() - before
    medians = {name: np.nanmedian(values) for name, values in times.items()}
    rows = []
    for node in asked:
        values = np.array(times[node.name])
        rows.append([
            str(count), node.name,
            f'{medians[node.name] * 1e3:.2f}', f'{np.nanpercentile(values, 99) * 1e3:.2f}',
            f'{medians[node.name] / medians["echo"]:.2f}',
            f'{medians["typed"] / medians[node.name]:.1f}',
            f'{cpu[node.name] / values.size * 1e3:.2f}',
            f'{cpu["typed"] / max(cpu[node.name], 1 / TICKS):.1f}',
            f'{node.resident_megabytes():.0f}', str(int(np.isnan(values).sum())),
        ])
    return rows


HEAD = (
    'detections', 'node', 'median [ms]', 'p99 [ms]', 'times echo', 'typed / this',
    'CPU [ms/message]', 'typed CPU / this', 'resident [MB]', 'lost',
)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parser.add_argument('--sizes', type=int, nargs='+', default=[1, 10, 100, 1000])
    parser.add_argument('--rounds', type=int, default=25, help='of 20 messages to each node')
    options = parser.parse_args()
    rclpy.init()
    client = rclpy.create_node('bench_client')
    executor = SingleThreadedExecutor()
    executor.add_node(client)
    asked = [Asked(name, client, executor) for name in NODES]
    rows = []
    try:
        for count in options.sizes:
            rows += measure(asked, count, options.rounds)
    finally:
        for node in asked:
            node.stop()
        executor.shutdown()
        rclpy.try_shutdown()
    print(text_table(HEAD, rows))


if __name__ == '__main__':
    main()
