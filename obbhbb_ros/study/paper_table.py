# SPDX-License-Identifier: Apache-2.0
"""The paper's Table 1, compared with the same figures on the synthetic hulls."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np

from obbhbb_ros.geometry.converter import PAPER_RULE
from obbhbb_ros.geometry.converter import HullRule
from obbhbb_ros.geometry.converter import convert_by_rule
from obbhbb_ros.study import hulls
from obbhbb_ros.study.metrics import overlap_with_hbb
from obbhbb_ros.study.ships import Ships

# By family and row (N outer, M midpoint, S shape-aware), one number per level of `FULLNESS`.
PAPER_TABLE: MappingProxyType[tuple[str, str], tuple[float, ...]] = MappingProxyType(
    {
        ('rectangular', 'N'): (0.211, 0.127, 0.073, 0.000),
        ('rectangular', 'M'): (0.218, 0.267, 0.298, 0.342),
        ('rectangular', 'S'): (0.264, 0.293, 0.310, 0.333),
        ('tapered', 'N'): (0.421, 0.376, 0.347, 0.305),
        ('tapered', 'M'): (0.104, 0.128, 0.143, 0.167),
        ('tapered', 'S'): (0.174, 0.187, 0.195, 0.208),
        ('bow_stern', 'N'): (0.277, 0.199, 0.148, 0.077),
        ('bow_stern', 'M'): (0.191, 0.234, 0.261, 0.301),
        ('bow_stern', 'S'): (0.234, 0.258, 0.272, 0.290),
        ('fine', 'N'): (0.413, 0.366, 0.335, 0.290),
        ('fine', 'M'): (0.108, 0.133, 0.150, 0.175),
        ('fine', 'S'): (0.175, 0.188, 0.195, 0.207),
    }
)
PAPER_ROWS: MappingProxyType[str, HullRule] = MappingProxyType(
    {'N': HullRule('outer'), 'M': HullRule('midpoint'), 'S': PAPER_RULE}
)


@dataclass(frozen=True)
class Comparison:
    """A mean relative error in the paper's Table 1, and ours."""

    family: str
    row: str
    fullness: float
    paper: float
    ours: float

    @property
    def fitted(self) -> bool:
        """Whether the hulls are fitted to the paper's number."""
        return self.row == 'N' and self.fullness == 1.0

    @property
    def deviation(self) -> float:
        """Ours minus the paper's."""
        return self.ours - self.paper

    def __str__(self) -> str:
        """Return both, and the deviation or that the number was fitted."""
        deviation = 'fitted' if self.fitted else f'{self.deviation:+.3f}'
        return f'{self.paper:.3f}  {self.ours:.3f}  {deviation}'


def _relative_errors(ships: Ships, rule: HullRule) -> dict[str, float]:
    """Compute the mean relative error (Eq. relerr) of a rule by class."""
    errors = overlap_with_hbb(convert_by_rule(ships.boxes, rule), ships.reference).relative_error
    return {
        name: float(errors[ships.class_ids == name].mean())
        for name in np.unique(ships.class_ids).tolist()
    }


def paper_comparison() -> list[Comparison]:
    """Compare the 48 numbers of the paper's Table 1 with ours; 4 of them are fitted."""
    ships = hulls.synthetic_ships(seed=None)
    errors = {row: _relative_errors(ships, rule) for row, rule in PAPER_ROWS.items()}
    return [
        Comparison(family, row, full, paper, errors[row][hulls.class_name(family, full)])
        for (family, row), numbers in PAPER_TABLE.items()
        for full, paper in zip(hulls.FULLNESS, numbers, strict=True)
    ]


def mean_deviation(comparisons: Sequence[Comparison], row: str) -> float:
    """Average the absolute deviations of the predicted numbers of a row, N, M or S."""
    return float(np.mean([abs(c.deviation) for c in comparisons if c.row == row and not c.fitted]))
