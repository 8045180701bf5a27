# SPDX-License-Identifier: Apache-2.0
"""The ships seen since the last list."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from obbhbb_ros.earth.ellipsoid import east_north_up
from obbhbb_ros.earth.placement import Placement
from obbhbb_ros.geometry.boxes import FloatArray
from obbhbb_ros.reports.ship_report import MAX_SHIPS
from obbhbb_ros.reports.ship_report import ShipReport
from obbhbb_ros.tracking.ground_track import GroundTrack
from obbhbb_ros.tracking.ground_track import Velocity

__all__ = ['ShipCollector']

# Maximum characters of an id or a class, so that a list of many ships stays readable.
_MAX_TEXT = 64
# A ship counts as going ahead up to this angle between its axis and its track, degrees.
_AHEAD = 30.0


class ShipCollector:
    """
    Remembers ships from image to image, until somebody takes a list of them.

    Place, course, length and width come from the best view: a view of the whole ship, then one with
    the smallest uncertainty, or with the camera highest above it. Class and score are the most
    certain ones. A ship under way goes bow first: its track tells bow from stern.
    """

    def __init__(self) -> None:
        self._ships: dict[str, _SeenShip] = {}

    def __len__(self) -> int:
        """Count the ships."""
        return len(self._ships)

    def note(
        self,
        stamp: int,
        ids: Sequence[str],
        class_ids: Sequence[str],
        scores: FloatArray,
        whole: NDArray[np.bool_],
        places: Placement,
    ) -> int:
        """
        Note the ships of an image.

        Parameters
        ----------
        stamp : int
            Stamp of the image, nanoseconds.
        ids, class_ids : sequence of str
            N ids and classes.
        scores : ndarray, shape (N,)
            Their scores.
        whole : ndarray of bool, shape (N,)
            Whether the image shows the whole ship.
        places : Placement
            Where the N ships are.

        Returns
        -------
        int
            How many ships with a place are not remembered: they have no id or one of more than 64
            characters, or there are too many. A longer class is cut.
        """
        ellipses, spread = places.ellipses, places.covariance
        forgotten = 0
        for row in np.flatnonzero(places.unplaced == 0).tolist():
            ship = self._ships.get(ids[row])
            if ship is None:
                if not 0 < len(ids[row]) <= _MAX_TEXT or len(self._ships) >= MAX_SHIPS:
                    forgotten += 1
                    continue
                ship = self._ships[ids[row]] = _SeenShip(stamp, places, row)
            ellipse = _known(None if ellipses is None else ellipses[row])
            variance = None if spread is None else float(spread[row, :2, :2].trace()) / 2
            ship.track(stamp, places.points[row], variance)
            quality = (bool(whole[row]), -ellipse[0] if ellipse else -math.inf)
            best = (*quality, float(places.elevation[row]))
            report = _report(ids[row], stamp, places, row, ellipse)
            score = float(scores[row])
            ship.note(
                report, best, class_ids[row][:_MAX_TEXT], score if math.isfinite(score) else None
            )
        return forgotten

    def take(self) -> list[ShipReport]:
        """Return the ships in the order in which they were first seen, and forget them."""
        ships, self._ships = self._ships, {}
        return [ship.report() for ship in ships.values()]


class _SeenShip:
    """A ship that was seen."""

    def __init__(self, stamp: int, places: Placement, row: int) -> None:
        self._first, self._start = stamp, places.points[row]
        self._axes = east_north_up(places.latitude[row], places.longitude[row])[:2]
        self._track = GroundTrack()
        self._best: tuple[ShipReport, tuple[float, ...]] | None = None
        self._last, self._class_id, self._score = stamp, '', -math.inf

    def track(self, stamp: int, point: FloatArray, variance: float | None) -> None:
        """Add a place to its track."""
        east, north = self._axes @ (point - self._start)
        known = variance if variance is not None and math.isfinite(variance) else None
        self._track.add((stamp - self._first) * 1e-9, float(east), float(north), known)

    def note(
        self, report: ShipReport, quality: tuple[float, ...], class_id: str, score: float | None
    ) -> None:
        """Keep what a view says better than those before."""
        self._first, self._last = min(self._first, report.first), max(self._last, report.last)
        if self._best is None or quality > self._best[1]:
            self._best = report, quality
        if score is not None and score > self._score:
            self._class_id, self._score = class_id, score
        elif math.isinf(self._score):
            self._class_id = class_id

    def report(self) -> ShipReport:
        """Report what is known about it."""
        assert self._best is not None
        velocity = self._track.velocity()
        report = replace(
            self._best[0],
            first=self._first,
            last=self._last,
            views=self._track.views,
            class_id=self._class_id,
            score=None if math.isinf(self._score) else self._score,
        )
        return report if velocity is None else _under_way(report, velocity)


def _report(
    ship: str,
    stamp: int,
    places: Placement,
    row: int,
    ellipse: tuple[float, float, float] | None,
) -> ShipReport:
    """Report what one view says about a ship."""
    return ShipReport(
        id=ship,
        latitude=float(places.latitude[row]),
        longitude=float(places.longitude[row]),
        course=float(places.course[row]),
        course_ambiguous=not places.has_bow[row],
        length_m=float(places.length[row]),
        width_m=float(places.width[row]),
        sigma_m=ellipse,
        first=stamp,
        last=stamp,
    )


def _known(ellipse: FloatArray | None) -> tuple[float, float, float] | None:
    """Return an error ellipse; None if it is not known."""
    if ellipse is None or not np.isfinite(ellipse).all():
        return None
    major, minor, azimuth = ellipse.tolist()
    return major, minor, azimuth


def _under_way(report: ShipReport, velocity: Velocity) -> ShipReport:
    """Add speed and course over ground, and turn the bow into the direction of travel."""
    moving = replace(
        report,
        speed=velocity.speed,
        speed_sigma=velocity.speed_sigma,
        course_over_ground=velocity.course,
        course_over_ground_sigma=velocity.course_sigma,
    )
    if not report.course_ambiguous:
        return moving
    for course in (report.course % 360.0, (report.course + 180.0) % 360.0):
        off = abs((course - velocity.course + 180.0) % 360.0 - 180.0)
        if off + velocity.course_sigma <= _AHEAD:
            return replace(moving, course=course, course_ambiguous=False)
    return moving
