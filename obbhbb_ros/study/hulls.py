# SPDX-License-Identifier: Apache-2.0
"""
Synthetic hulls: the paper's four families at its four levels of fullness.

The paper names the families and prints a table of their mean relative errors; it does not publish
the polygons, so they are rebuilt here. Chosen to fit that table: a hull touches its oriented box
at bow, stern and amidships at every fullness, and the fullness narrows its ends (narrowing the
whole hull instead misses the rows below 1.00 by three times as much); aspect ratios run from 3 to
7, angles evenly over a quarter turn. Fitted: one number per family, the width of its ends, so that
it gives the row "N" at fullness 1.00. Everything else is a prediction; `paper_comparison` compares
it with the paper.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from types import MappingProxyType

import numpy as np

from obbhbb_ros.geometry.boxes import FloatArray
from obbhbb_ros.geometry.boxes import OrientedBoxes
from obbhbb_ros.study.metrics import bounds
from obbhbb_ros.study.ships import Ships

FULLNESS = (0.60, 0.75, 0.85, 1.00)
ASPECT_RANGE = (3.0, 7.0)
LENGTH = 100.0
_POINTS = 9
_SPACING = 1.5 * LENGTH


@dataclass(frozen=True)
class Family:
    """
    A hull form of the paper.

    Attributes
    ----------
    name : str
        Its name in the paper.
    bow, stern : float
        Width of the ends at fullness 1, relative to the width amidships, in [0, 1].
    curve : float
        Exponent of the sides between amidships and an end: 1 is straight, above is fuller.
    """

    name: str
    bow: float
    stern: float
    curve: float = 1.0

    def outline(self, fullness: float = 1.0) -> FloatArray:
        """
        Draw the hull in the unit box, bow at +x; `fullness`, in (0, 1], scales its ends.

        The vertices, (K, 2), are in order and touch all four sides of [-1, 1]^2. Raises ValueError
        if `fullness` is out of range.
        """
        if not 0.0 < fullness <= 1.0:
            raise ValueError(f'fullness must be in (0, 1], not {fullness}')
        points = 2 if self.curve == 1.0 else _POINTS
        x = np.linspace(0.0, 1.0, points)
        forward = 1.0 - (1.0 - self.bow * fullness) * x**self.curve
        aft = 1.0 - (1.0 - self.stern * fullness) * x**self.curve
        side = np.stack((np.concatenate((-x[:0:-1], x)), np.concatenate((aft[:0:-1], forward))))
        return np.concatenate((side.T, side.T[::-1] * [1.0, -1.0]))


# A test fits the ends and compares them.
FAMILIES: MappingProxyType[str, Family] = MappingProxyType(
    {
        family.name: family
        for family in (
            Family('rectangular', bow=1.0, stern=1.0),
            Family('tapered', bow=0.4415, stern=0.4415),
            Family('bow_stern', bow=0.6795, stern=1.0),
            Family('fine', bow=0.4548, stern=0.4548, curve=1.5),
        )
    }
)


def class_name(family: str, fullness: float) -> str:
    """Name the class of the synthetic ships of a family and fullness."""
    return f'{family} {fullness:.2f}'


def synthetic_ships(
    families: Sequence[Family] = tuple(FAMILIES.values()),
    fullness: Sequence[float] = FULLNESS,
    aspects: int = 5,
    angles: int = 90,
    seed: int | None = 0,
) -> Ships:
    """
    Draw hulls at many aspect ratios and angles, each in an image of its own.

    Parameters
    ----------
    families, fullness
        Hull forms, and their levels of fullness, in (0, 1].
    aspects, angles : int
        Number of aspect ratios, evenly over `ASPECT_RANGE` (a single one is its middle), and of
        angles, one in each of as many equal parts of [0, 90) degrees.
    seed : int or None
        Seed of the position of each angle in its part; None for the middle.

    Returns
    -------
    Ships
        Families × fullness × aspects × angles ships of `LENGTH` pixels, class "family fullness".
        The reference is the bounds of the hull.

    Raises
    ------
    ValueError
        If there is nothing to draw or a fullness is out of range.
    """
    if min(len(families), len(fullness), aspects, angles) < 1:
        raise ValueError('families, fullness, aspects and angles must be one or more each')
    low, high = ASPECT_RANGE
    ratios = np.linspace(low, high, aspects) if aspects > 1 else np.array([(low + high) / 2.0])
    sorts = len(families) * len(fullness)
    count = sorts * aspects * angles
    center = np.stack((np.arange(count) * _SPACING, np.zeros(count)))
    aspect = np.tile(np.repeat(ratios, angles), sorts)
    offset = 0.5 if seed is None else np.random.default_rng(seed).uniform(size=count)
    theta = (np.arange(count) % angles + offset) / angles * (np.pi / 2.0)
    long_axis = np.stack((np.cos(theta), np.sin(theta))) * (LENGTH / 2.0)
    short_axis = np.stack((-np.sin(theta), np.cos(theta))) * (LENGTH / 2.0 / aspect)
    names, outlines = [], []
    for family, full in product(families, fullness):
        names += [class_name(family.name, full)] * (aspects * angles)
        outlines += [family.outline(full)] * (aspects * angles)
    axes = np.stack((long_axis, short_axis)).transpose(2, 0, 1)
    hulls = [hull @ turn + c for hull, turn, c in zip(outlines, axes, center.T, strict=True)]
    intact, no_bow = np.zeros(count, np.uint8), np.zeros(count, np.bool_)
    return Ships(
        boxes=OrientedBoxes(center.T, long_axis.T, short_axis.T, intact, no_bow),
        reference=np.array([bounds(hull) for hull in hulls]),
        class_ids=np.array(names),
        image_of=np.arange(count),
        names=tuple(
            f'{name} L/W {ratio:.1f} {degrees:.0f}°'
            for name, ratio, degrees in zip(names, aspect, np.degrees(theta), strict=True)
        ),
        hulls=tuple(hulls),
    )
