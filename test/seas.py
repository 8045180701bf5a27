# SPDX-License-Identifier: Apache-2.0
"""Seas of ships under a camera that moves: what a detector would say of each image."""

from __future__ import annotations

from collections.abc import Callable
from collections.abc import Iterator
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Places = NDArray[np.complex128]
Ints = NDArray[np.int64]

FALSE_ALARM = -1
"""Truth of a box that is no ship."""
ROW = 8
"""Ships of a berthed row."""


class Frame(NamedTuple):
    """
    What a detector says of an image.

    Attributes
    ----------
    time : float
        Stamp, seconds.
    place : ndarray of complex, shape (N,)
        Middles of the boxes, pixels.
    length, angle : ndarray, shape (N,)
        Long sides, pixels, and their angles, radians.
    truth : ndarray of int, shape (N,)
        Which ship; `FALSE_ALARM` for none.
    share : ndarray, shape (N,)
        How much of it is in the image, 0 to 1.
    view : tuple of complex
        Factor and shift: pixels are the factor times places in metres, and the shift.
    """

    time: float
    place: Places
    length: Floats
    angle: Floats
    truth: Ints
    share: Floats
    view: tuple[complex, complex]

    def carry_from(self, last: Frame, error: complex = 0.0) -> Callable[[Places], Places]:
        """Tell how the image moved since the last one, by poses that are off, metres."""
        (before, start), (after, end) = last.view, self.view
        return lambda places: ((places - start) / before + error) * after + end


@dataclass(frozen=True)
class Sea:
    """
    Ships, a camera and a detector.

    Attributes
    ----------
    size : complex
        Width and height of the image, pixels.
    gsd : float
        Metres per pixel.
    ships, berthed, gap, speed, median_length, max_length
        How many, which share in rows of eight, metres between those, m/s, metres.
    strip : float
        Metres that the camera flies over, at `rate` images per second that overlap by `overlap`.
    hover : float
        Seconds for which it stands still instead.
    misses, false_alarms : float
        Share of the ships that are missed, and of the boxes that are none.
    jitter : float
        Standard deviation of the places, pixels; 5 % and 3 degrees that of lengths and angles.
    cut : str
        How a box is cut at the border: `frame`, the middle of what is seen of its frame; `axis`,
        what is seen of its long axis; or not at all (`none`).
    turn, zoom, wobble : float
        Degrees and share by which the camera turns and rises at the tenth image, and degrees by
        which it swings all the time.
    dropped : tuple of int
        Images that are lost.
    revisit : float
        Seconds after which it flies over the same strip again; 0: never.
    """

    size: complex = 6667 + 4667j
    gsd: float = 1.5
    ships: int = 1000
    berthed: float = 0.5
    gap: float = 15.0
    speed: tuple[float, float] = (0.0, 4.0)
    median_length: float = 70.0
    max_length: float = 350.0
    strip: float = 60e3
    rate: float = 10.0
    overlap: float = 0.9
    hover: float = 0.0
    misses: float = 0.1
    false_alarms: float = 0.1
    jitter: float = 1.0
    cut: str = 'frame'
    turn: float = 0.0
    zoom: float = 0.0
    turns_at: int = 10
    wobble: float = 0.0
    dropped: tuple[int, ...] = ()
    revisit: float = 0.0


HOVERING = Sea(
    size=4000 + 3000j,
    gsd=0.1,
    median_length=25.0,
    max_length=60.0,
    speed=(5.0, 15.0),
    berthed=0.0,
    hover=30.0,
)
"""A camera that stands still over ships of a tenth of its image."""


class _Fleet(NamedTuple):
    """Ships in metres: places, velocities, lengths, widths, angles."""

    place: Places
    velocity: Places
    length: Floats
    width: Floats
    angle: Floats


def frames(sea: Sea, seed: int) -> Iterator[Frame]:
    """Yield what the detector says of each image."""
    random = np.random.default_rng(seed)
    fleet = _fleet(sea, random)
    turn, gsd = 0.0, sea.gsd
    for number, (time, offset) in enumerate(_poses(sea)):
        if number == sea.turns_at:
            turn, gsd = np.radians(sea.turn), sea.gsd / (1 + sea.zoom)
        if number in sea.dropped:
            continue
        swing = turn + np.radians(sea.wobble) * np.sin(0.7 * number)
        middle = sea.size / 2
        at = fleet.place + fleet.velocity * time - offset - middle * sea.gsd
        place = at * np.exp(1j * swing) / gsd + middle
        ships = _Fleet(
            place, fleet.velocity, fleet.length / gsd, fleet.width / gsd, fleet.angle + swing
        )
        factor = np.exp(1j * swing) / gsd
        view = complex(factor), complex(middle - (offset + middle * sea.gsd) * factor)
        yield _seen(sea, time, ships, random)._replace(view=view)


def _poses(sea: Sea) -> list[tuple[float, complex]]:
    """List when the images are taken, and where their corner is, metres."""
    if sea.hover:
        return [(number / sea.rate, 0j) for number in range(int(sea.hover * sea.rate))]
    height = sea.size.imag * sea.gsd
    step = height * (1 - sea.overlap)
    offsets = np.arange(-height + step, sea.strip, step)
    poses = [(number / sea.rate, 1j * offset) for number, offset in enumerate(offsets.tolist())]
    if sea.revisit:
        again = poses[-1][0] + sea.revisit
        poses += [(again + time, offset) for time, offset in poses]
    return poses


def _fleet(sea: Sea, random: np.random.Generator) -> _Fleet:
    """Make up the ships; those of a hovering camera come from nine images around."""
    count, images = sea.ships, 3 if sea.hover else 1
    width = sea.size.real * sea.gsd
    height = sea.size.imag * sea.gsd if sea.hover else sea.strip
    low, high = -(images - 1) / 2, (images + 1) / 2
    place = (
        random.uniform(low, high, count) * width + 1j * random.uniform(low, high, count) * height
    )
    spread = 0.7 if sea.max_length > 100 else 0.4
    length = np.exp(random.normal(np.log(sea.median_length), spread, count))
    length = np.clip(length, 12.0, sea.max_length)
    beam = np.maximum(length / random.uniform(4.0, 7.0, count), 3.0)
    angle = random.uniform(-np.pi, np.pi, count)
    speed = random.uniform(*sea.speed, count)
    for first in range(0, int(count * sea.berthed) // ROW * ROW, ROW):
        row = slice(first, first + ROW)
        length[row] = np.clip(length[row], 12.0, 150.0)
        beam[row] = np.maximum(length[row] / 5.5, 4.0)
        angle[row], speed[row] = angle[first], 0.0
        across = beam[row].cumsum() - beam[row] / 2 + sea.gap * np.arange(ROW)
        place[row] = place[first] + 1j * np.exp(1j * angle[first]) * across
    return _Fleet(place, speed * np.exp(1j * angle), length, beam, angle)


def _seen(sea: Sea, time: float, ships: _Fleet, random: np.random.Generator) -> Frame:
    """Say what a detector sees of ships in pixels."""
    place, length, share = _in_frame(sea.size, ships)
    rows = np.flatnonzero((share > 0.3) & (random.random(len(share)) >= sea.misses))
    if sea.cut == 'axis':
        place, length = _along_axis(sea.size, ships)
    elif sea.cut == 'none':
        place, length = ships.place, ships.length
    false = random.poisson(sea.false_alarms * len(rows) / (1 - sea.false_alarms))
    width, height = sea.size.real, sea.size.imag
    elsewhere = random.uniform(0, width, false) + 1j * random.uniform(0, height, false)
    of_false = np.exp(random.normal(np.log(0.6 * sea.median_length), 0.6, false))
    of_false = np.clip(of_false, 12.0, sea.max_length) / sea.gsd
    angles = np.concatenate((ships.angle[rows], random.uniform(-np.pi, np.pi, false)))
    places, lengths = np.append(place[rows], elsewhere), np.append(length[rows], of_false)
    count = len(places)
    order = random.permutation(count)
    places = places + random.normal(0.0, sea.jitter, (count, 2)) @ np.array([1, 1j])
    lengths = lengths * np.exp(random.normal(0.0, 0.05, count))
    # Bow and stern are taken for each other half of the time.
    angles = angles + random.normal(0.0, np.radians(3.0), count)
    angles += np.pi * random.integers(0, 2, count)
    truth = np.append(rows, np.full(false, FALSE_ALARM))
    shares = np.append(share[rows], np.ones(false))
    columns = (column[order] for column in (places, lengths, angles, truth, shares))
    return Frame(time, *columns, (1.0, 0.0))


def _in_frame(size: complex, ships: _Fleet) -> tuple[Places, Floats, Floats]:
    """Cut the axis-aligned frames of ships: their middles, lengths, and the share that is seen."""
    cos, sin = np.abs(np.cos(ships.angle)), np.abs(np.sin(ships.angle))
    half = (
        (cos * ships.length + sin * ships.width) / 2,
        (sin * ships.length + cos * ships.width) / 2,
    )
    middle, share = [], np.ones(len(cos))
    for at, extent, high in zip(
        (ships.place.real, ships.place.imag), half, (size.real, size.imag), strict=True
    ):
        first, last = np.clip(at - extent, 0, high), np.clip(at + extent, 0, high)
        middle.append((first + last) / 2)
        share *= (last - first) / (2 * extent)
    return middle[0] + 1j * middle[1], ships.length * np.maximum(share, 0.3), share


def _along_axis(size: complex, ships: _Fleet) -> tuple[Places, Floats]:
    """Cut the long axes of ships: the middles and lengths of what is in the image."""
    along = ships.length * np.exp(1j * ships.angle)
    start = ships.place - along / 2
    first, last = np.zeros(len(along)), np.ones(len(along))
    for at, along_one, high in (
        (start.real, along.real, size.real),
        (start.imag, along.imag, size.imag),
    ):
        step = np.where(np.abs(along_one) < 1e-9, 1e-9, along_one)
        ends = np.sort((-at / step, (high - at) / step), axis=0)
        first, last = np.maximum(first, ends[0]), np.minimum(last, ends[1])
    share = np.clip(last - first, 0.02, 1.0)
    return start + along * (first + last) / 2, ships.length * share


class Quality(NamedTuple):
    """Ids of a ship, share of the ships that share an id with another, and number of ships."""

    ids_per_ship: float
    merged: float
    ships: int


def quality(truth: Sequence[Ints], numbers: Sequence[Ints]) -> Quality:
    """Compare the numbers of boxes, frame by frame, with the ships that they are."""
    true, given = np.concatenate(truth), np.concatenate(numbers)
    is_ship = true != FALSE_ALARM
    pairs = np.unique(np.column_stack((true[is_ship], given[is_ship])), axis=0)
    ships = len(np.unique(pairs[:, 0]))
    ids, counts = np.unique(pairs[:, 1], return_counts=True)
    merged = pairs[np.isin(pairs[:, 1], ids[counts > 1]), 0]
    return Quality(len(pairs) / max(ships, 1), len(np.unique(merged)) / max(ships, 1), ships)
