# SPDX-License-Identifier: Apache-2.0
"""
Processor time of a node at a detector's pace, diagnostics and idling between messages included.

All nodes run at once and get the same messages. `python test/benchmarks/steady.py --help`
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence

import rclpy
from node import NODES
from node import Asked
from node import message
from rclpy.executors import SingleThreadedExecutor

from obbhbb_ros.study.tables import text_table

HEAD = ('node', 'CPU [ms/message]', 'times echo', 'resident [MB]')


def measure(asked: Sequence[Asked], data: bytes, rate: float, seconds: float) -> list[list[str]]:
    """Send at a rate for some time; give one row per node."""
    for node in asked:
        node.warm_up(data)
    before = [node.cpu_seconds() for node in asked]
    count = int(rate * seconds)
    started = time.monotonic()
    for i in range(count):
        for node in asked:
            node.ask(data)
        time.sleep(max(0.0, started + (i + 1) / rate - time.monotonic()))
    spent = [
        (node.cpu_seconds() - b) / count * 1e3 for node, b in zip(asked, before, strict=True)
    ]
    return [
        [node.name, f'{each:.2f}', f'{each / spent[0]:.2f}', f'{node.resident_megabytes():.0f}']
        for node, each in zip(asked, spent, strict=True)
    ]


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parser.add_argument('--detections', type=int, default=10)
    parser.add_argument('--rate', type=float, default=10.0, help='messages per second')
    parser.add_argument('--seconds', type=float, default=30.0)
    options = parser.parse_args()
    rclpy.init()
    client = rclpy.create_node('bench_client')
    executor = SingleThreadedExecutor()
    executor.add_node(client)
    asked = [Asked(name, client, executor) for name in NODES]
    try:
        rows = measure(asked, message(options.detections), options.rate, options.seconds)
    finally:
        for node in asked:
            node.stop()
        executor.shutdown()
        rclpy.try_shutdown()
    print(f'{options.detections} detections at {options.rate:g} Hz for {options.seconds:g} s')
    print(text_table(HEAD, rows))


if __name__ == '__main__':
    main()
