# SPDX-License-Identifier: Apache-2.0
"""The ships of ship lists and chips that came down: one row for each tracked object."""

from __future__ import annotations

import math
from bisect import bisect_left
from collections import Counter
from collections.abc import Iterable
from collections.abc import Iterator
from collections.abc import Sequence
from dataclasses import dataclass
from dataclasses import field
from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np

from obbhbb_ros.earth.ellipsoid import to_ecef
from obbhbb_ros.geometry.boxes import FloatArray
from obbhbb_ros.ground.received import Received
from obbhbb_ros.ground.received import ReceivedChip
from obbhbb_ros.ground.received import ReceivedList
from obbhbb_ros.reports.ship_report import ShipReport
from obbhbb_ros.reports.ship_report import joined_reports

# Mean radius of the Earth, metres: from the chord to the distance along the ground.
_RADIUS = 6_371_008.8


@dataclass(frozen=True)
class ShipRow:
    """
    What is known of a ship.

    Attributes
    ----------
    facts : ShipReport
        Its facts. Place, size and course are those with the smallest uncertainty, or the last;
        class and score those of the highest score; speed the last.
    best_view : ReceivedChip or None
        Its best chip of which the file is there.
    files : tuple of Path
        All files that show or name it.
    other_ids : tuple of str
        The ids of what was joined to it.
    spans : tuple of tuple of int
        When each of its objects was seen, from the earliest to the latest time that is possible,
        milliseconds since 1970.
    """

    facts: ShipReport
    best_view: ReceivedChip | None
    files: tuple[Path, ...]
    other_ids: tuple[str, ...] = ()
    spans: tuple[tuple[int, int], ...] = ()


@dataclass
class _Object:
    """What names a ship: reports of lists, chips, and their files."""

    reports: list[ShipReport] = field(default_factory=list)
    chips: list[ReceivedChip] = field(default_factory=list)
    files: dict[Path, None] = field(default_factory=dict)


def ship_rows(folders: Iterable[Received], left_out: Counter[str]) -> list[ShipRow]:
    """
    Make a row of all that lists and chips say of each tracked object.

    Parameters
    ----------
    folders : iterable of Received
        What came down. Chips and lists that are in several of them count once.
    left_out : Counter
        Counts what has no row, by the reason: ships without a place, chips whose JSON is damaged.

    Returns
    -------
    list of ShipRow
        By the first time, then the id.
    """
    objects: dict[str | int, _Object] = {}
    read = list(folders)
    for ship_list in _lists(read):
        for report in ship_list.ships:
            ship = objects.setdefault(report.id or len(objects), _Object())
            ship.reports.append(report)
            ship.files[ship_list.path] = None
    for chip in _chips(read, left_out):
        ship = objects.setdefault(chip.facts['object'] or len(objects), _Object())
        ship.chips.append(chip)
        ship.files[chip.path] = None
    rows = [row for ship in objects.values() if (row := _row(ship))]
    left_out['ships without a place'] += len(objects) - len(rows)
    return sorted(rows, key=_time_order)


def _lists(read: Iterable[Received]) -> list[ReceivedList]:
    """List the ship lists once."""
    return list({ships.digest: ships for received in read for ships in received.lists}.values())


def _chips(read: Iterable[Received], left_out: Counter[str]) -> Iterator[ReceivedChip]:
    """Yield the chips once, with their file if any folder has it."""
    chips: dict[str, ReceivedChip] = {}
    for received in read:
        for chip in received.chips:
            if not chip.is_sealed:
                left_out['chips whose JSON is damaged'] += 1
            elif (known := chips.get(chip.facts['id'])) is None or known.damage:
                chips[chip.facts['id']] = chip
    yield from chips.values()


def _row(ship: _Object) -> ShipRow | None:
    """Make the row of an object; None if nothing tells where it was."""
    reports = [*ship.reports, *filter(None, map(chip_report, ship.chips))]
    if not reports:
        return None
    times = [chip.time for chip in ship.chips]
    facts = replace(
        _combined(reports),
        first=min([*times, *(report.first for report in reports)]),
        last=max([*times, *(report.last for report in reports)]),
        # The images of chips are among those of the lists, if there is a list.
        views=max(sum(report.views for report in ship.reports), len(set(times))),
    )
    return ShipRow(facts, _best_view(ship.chips), tuple(ship.files), spans=(_span(ship),))


def _span(ship: _Object) -> tuple[int, int]:
    """Return when an object was seen, rounded as in lists: so that of one image all times agree."""
    times = [chip.time for chip in ship.chips]
    for one in ship.reports:
        times += one.first - one.time_error, one.last + one.time_error
    return round(min(times) / 1e6), round(max(times) / 1e6)


def chip_report(chip: ReceivedChip) -> ShipReport | None:
    """Turn the JSON of a chip into a report; None if it has no position."""
    facts, place = chip.facts, chip.facts['position']
    if place is None:
        return None
    return ShipReport(
        id=facts['object'] or '',
        latitude=place['lat'],
        longitude=place['lon'],
        course=place['course'],
        course_ambiguous=place['course_ambiguous'],
        length_m=place['length_m'],
        width_m=place['width_m'],
        sigma_m=None if place['sigma_m'] is None else tuple(place['sigma_m']),
        class_id=facts['class_id'],
        score=facts['score'],
        first=chip.time,
        last=chip.time,
    )


def _combined(reports: Iterable[ShipReport]) -> ShipReport:
    """Take the best of each fact, see `joined_reports`."""
    return joined_reports(*sorted(reports, key=lambda report: report.last))


def _spread_order(report: ShipReport) -> tuple[float, int]:
    """Return a key that sorts reports by how well a ship is placed."""
    return (math.inf if report.sigma_m is None else report.sigma_m[0]), -report.last


def _best_view(chips: Iterable[ReceivedChip | None]) -> ReceivedChip | None:
    """Choose the most valuable chip of which the file is there."""
    there = [chip for chip in chips if chip is not None and chip.size is not None]
    return max(there, key=lambda chip: chip.worth, default=None)


# Joining and choosing by place ----------------------------------------------------------------


def merged_within(rows: Sequence[ShipRow], distance: float) -> list[ShipRow]:
    """
    Join the rows of one place.

    The best placed row comes first; a row joins the nearest one before it within the distance,
    unless both were seen at the same time: then they are two ships.

    Parameters
    ----------
    rows : sequence of ShipRow
        The rows.
    distance : float
        Metres.

    Returns
    -------
    list of ShipRow
        In the order of `ship_rows`.
    """
    groups = _Groups(rows, distance)
    for number in sorted(range(len(rows)), key=lambda number: _spread_order(rows[number].facts)):
        groups.put(number)
    return sorted(map(_joined, groups.members.values()), key=_time_order)


class _Groups:
    """Rows of one place, by the number of their first row; each is in a cell of space."""

    def __init__(self, rows: Sequence[ShipRow], distance: float) -> None:
        self.members: dict[int, list[ShipRow]] = {}
        self._rows, self._distance, self._points = rows, distance, _points(rows)
        self._cells: dict[tuple[int, int, int], list[int]] = {}
        # First and last time, and whether a row may fit in between.
        self._times = np.array([row.spans[0] for row in rows], float).reshape(-1, 2)
        self._has_gaps = np.zeros(len(rows), bool)
        # When the rows of a group were seen, in order.
        self._spans: dict[int, list[tuple[int, int]]] = {}

    def put(self, number: int) -> None:
        """Put a row into the nearest group that may have it, or into a new one."""
        x, y, z = np.floor(self._points[number] / self._distance).astype(int).tolist()
        around = product((x - 1, x, x + 1), (y - 1, y, y + 1), (z - 1, z, z + 1))
        (span,) = self._rows[number].spans
        for group in self._near(number, around):
            spans = self._spans[group]
            place = bisect_left(spans, span)
            if _is_free(spans, place, span):
                spans.insert(place, span)
                self.members[group].append(self._rows[number])
                begin, end = self._times[[group, number]].T
                self._times[group] = begin.min(), end.max()
                self._has_gaps[group] = True
                return
        self.members[number], self._spans[number] = [self._rows[number]], [span]
        self._cells.setdefault((x, y, z), []).append(number)

    def _near(self, number: int, cells: Iterable[tuple[int, int, int]]) -> list[int]:
        """List the groups that may have a row, the nearest first."""
        groups = np.array([group for cell in cells for group in self._cells.get(cell, ())], int)
        away = np.linalg.norm(self._points[groups] - self._points[number], axis=1)
        (first, last), (begin, end) = self._times[number], self._times[groups].T
        may_join = (end < first) | (last < begin) | self._has_gaps[groups]
        near = np.flatnonzero((away <= self._distance) & may_join)
        return groups[near[np.argsort(away[near])]].tolist()


def _is_free(spans: Sequence[tuple[int, int]], place: int, span: tuple[int, int]) -> bool:
    """Tell whether a span of time fits at a place between others that do not meet."""
    first, last = span
    is_after = not place or spans[place - 1][1] < first
    return is_after and (place == len(spans) or last < spans[place][0])


def _joined(group: Sequence[ShipRow]) -> ShipRow:
    """Join rows."""
    facts = _combined(row.facts for row in group)
    ids = dict.fromkeys(row.facts.id for row in group)
    return ShipRow(
        facts,
        _best_view(row.best_view for row in group),
        tuple(dict.fromkeys(path for row in group for path in row.files)),
        tuple(name for name in ids if name not in ('', facts.id)),
        tuple(span for row in group for span in row.spans),
    )


def near_to(rows: Sequence[ShipRow], place: tuple[float, float], distance: float) -> list[ShipRow]:
    """
    Choose the ships around a place.

    Parameters
    ----------
    rows : sequence of ShipRow
        The rows.
    place : tuple of float
        Latitude and longitude, degrees.
    distance : float
        Along the ground, metres; right to 0.3 % of what the Earth bends in between.
    """
    chord = 2.0 * _RADIUS * math.sin(min(distance / (2.0 * _RADIUS), math.pi / 2))
    away = np.linalg.norm(_points(rows) - to_ecef(*place, 0.0), axis=1)
    return [row for row, is_near in zip(rows, (away <= chord).tolist(), strict=True) if is_near]


def _points(rows: Sequence[ShipRow]) -> FloatArray:
    """Give the places of rows in ECEF, metres, shape (N, 3)."""
    latitudes = np.array([row.facts.latitude for row in rows])
    return to_ecef(latitudes, np.array([row.facts.longitude for row in rows]), 0.0)


def _time_order(row: ShipRow) -> tuple[int, str]:
    """Return a key that sorts rows by their first time, then the id."""
    return row.facts.first, row.facts.id
