# SPDX-License-Identifier: Apache-2.0
"""
Place boxes by cameras and poses that nobody means: extreme numbers, NaN, random calibrations.

Whatever the numbers are, one of two things must happen: the documented error, or ships each of
which has a place on the surface or a reason why not. No warning of NumPy, no call that takes long.
`python test/fuzz/places.py --inputs 1000000`
"""

from __future__ import annotations

import argparse
import random
import time
import warnings
from collections import Counter

import numpy as np

from obbhbb_ros import OrientedBoxes
from obbhbb_ros.earth.ellipsoid import to_geodetic
from obbhbb_ros.earth.pinhole import Pinhole
from obbhbb_ros.earth.placement import Placement
from obbhbb_ros.earth.placement import Unplaced
from obbhbb_ros.earth.placement import place
from obbhbb_ros.earth.pose import Attitude
from obbhbb_ros.earth.pose import CameraPose
from obbhbb_ros.earth.pose import Fix
from obbhbb_ros.earth.pose import PoseError

EXTREMES = [0.0, -0.0, 1.0, -1.0, 5e-324, 1e-300, 1e-9, 1e9, 1e15, 1e154, 1e300, 1.8e308]
EXTREMES += [float('inf'), float('nan')]
MODELS = ['plumb_bob', 'rational_polynomial', 'equidistant', '']
# From the optical frame of a camera that looks down to the body.
DOWN = [0.5**0.5, -(0.5**0.5), 0.0, 0.0]
SLOWEST = 1.0
# Off the surface: by the sagitta of a ship as long as the Earth's curve allows, and its height.
MAX_OFF = 100.0


def number(source: random.Random, scale: float, wild: float) -> float:
    """Make up a number of some size, now and then an extreme one."""
    if source.random() < wild:
        return source.choice((1, -1)) * source.choice(EXTREMES)
    return source.gauss(0.0, scale)


def numbers(source: random.Random, count: int, scale: float, wild: float) -> list[float]:
    """Make up several numbers."""
    return [number(source, scale, wild) for _ in range(count)]


def camera_of(source: random.Random, wild: float) -> Pinhole:
    """Make up a camera info; raises ValueError where it is none."""
    focal = abs(number(source, 2000.0, wild)) + 100.0
    k = [focal, 0.0, number(source, 1000.0, wild), 0.0, focal, number(source, 1000.0, wild)]
    model = source.choice(MODELS)
    d = numbers(source, source.choice((0, 4, 5, 8, 12)), source.choice((0.01, 0.1, 9.0)), wild)
    known = {'equidistant': 4, '': 0}.get(model, 8) if source.random() < 0.9 else 12
    d[known:] = [0.0] * len(d[known:])
    offset = source.choice(((0, 0), (0, 0), (2**32 - 1, 7), (480, 320)))
    return Pinhole([*k, 0.0, 0.0, 1.0], d, model, offset, source.choice(((0, 0), (2, 2), (1, 99))))


def unit(values: list[float]) -> list[float]:
    """Make a quaternion of numbers where that is possible."""
    with np.errstate(all='ignore'):
        return (np.array(values) / np.linalg.norm(values)).tolist()


def pose_of(source: random.Random, wild: float) -> CameraPose:
    """Make up a pose by any of the messages; raises PoseError where it is none."""
    attitude = unit(numbers(source, 4, 1.0, wild))
    scale = source.choice((1e-6, 1e-2, 1.0, 1e4))
    root = np.array(numbers(source, 36, scale, wild / 10)).reshape(6, 6)
    with np.errstate(all='ignore'):
        covariance = source.choice((None, root @ root.T, root))
    height = abs(number(source, source.choice((100.0, 1e4, 5e5, 3.6e7)), wild))
    latitude, longitude = number(source, 60.0, wild), number(source, 120.0, wild)
    fix = Fix.from_message(latitude, longitude, height, status=source.choice((-1, 0, 0, 0, 2)))
    if source.random() < 0.5:
        position = [value * source.choice((1, 1, 1, 1, -1e-3)) for value in fix.position.tolist()]
        return CameraPose.from_message(position, attitude, covariance)
    level = attitude if source.random() < 0.2 else unit([*numbers(source, 3, 0.3, wild), 1.0])
    body = Attitude.from_message(level, None if covariance is None else covariance[:3, :3].ravel())
    mount = Attitude.from_message(source.choice((DOWN, attitude)))
    return CameraPose.from_parts(fix.toward(fix, source.random()), body, mount.quaternion)


def boxes_of(source: random.Random, wild: float) -> OrientedBoxes:
    """Make up a few boxes."""
    rows = [
        [
            *numbers(source, 2, 1000.0, wild),
            *map(abs, numbers(source, 2, 99.0, wild)),
            source.random(),
        ]
        for _ in range(source.choice((0, 1, 3)))
    ]
    return OrientedBoxes.from_xywhr(rows, bow=source.random() < 0.5)


def check(ships: Placement, height: float) -> None:
    """Hold ships against what must hold."""
    placed = ships.unplaced == Unplaced.NONE
    for values in (ships.latitude, ships.longitude, ships.length, ships.course, ships.elevation):
        assert np.isnan(values[~placed]).all()
        assert np.isfinite(values[placed]).all()
    assert (ships.length[placed] >= 0).all()
    assert ((ships.course[placed] >= 0) & (ships.course[placed] < 360)).all()
    short = placed & (ships.length < 10e3)
    assert (np.abs(to_geodetic(ships.points[short])[2] - height) < MAX_OFF).all()
    if ships.ellipses is not None:
        known = np.isfinite(ships.covariance).all(axis=(1, 2))
        assert (ships.ellipses[known, 0] >= ships.ellipses[known, 1]).all()


def run(source: random.Random) -> str:
    """Make up one input and place it; tell what became of it."""
    wild = source.choice((0.0, 0.02, 0.2))
    height = source.choice((0.0, 0.0, 40.0, -100.0, 3000.0))
    try:
        camera = camera_of(source, wild)
    except ValueError:
        return 'no camera'
    try:
        pose = pose_of(source, wild)
    except PoseError:
        return 'no pose'
    ships = place(boxes_of(source, wild), camera, pose, height, source.choice((0.0, 5.0, 5.0)))
    check(ships, height)
    lost = [Unplaced(reason).name.lower() for reason in ships.unplaced if reason]
    return max(lost, default='placed' if len(ships.length) else 'no box')


def main() -> None:
    """Fuzz."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parser.add_argument('--inputs', type=int, default=100_000)
    parser.add_argument('--seed', type=int, default=1)
    options = parser.parse_args()
    warnings.simplefilter('error')
    became: Counter[str] = Counter()
    slowest, begin = 0.0, time.monotonic()
    for number_of_input in range(options.inputs):
        source = random.Random(f'{options.seed}/{number_of_input}')
        start = time.process_time()
        try:
            became[run(source)] += 1
        except Exception:
            print(f'input {number_of_input} of seed {options.seed}')
            raise
        slowest = max(slowest, time.process_time() - start)
        assert slowest < SLOWEST, f'input {number_of_input} took {slowest:.1f} s'
    seconds = time.monotonic() - begin
    print(f'{options.inputs} inputs in {seconds:.0f} s, the slowest in {slowest * 1e3:.1f} ms:')
    print(', '.join(f'{count} {what}' for what, count in became.most_common()))


if __name__ == '__main__':
    main()
