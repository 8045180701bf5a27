# SPDX-License-Identifier: Apache-2.0
"""What a calibration optimises; `coverage.py` has the objective with a guarantee."""

from __future__ import annotations

from abc import ABC
from abc import abstractmethod
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from obbhbb_ros.geometry.boxes import FloatArray
from obbhbb_ros.geometry.converter import HullRule
from obbhbb_ros.study.bootstrap import Interval
from obbhbb_ros.study.grid_search import Bench
from obbhbb_ros.study.metrics import Overlap
from obbhbb_ros.study.ships import Ships


@dataclass(frozen=True)
class Objective(ABC):
    """
    What to optimise on ships.

    Attributes
    ----------
    keep : float
        A ship counts as kept if its box contains this share of its reference box, in (0, 1].
    name, summary : str
        Its name on the command line, and what it looks for.
    metric, unit : str
        The field of `obbhbb_ros.study.evaluation.Score` that it optimises, and what to call it.
    sign : float
        1 if the metric is to grow, -1 if it is to fall.
    parameters : tuple of str
        The parameters of a rule that are searched: q, f and s, or the first two.

    Raises
    ------
    ValueError
        If a value is out of range; the message names it.
    """

    keep: float = 0.95
    name: ClassVar[str]
    summary: ClassVar[str]
    metric: ClassVar[str]
    unit: ClassVar[str]
    sign: ClassVar[float] = 1.0
    parameters: ClassVar[tuple[str, ...]] = ('q', 'f', 's')

    def __post_init__(self) -> None:
        """Check every value."""
        if not 0.0 < self.keep <= 1.0:
            raise ValueError(f'keep must be in (0, 1], not {self.keep}')

    @abstractmethod
    def value(self, bench: Bench, extents: FloatArray) -> tuple[float, ...]:
        """
        Rate boxes by their half-extents, (2, N), pixels: the tuple is to be maximised.

        Its first number is the metric times `sign`, the others break ties.
        """

    def shaping_ships(self, ships: Ships, seed: int) -> Ships:
        """Select the ships that `parameters` are fitted to."""
        return ships

    def finish(self, rule: HullRule, ships: Ships, seed: int) -> HullRule:
        """Fit what is left once `parameters` are fitted to the `shaping_ships`."""
        return rule

    def is_enough(self, ships: Ships, seed: int) -> bool:
        """Check whether the ships of two or more images are enough for a rule."""
        return True

    def scatter(self, ships: Ships, rule: HullRule, seed: int) -> Interval | None:
        """Estimate how what the rule guarantees scatters; None if it guarantees nothing."""
        return None


class OverlapObjective(Objective):
    """An objective that is the mean of a metric of the overlap; can also fit q_bow and q_stern."""

    @abstractmethod
    def ship_values(self, overlap: Overlap) -> tuple[FloatArray, ...]:
        """Compute the metric of each ship, (N,), then what breaks ties, (N,) each."""

    def mean_values(self, overlap: Overlap) -> tuple[float, ...]:
        """Average `ship_values` over the ships."""
        return tuple(float(values.mean()) for values in self.ship_values(overlap))

    def value(self, bench: Bench, extents: FloatArray) -> tuple[float, ...]:
        """Rate boxes by their half-extents, see `Objective.value`."""
        return self.mean_values(bench.overlap(extents))


class MeanIou(OverlapObjective):
    """The largest mean IoU."""

    name = 'mean_iou'
    summary = 'the largest mean IoU'
    metric = 'iou'
    unit = 'mean IoU'

    def ship_values(self, overlap: Overlap) -> tuple[FloatArray, ...]:
        """Return the IoU of each ship."""
        return (overlap.iou,)


class Match50(OverlapObjective):
    """The most ships with an IoU of 0.5 or more, then the largest mean IoU."""

    name = 'match50'
    summary = 'the most ships with an IoU of 0.5 or more, then the largest mean IoU'
    metric = 'match'
    unit = 'match50'

    def ship_values(self, overlap: Overlap) -> tuple[FloatArray, ...]:
        """Return the matches, 0 or 1, and the IoU of each ship."""
        return overlap.match(0.5).astype(np.float64), overlap.iou
