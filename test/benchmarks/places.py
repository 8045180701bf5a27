# SPDX-License-Identifier: Apache-2.0
"""
Placing boxes on Earth: processor time of a call, with and without distortion and covariance.

All candidates take turns in one process; the figures are medians in microseconds.
`python test/benchmarks/places.py --help`
"""

from __future__ import annotations

import argparse
import time

import numpy as np

from obbhbb_ros import OrientedBoxes
from obbhbb_ros.earth.pinhole import Pinhole
from obbhbb_ros.earth.placement import place
from obbhbb_ros.earth.pose import CameraPose
from obbhbb_ros.text_tables import text_table

D = (-0.25, 0.08, 0.001, -0.0007, 0.01)
# 500 km above the equator, looking down.
POSITION, ATTITUDE = (6878137.0, 0.0, 0.0), (0.5, 0.5, -0.5, -0.5)
COVARIANCE = np.diag((5.0, 5.0, 5.0, 1e-4, 1e-4, 1e-4)) ** 2


def boxes_of(count: int) -> OrientedBoxes:
    """Make up boxes of an image of 4096 x 3072 pixels."""
    random = np.random.default_rng(1)
    low, high = (0, 0, 20, 5, -3), (4096, 3072, 200, 30, 3)
    return OrientedBoxes.from_xywhr(random.uniform(low, high, (count, 5)))


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parser.add_argument('--sizes', type=int, nargs='+', default=[1, 10, 100, 1000])
    parser.add_argument('--rounds', type=int, default=200)
    options = parser.parse_args()
    k = [3000.0, 0, 2047.5, 0, 3000.0, 1535.5, 0, 0, 1]
    candidates = {
        f'{lens}, {spread}': (Pinhole(k, d), CameraPose.from_message(POSITION, ATTITUDE, matrix))
        for lens, d in (('no distortion', ()), ('plumb_bob', D))
        for spread, matrix in (('place', None), ('with covariance', COVARIANCE))
    }
    rows = {name: [name] for name in candidates}
    for count in options.sizes:
        boxes = boxes_of(count)
        taken: dict[str, list[float]] = {name: [] for name in candidates}
        for _ in range(options.rounds):
            for name, (camera, pose) in candidates.items():
                started = time.process_time()
                place(boxes, camera, pose)
                taken[name].append(time.process_time() - started)
        for name, times in taken.items():
            rows[name].append(f'{np.median(times) * 1e6:.0f}')
    heads = ('microseconds a call', *(f'{count:,}' for count in options.sizes))
    print(text_table(heads, list(rows.values())))


if __name__ == '__main__':
    main()
