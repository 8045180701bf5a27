# SPDX-License-Identifier: Apache-2.0
"""The same rectangle, written as each detector writes it, is converted to the same box."""

from __future__ import annotations

import math

import numpy as np
import pytest

from obbhbb_ros import OrientedBoxes
from obbhbb_ros import convert
from obbhbb_ros.geometry.methods import METHODS

QUARTER, HALF = math.pi / 2, math.pi
CENTER = (400.0, 300.0)
# Long side, short side, angle of the long side; the borders of all ranges are among them.
RECTANGLES = [
    (length, width, math.radians(degrees))
    for length, width in ((120.0, 30.0), (81.0, 80.0))
    for degrees in (-90, -89, -60, -45, -44, -1, 0, 1, 30, 45, 60, 89)
]


def long_side(start: float):
    """Give the convention whose first size is the longer side and whose angle begins there."""
    return lambda length, width, theta: (length, width, (theta - start) % HALF + start)


def quarter(start: float, open_below: bool):
    """Give the convention of angles of a quarter turn, whose first size is whichever side fits."""

    def write(length: float, width: float, theta: float) -> tuple[float, float, float]:
        turns = (theta - start) / QUARTER
        count = math.ceil(turns - 1e-9) - 1 if open_below else math.floor(turns + 1e-9)
        sizes = (width, length) if count % 2 else (length, width)
        return (*sizes, theta - count * QUARTER)

    return write


# How a convention writes a rectangle, and which angles it has, degrees.
CONVENTIONS = {
    'OpenCV 4.5.1 to 4.12': (quarter(0.0, open_below=True), lambda angle: 0 < angle <= 90),
    'OpenCV before 4.5.1 and from 4.13': (
        quarter(-QUARTER, open_below=False),
        lambda angle: -90 <= angle < 0,
    ),
    'le90': (long_side(-QUARTER), lambda angle: -90 <= angle < 90),
    'le135': (long_side(-QUARTER / 2), lambda angle: -45 <= angle < 135),
    'Ultralytics xywhr': (quarter(0.0, open_below=False), lambda angle: 0 <= angle < 90),
    'Ultralytics xywhr of older releases': (long_side(0.0), lambda angle: 0 <= angle < 180),
    'anticlockwise': (lambda length, width, theta: (length, width, -theta), lambda angle: True),
    'from the other end': (
        lambda length, width, theta: (length, width, theta + HALF),
        lambda angle: True,
    ),
}


def corners_of(length: float, width: float, theta: float) -> np.ndarray:
    along = np.array([math.cos(theta), math.sin(theta)]) * length / 2
    across = np.array([-math.sin(theta), math.cos(theta)]) * width / 2
    signs = ((-1, -1), (1, -1), (1, 1), (-1, 1))
    return np.array([CENTER + i * along + j * across for i, j in signs])


@pytest.mark.parametrize('method', METHODS)
@pytest.mark.parametrize('name', CONVENTIONS)
def test_every_convention_gives_the_box_of_the_corners(name: str, method: str) -> None:
    write, has = CONVENTIONS[name]
    written = [write(*rectangle) for rectangle in RECTANGLES]
    assert all(has(round(math.degrees(angle), 6)) for _, _, angle in written)
    expected = convert(
        OrientedBoxes.from_corners([corners_of(*r) for r in RECTANGLES]), method=method
    )
    boxes = OrientedBoxes.from_xywhr([(*CENTER, *row) for row in written])
    np.testing.assert_allclose(convert(boxes, method=method), expected, atol=1e-6)


def test_an_angle_of_the_short_side_gives_another_box() -> None:
    right = OrientedBoxes.from_xywhr([(*CENTER, 120.0, 30.0, 0.3)])
    wrong = OrientedBoxes.from_xywhr([(*CENTER, 30.0, 120.0, 0.3)])
    assert np.abs(convert(right) - convert(wrong)).max() > 10.0
