# SPDX-License-Identifier: Apache-2.0
"""
What the numbers of a YOLO line mean, which one line alone does not always tell.

A line has a class and coordinates, then a confidence, a track id, both or none of them; all lines
of a file have the same. A column of whole numbers at the end is that of the track ids: they are
written without a fraction, and confidences hardly ever are whole.
"""

from __future__ import annotations

from collections.abc import Callable
from collections.abc import Sequence
from itertools import chain
from typing import NamedTuple

import numpy as np

from obbhbb_ros.geometry.boxes import FloatArray
from obbhbb_ros.labels import text

Fields = Sequence[str]

UPRIGHT_FIELDS = 'class x_center y_center width height [confidence] [track]'
POLYGON_FIELDS = 'class x1 y1 x2 y2 x3 y3 x4 y4 [… xK yK] [confidence] [track]'
UPRIGHT_COUNT = 4
# x and y of the corners of an oriented box.
CORNERS_COUNT = 8
# How far the edges of a box may be from parallel, as a share of its longest edge.
SKEW = 0.2
# Lines that tell whether a file holds poses.
SAMPLE = 100


class Ends(NamedTuple):
    """What follows the coordinates."""

    confidence: bool = False
    track: bool = False


class YoloLine(NamedTuple):
    """A line: class index, coordinates as fractions of the image, and what follows them."""

    class_index: str
    coordinates: list[float]
    confidence: str
    track: str


class YoloTable(NamedTuple):
    """N lines with K coordinates, (N, K); scores, (N,), are 1.0 and tracks '' if there are none."""

    class_indices: Sequence[str]
    coordinates: FloatArray
    scores: FloatArray
    tracks: Sequence[str]


def split_lines(lines: Sequence[str]) -> list[Fields]:
    """Split lines into fields, and leave out those with words where numbers belong."""
    rows = [line.split() for line in lines]
    return [row for row in rows if row and text.is_index(row[0]) and text.is_number(row[-1])]


def upright_ends(rows: Sequence[Fields]) -> Ends:
    """Tell what follows the size of upright boxes; raise ValueError if it may be an angle."""
    if {*map(len, rows)} == {UPRIGHT_COUNT + 3}:
        return Ends(confidence=True, track=True)
    last = [row[-1] for row in rows if len(row) == UPRIGHT_COUNT + 2]
    if _is_track_column(last):
        if len(set(last)) < len(last):
            raise ValueError('whole numbers that repeat follow the size: angles or confidences?')
        return Ends(track=True)
    if len(last) == len(rows) and not all(0.0 <= float(field) <= 1.0 for field in last):
        raise ValueError(
            'the number after the size is not within 0..1: no confidence, rather an angle '
            '(class x y w h angle is not read: write corners)'
        )
    return Ends(confidence=bool(last))


def polygon_ends(rows: Sequence[Fields]) -> Ends:
    """Tell what follows the points; raise ValueError if it may be a point or something else."""
    rows = [row for row in rows if len(row) > CORNERS_COUNT]
    sample = rows[:SAMPLE]
    if sample and not _are_boxes(sample) and 2 * sum(map(_is_pose, sample)) >= len(sample):
        raise ValueError('the lines look like poses: a box (x y w h) and key points, not corners')
    odd = [row for row in rows if len(row) % 2]
    even = [row[-1] for row in rows if not len(row) % 2]
    if len(even) > len(odd):
        return Ends(track=True) if _is_track_column(even) else Ends(confidence=True)
    last = [row[-1] for row in odd]
    both_fit = all(len(row) > CORNERS_COUNT + 2 for row in odd)
    if not both_fit or not _is_track_column(last):
        return Ends()
    if any(map(_exceeds_1, last)):
        return Ends(confidence=True, track=True)
    if all(map(_is_closed, odd)):
        return Ends()
    if all(map(_starts_with_box, odd)):
        return Ends(confidence=True, track=True)
    raise ValueError(
        'every line ends in 0 or 1, so its last two numbers may be a point at the border, or a '
        'confidence and a track id: close the polygons, or leave out the track ids'
    )


def _is_track_column(fields: Sequence[str]) -> bool:
    return all(map(text.is_index, fields)) and any(field.strip('0') for field in fields)


def _exceeds_1(index: str) -> bool:
    return index.lstrip('0') not in {'', '1'}


def _is_closed(row: Fields) -> bool:
    return row[1:3] == row[-2:]


def _starts_with_box(row: Fields) -> bool:
    if len(row) != CORNERS_COUNT + 3 or not all(map(text.is_number, row[1:9])):
        return False
    return skew(text.parse_numbers(row[1:9])) <= SKEW


def _are_boxes(rows: Sequence[Fields]) -> bool:
    """Return whether all lines begin with the corners of boxes, so that none is a pose."""
    fields = chain.from_iterable(row[1 : CORNERS_COUNT + 1] for row in rows)
    try:
        corners = np.fromiter(map(float, fields), np.float64)
    except ValueError:
        return False
    return bool((skews(corners.reshape(-1, CORNERS_COUNT)) <= SKEW).all())


def _is_pose(row: Fields) -> bool:
    """
    Return whether a line is rather an upright box and key points in it than a polygon.

    A key point has x and y, and often a visibility; confidence and track id may follow.
    """
    if not all(map(text.is_number, row)):
        return False
    numbers = text.parse_numbers(row[1:])
    if skew(numbers[:CORNERS_COUNT]) <= SKEW:
        return False
    if len(numbers) <= CORNERS_COUNT + 1 and _least_skew(numbers[:CORNERS_COUNT]) > SKEW:
        # Four points that are no box in any order; the two key points may be amidships.
        spread = 0.0
    else:
        spread = 0.5
    rests = [numbers[UPRIGHT_COUNT : len(numbers) - following] for following in range(3)]
    return any(
        len(rest) % step == 0
        and _are_key_points(numbers[:UPRIGHT_COUNT], rest[::step], rest[1::step], spread)
        for rest in rests
        for step in (2, 3)
    )


def _least_skew(corners: Sequence[float]) -> float:
    """Return the `skew` of four points in the order in which it is least."""
    first, second, third, fourth = (corners[i : i + 2] for i in range(0, CORNERS_COUNT, 2))
    orders = (
        (first, second, third, fourth), (first, third, second, fourth),
        (first, second, fourth, third),
    )  # fmt: skip
    return min(skew([value for point in order for value in point]) for order in orders)


def _are_key_points(
    box: Sequence[float], xs: Sequence[float], ys: Sequence[float], spread: float
) -> bool:
    """
    Return whether points lie in an upright box, and its size is no such point.

    They extend over more than `spread` of it.
    """
    seen = [(x, y) for x, y in zip(xs, ys, strict=True) if x or y]
    if len(seen) < 2:
        return False
    sides = list(zip(box[:2], box[2:], zip(*seen, strict=True), strict=True))
    return (
        all(_contains(centre, size, values) for centre, size, values in sides)
        and any(max(values) - min(values) > spread * size for _, size, values in sides)
        and any(_is_apart(size, (centre, *values)) for centre, size, values in sides)
    )


def _contains(centre: float, size: float, values: Sequence[float]) -> bool:
    low, high = centre - 0.55 * size, centre + 0.55 * size
    return -0.1 <= low <= min(values) and max(values) <= high <= 1.1


def _is_apart(value: float, others: Sequence[float]) -> bool:
    margin = 0.1 * (max(others) - min(others))
    return not min(others) - margin <= value <= max(others) + margin


def skew(corners: Sequence[float]) -> float:
    """Return how far the corners x1 y1 … x4 y4 are from a parallelogram, see `skews`."""
    return float(skews(np.array([corners]))[0])


def skews(corners: FloatArray) -> FloatArray:
    """
    Return how far N boxes are from parallelograms, as a share of their longer diagonal, (N,).

    `corners` has x1 y1 … x4 y4 in rows, (N, 8). The result is 0 where they are all the same, and
    NaN where it overflows.
    """
    ax, ay, bx, by, cx, cy, dx, dy = corners.T
    with np.errstate(over='ignore', invalid='ignore'):
        longest = np.maximum(np.hypot(ax - cx, ay - cy), np.hypot(bx - dx, by - dy))
        gap = np.hypot(ax - bx + cx - dx, ay - by + cy - dy)
        return gap / np.where(longest == 0.0, 1.0, longest)


def parse_table(
    rows: Sequence[Fields], ends_of: Callable[[Sequence[Fields]], Ends], count: int
) -> YoloTable:
    """
    Parse lines with `count` coordinates by columns.

    Raises ValueError, without a reason, if one of them is malformed or has another number of them.
    """
    indices, *columns = zip(*rows, strict=True)
    numbers = text.parse_columns(columns)
    confidence, track = ends = ends_of(rows)
    coordinates, scores = numbers[:, :count], np.ones(len(rows))
    tracks = columns[-1] if track else ('',) * len(rows)
    if confidence:
        scores = numbers[:, count]
    if not (
        len(columns) == count + sum(ends)
        and all(map(text.is_index, {*indices}))
        and all(map(text.is_index, tracks if track else ()))
        and text.are_normalised(coordinates).all()
        and ((scores >= 0.0) & (scores <= 1.0)).all()
    ):
        raise ValueError
    return YoloTable(indices, coordinates, scores, tracks)


def parse_upright(line: str, ends: Ends) -> YoloLine:
    """Parse a line with an upright box; raise ValueError if it is malformed."""
    fields = line.split()
    if not UPRIGHT_COUNT < len(fields) <= UPRIGHT_COUNT + 3:
        raise ValueError(f'{len(fields)} fields, expected 5 to 7: {UPRIGHT_FIELDS}')
    if len(fields) == UPRIGHT_COUNT + 3:
        ends = Ends(confidence=True, track=True)
    elif len(fields) == UPRIGHT_COUNT + 1:
        ends = Ends()
    return _parsed(fields, ends)


def parse_polygon(line: str, ends: Ends) -> YoloLine:
    """Parse a line with four corners or more points; raise ValueError if it is malformed."""
    fields = line.split()
    count = len(fields) - 1 - sum(ends)
    if count < CORNERS_COUNT or count % 2:
        following = ' and '.join(name for name, there in ends._asdict().items() if there)
        raise ValueError(
            f'{len(fields)} fields do not fit this file, where {following or "nothing"} follows '
            f'the points: {POLYGON_FIELDS}'
        )
    parsed = _parsed(fields, ends)
    points = parsed.coordinates
    if len(points) > CORNERS_COUNT and points[:2] == points[-2:]:
        return parsed._replace(coordinates=points[:-2])
    return parsed


def _parsed(fields: Fields, ends: Ends) -> YoloLine:
    if not text.is_index(fields[0]):
        raise ValueError(f'class index {fields[0]!r} is not a whole number')
    end = len(fields) - sum(ends)
    coordinates = text.parse_numbers(fields[1:end])
    if not text.is_normalised(coordinates):
        raise ValueError('the box is not normalised to 0..1')
    confidence = fields[end] if ends.confidence else ''
    track = fields[-1] if ends.track else ''
    if confidence and not 0.0 <= text.parse_number(confidence) <= 1.0:
        raise ValueError(f'confidence {confidence} is not within 0..1')
    if track and not text.is_index(track):
        raise ValueError(f'track id {track} is not a whole number')
    return YoloLine(fields[0], coordinates, confidence, track)
