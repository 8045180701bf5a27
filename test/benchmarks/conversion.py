# SPDX-License-Identifier: Apache-2.0
"""
Conversion of oriented boxes, every method, against what else one could do with the corners.

Each peer converts the same corners in turn, in one process; the figures are medians, in
nanoseconds a box, and how many times as long as `superellipse` each took.
`python test/benchmarks/conversion.py --help`
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Callable
from collections.abc import Sequence

import numpy as np
import shapely

from obbhbb_ros import OrientedBoxes
from obbhbb_ros import convert
from obbhbb_ros.geometry.methods import METHODS
from obbhbb_ros.text_tables import text_table

LOOP_AT_MOST = 10_000
ROUNDS = 7
SECONDS = 0.2


def corners_of(count: int) -> np.ndarray:
    """Make corners of `count` boxes, (N, 4, 2)."""
    random = np.random.default_rng(1)
    x, y = random.uniform(0, 4096, (2, count))
    rows = np.stack(
        (
            x,
            y,
            random.uniform(20, 300, count),
            random.uniform(5, 60, count),
            random.uniform(-4, 4, count),
        ),
        axis=1,
    )
    return OrientedBoxes.from_xywhr(rows).corners


def published_rule(c: Sequence[Sequence[float]]) -> tuple[float, float, float, float]:
    """Apply Algorithm 1 to the corners of one box."""
    q, f, s = 2.2, 0.9, 1.0
    edges = [(c[1][0] - c[0][0], c[1][1] - c[0][1]), (c[2][0] - c[1][0], c[2][1] - c[1][1])]
    long, short = sorted(edges, key=lambda e: -math.hypot(*e))
    theta = math.atan2(long[0], long[1])
    a, b = math.hypot(*long) / 2, math.hypot(*short) / 2 * f
    sin, cos = abs(math.sin(theta)), abs(math.cos(theta))
    k = max(q * b / a, 1e-12)
    t_x = min(1.0, (sin / (max(cos, 1e-12) * k)) ** (1 / (q - 1)))
    t_y = min(1.0, (cos / (max(sin, 1e-12) * k)) ** (1 / (q - 1)))
    half_x = s * (a * t_x * sin + b * (1 - t_x**q) * cos)
    half_y = s * (a * t_y * cos + b * (1 - t_y**q) * sin)
    x, y = sum(p[0] for p in c) / 4, sum(p[1] for p in c) / 4
    return x - half_x, y - half_y, x + half_x, y + half_y


def corner_loop(corners: np.ndarray) -> np.ndarray:
    """Take the corners as they are, one box after the other: the least that a loop can do."""
    return np.array([published_rule(box) for box in corners.tolist()])


def polygon_loop(corners: np.ndarray) -> np.ndarray:
    """Go from polygon to polygon by its minimum rotated rectangle, as Algorithm 1 is stated."""
    boxes = []
    for box in corners.tolist():
        rectangle = shapely.Polygon(box).minimum_rotated_rectangle
        boxes.append(published_rule(rectangle.exterior.coords[:4]))
    return np.array(boxes)


def peers(corners: np.ndarray) -> dict[str, Callable[[], object]]:
    """Name everything that is measured; `superellipse` first."""
    boxes = OrientedBoxes.from_corners(corners)
    rows = boxes.xywhr
    polygons = shapely.polygons(corners)
    functions: dict[str, Callable[[], object]] = {
        name: lambda name=name: convert(OrientedBoxes.from_corners(corners), method=name, q=2.6)
        for name in METHODS
    }
    functions['superellipse, q = 3'] = lambda: convert(OrientedBoxes.from_corners(corners), q=3.0)
    functions['superellipse from xywhr'] = lambda: convert(OrientedBoxes.from_xywhr(rows), q=2.6)
    functions['memory copy'] = corners.copy
    functions['shapely.bounds, prebuilt'] = lambda: shapely.bounds(polygons)
    functions['shapely.bounds'] = lambda: shapely.bounds(shapely.polygons(corners))
    if len(corners) <= LOOP_AT_MOST:
        functions['published rule, loop over polygons'] = lambda: polygon_loop(corners)
        functions['published rule, loop over corners'] = lambda: corner_loop(corners)
    try:
        from supervision.detection.utils.boxes import xyxyxyxy_to_xyxy
    except ImportError:
        print('supervision is not installed (extra `bench`): left out')
    else:
        functions['supervision min/max'] = lambda: xyxyxyxy_to_xyxy(corners)
    return functions


def measure(functions: dict[str, Callable[[], object]]) -> dict[str, float]:
    """Call all functions in turn, again and again; median seconds a call of each."""
    repeats = {}
    for name, function in functions.items():
        function()
        started = time.perf_counter()
        function()
        once = time.perf_counter() - started
        repeats[name] = max(1, int(SECONDS / ROUNDS / max(once, 1e-7)))
    times: dict[str, list[float]] = {name: [] for name in functions}
    for _ in range(ROUNDS):
        for name, function in functions.items():
            started = time.perf_counter()
            for _ in range(repeats[name]):
                function()
            times[name].append((time.perf_counter() - started) / repeats[name])
    return {name: float(np.median(values)) for name, values in times.items()}


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parser.add_argument(
        '--sizes',
        type=int,
        nargs='+',
        default=[1, 10, 100, 1000, 10_000, 100_000, 1_000_000],
    )
    sizes = parser.parse_args().sizes
    results = {count: measure(peers(corners_of(count))) for count in sizes}
    names = list(results[sizes[0]])
    for title, cell in (
        ('microseconds a call', lambda r, n, count: f'{r[n] * 1e6:.1f}'),
        ('nanoseconds a box', lambda r, n, count: f'{r[n] / count * 1e9:.1f}'),
        ('times as long as superellipse', lambda r, n, count: f'{r[n] / r["superellipse"]:.2f}'),
    ):
        rows = [
            [name, *(cell(r, name, count) if name in r else '' for count, r in results.items())]
            for name in names
        ]
        print(f'\n{text_table((title, *(f"{count:,}" for count in sizes)), rows)}')


if __name__ == '__main__':
    main()
