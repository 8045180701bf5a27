# SPDX-License-Identifier: Apache-2.0
"""A ship of a ship list: where it was, how large, on what course, when."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from dataclasses import replace

from obbhbb_ros.errors import ObbhbbError

__all__ = [
    'MAX_LIST_BYTES',
    'MAX_SHIPS',
    'ShipListError',
    'ShipReport',
    'joined_reports',
    'most_valuable',
    'value_order',
]

MAX_LIST_BYTES = 2**24
"""Maximum unpacked size of a list that is read: some 50,000 ships."""
MAX_SHIPS = 20_000
"""Maximum number of ships that are remembered for the next list, or that wait in a list."""

# If uncertainties differ by less than this factor, they do not say which report is better.
_ALIKE = 0.9


class ShipListError(ObbhbbError, ValueError):
    """A file is not a ship list, or is damaged; the text says why."""


@dataclass(frozen=True, kw_only=True)
class ShipReport:
    """
    What a ship list says about a ship.

    Attributes
    ----------
    id : str
        Its id, as in `tracked_detections`; empty if it is not known.
    latitude, longitude : float
        Degrees, WGS84.
    course : float
        Degrees from north, clockwise: of the bow, in [0, 360); of either end, in [0, 180), where
        `course_ambiguous`.
    course_ambiguous : bool
        Whether the course may be the opposite one.
    length_m, width_m : float
        Metres.
    sigma_m : tuple of float, or None
        Half the major and half the minor axis of the error ellipse (one standard deviation,
        metres), and the azimuth of the major one in degrees from north; None if not known.
    class_id : str
        Its class; empty if it is not known.
    score : float or None
        Its score; None if it is not known.
    first, last : int
        Stamps of the first and the last image with the ship, nanoseconds since 1970.
    views : int
        Number of images that show it, at least 1.
    speed, speed_sigma : float or None
        Speed over ground and its standard deviation, m/s; None where it is not significant.
    course_over_ground, course_over_ground_sigma : float or None
        Degrees from north, clockwise, and its standard deviation; None where not significant.
    """

    id: str
    latitude: float
    longitude: float
    course: float
    course_ambiguous: bool
    length_m: float
    width_m: float
    sigma_m: tuple[float, float, float] | None = None
    class_id: str = ''
    score: float | None = None
    first: int
    last: int
    views: int = 1
    speed: float | None = None
    speed_sigma: float | None = None
    course_over_ground: float | None = None
    course_over_ground_sigma: float | None = None


def value_order(ship: ShipReport) -> tuple[float, int, str]:
    """
    Return a key that sorts ships by their value: by score, the latest of equals first.

    Examples
    --------
    >>> tug = ShipReport(
    ...     id='a-1', latitude=36.1, longitude=-5.4, course=12.0, course_ambiguous=True,
    ...     length_m=30.0, width_m=9.0, score=0.5, first=5, last=5,
    ... )
    >>> value_order(tug)
    (-0.5, -5, 'a-1')
    """
    return -(ship.score or 0.0), -ship.last, ship.id


def most_valuable(ships: Sequence[ShipReport], count: int) -> list[ShipReport]:
    """Return the most valuable ships, at most `count`, in the order in which they are given."""
    if count >= len(ships):
        return list(ships)
    ranked = sorted(range(len(ships)), key=lambda row: value_order(ships[row]))
    return [ships[row] for row in sorted(ranked[:count])]


def joined_reports(earlier: ShipReport, later: ShipReport) -> ShipReport:
    """
    Join what two lists say about one ship.

    Place, course and size are those with the smaller uncertainty; if the uncertainties are alike,
    those with more views, because the border of the image may cut a ship. Class and score are the
    most certain ones; speed and its course those of the later list, if it has them.

    Examples
    --------
    >>> seen = ShipReport(
    ...     id='a-1', latitude=36.1, longitude=-5.4, course=12.0, course_ambiguous=True,
    ...     length_m=30.0, width_m=9.0, first=5, last=7, views=2, score=0.5, class_id='tug',
    ... )
    >>> again = replace(seen, latitude=36.2, first=9, last=9, views=1, score=0.4, class_id='boat')
    >>> both = joined_reports(seen, again)
    >>> both.latitude, both.views, both.first, both.last, both.class_id
    (36.1, 3, 5, 9, 'tug')
    """
    best = _better(earlier, later)
    surest = max((earlier, later), key=lambda ship: -1.0 if ship.score is None else ship.score)
    moving = earlier if later.speed is None else later
    return replace(
        best,
        first=min(earlier.first, later.first),
        last=max(earlier.last, later.last),
        views=earlier.views + later.views,
        class_id=surest.class_id,
        score=surest.score,
        speed=moving.speed,
        speed_sigma=moving.speed_sigma,
        course_over_ground=moving.course_over_ground,
        course_over_ground_sigma=moving.course_over_ground_sigma,
    )


def _better(earlier: ShipReport, later: ShipReport) -> ShipReport:
    """Return the report that knows better where a ship was."""
    first, second = (ship.sigma_m[0] if ship.sigma_m else None for ship in (earlier, later))
    if (first is None) != (second is None):
        return earlier if second is None else later
    if first is not None and second is not None and not _ALIKE * first <= second <= first / _ALIKE:
        return earlier if first < second else later
    return earlier if earlier.views > later.views else later
