# SPDX-License-Identifier: Apache-2.0
"""
Processor time of a node at a detector's pace, diagnostics and idling between messages included.

All nodes run at once and get the same messages. `python test/benchmarks/steady.py --help`
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence

from node import Asked
from node import all_asked
from node import detector_message

from obbhbb_ros.text_tables import text_table

HEAD = ('node', 'CPU [ms/message]', 'times echo', 'resident [MB]')


def measure(asked: Sequence[Asked], data: bytes, rate: float, seconds: float) -> list[list[str]]:
    """Send at a rate for some time; give one row per node."""
    for node in asked:
        node.warm_up(data)
    before = [node.process.cpu_seconds() for node in asked]
    count = int(rate * seconds)
    started = time.monotonic()
    for i in range(count):
        for node in asked:
            node.ask(data)
        time.sleep(max(0.0, started + (i + 1) / rate - time.monotonic()))
    after = [node.process.cpu_seconds() for node in asked]
    spent = [(b - a) / count * 1e3 for a, b in zip(before, after, strict=True)]
    resident = [node.process.resident_megabytes() for node in asked]
    return [
        [node.name, f'{milliseconds:.2f}', f'{milliseconds / spent[0]:.2f}', f'{megabytes:.0f}']
        for node, milliseconds, megabytes in zip(asked, spent, resident, strict=True)
    ]


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parser.add_argument('--detections', type=int, default=10)
    parser.add_argument('--rate', type=float, default=10.0, help='messages per second')
    parser.add_argument('--seconds', type=float, default=30.0)
    options = parser.parse_args()
    data = detector_message(options.detections)
    with all_asked() as asked:
        rows = measure(asked, data, options.rate, options.seconds)
    print(f'{options.detections} detections at {options.rate:g} Hz for {options.seconds:g} s')
    print(text_table(HEAD, rows))


if __name__ == '__main__':
    main()
