# SPDX-License-Identifier: Apache-2.0
"""
The synthetic harbour in the package.

`python -m obbhbb_ros.study.harbour FILE` writes it; a test compares it with the file in the
package. Ships of random size lie at anchor or side by side at piers, and their hulls are one
outline scaled to each ship.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from collections.abc import Sequence
from dataclasses import dataclass
from dataclasses import replace
from pathlib import Path

import numpy as np

from obbhbb_ros.data import HARBOUR
from obbhbb_ros.data import HARBOUR_SIZE
from obbhbb_ros.geometry.boxes import FloatArray
from obbhbb_ros.labels import ImageLabels
from obbhbb_ros.labels import write_labels
from obbhbb_ros.study.metrics import bounds

SEED = 20260622
_PIERS = ((170.0, 330.0, 0.35), (520.0, 560.0, -0.9), (820.0, 250.0, 1.25))
_BERTHS = 5
_ANCHORED = 22
_GAP = 6.0
# Shift of the ships from one image to the next, pixels.
_DRIFT = (-3.0, 2.0)


@dataclass(frozen=True)
class Ship:
    """A ship: centre, length and width in pixels, heading in radians from image +x, class."""

    x: float
    y: float
    length: float
    width: float
    heading: float
    class_id: str

    @property
    def radius(self) -> float:
        """Half the diagonal, pixels."""
        return float(np.hypot(self.length, self.width)) / 2.0

    def place(self, points: FloatArray) -> FloatArray:
        """Put points of the unit box [-1, 1]^2, bow at +x, on this ship; (K, 2) to (K, 2)."""
        along, across = points.T * [[self.length / 2.0], [self.width / 2.0]]
        cos, sin = np.cos(self.heading), np.sin(self.heading)
        x = self.x + along * cos - across * sin
        y = self.y + along * sin + across * cos
        return np.round(np.stack((x, y), axis=1), 3)


def outline(points: int = 12) -> FloatArray:
    """
    Draw a merchant hull in the unit box: rounded stern, parallel sides, pointed bow.

    The vertices, (2 * points + 5, 2), are in order and touch all four sides of [-1, 1]^2.
    """
    t = np.linspace(0.0, 1.0, points)
    # The sides run parallel over two thirds of the length, then close on a parabola.
    bow = np.stack((0.3 + 0.7 * t, 1.0 - t**2), axis=1)
    stern = np.array([[-0.7, 1.0], [-0.93, 0.85], [-1.0, 0.5]])
    starboard = np.concatenate((stern[::-1], bow))
    port = starboard[::-1] * [1.0, -1.0]
    return np.concatenate((starboard, port[1:]))


def ships() -> list[Ship]:
    """Lay out the harbour; the same ships every time."""
    random = np.random.default_rng(SEED)
    berthed = [ship for pier in _PIERS for ship in _moor(random, *pier)]
    anchored: list[Ship] = []
    while len(anchored) < _ANCHORED:
        ship = _at_anchor(random)
        others = berthed + anchored
        if all(np.hypot(ship.x - o.x, ship.y - o.y) > ship.radius + o.radius for o in others):
            anchored.append(ship)
    return berthed + anchored


def harbour() -> ImageLabels:
    """Label the harbour: oriented boxes, hulls and, as reference, the bounds of each hull."""
    fleet = ships()
    box = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
    hulls = tuple(ship.place(outline()) for ship in fleet)
    return ImageLabels(
        image='harbour',
        corners=np.stack([ship.place(box) for ship in fleet]),
        class_ids=tuple(ship.class_id for ship in fleet),
        ids=tuple(str(i) for i in range(len(fleet))),
        scores=_scores(fleet),
        reference=bounds(np.array(hulls)),
        hulls=hulls,
        size=HARBOUR_SIZE,
        source=Path(HARBOUR),
    )


def _scores(fleet: Sequence[Ship]) -> FloatArray:
    """Score ships as a detector might, small ones lower on average; the same every time."""
    random = np.random.default_rng(SEED + 1)
    sureness = np.array([2.0 + ship.length / 10.0 for ship in fleet])
    return np.round(random.beta(sureness, 2.0), 2)


def passing(labels: ImageLabels, count: int) -> Iterator[ImageLabels]:
    """Label images of a camera that moves on over labelled ships, a little with each image."""
    for i in range(count):
        shift = np.array(_DRIFT) * i
        yield replace(
            labels,
            image=f'{labels.image}_{i}',
            corners=labels.corners + shift,
            reference=labels.reference + np.tile(shift, 2),
            hulls=tuple(None if hull is None else hull + shift for hull in labels.hulls),
        )


def _moor(random: np.random.Generator, x: float, y: float, heading: float) -> Iterator[Ship]:
    """Lay ships side by side, bow to the pier."""
    along = np.array([np.cos(heading), np.sin(heading)])
    across = np.array([-np.sin(heading), np.cos(heading)])
    offset = 0.0
    for _ in range(_BERTHS):
        length = random.uniform(90.0, 130.0)
        width = length / random.uniform(4.0, 7.0)
        offset += width / 2.0
        center = (x, y) + across * offset - along * length / 2.0
        yield Ship(center[0], center[1], length, width, heading, 'cargo')
        offset += width / 2.0 + _GAP


def _at_anchor(random: np.random.Generator) -> Ship:
    """Place a ship anywhere in the image, at any heading."""
    class_id = str(random.choice(['tug', 'cargo', 'tanker'], p=[0.4, 0.35, 0.25]))
    low, high = {'tug': (22.0, 40.0), 'cargo': (60.0, 120.0), 'tanker': (100.0, 170.0)}[class_id]
    length = random.uniform(low, high)
    width = length / random.uniform(*((2.2, 3.2) if class_id == 'tug' else (5.0, 8.0)))
    x, y = (random.uniform(0.55 * length, side - 0.55 * length) for side in HARBOUR_SIZE)
    return Ship(x, y, length, width, random.uniform(-np.pi, np.pi), class_id)


if __name__ == '__main__':
    write_labels(sys.argv[1], [harbour()])
