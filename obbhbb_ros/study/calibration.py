# SPDX-License-Identifier: Apache-2.0
"""Calibrate a rule on labelled ships: for best IoU, most matches, or guaranteed coverage."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from dataclasses import replace
from enum import Enum
from functools import lru_cache
from itertools import product
from types import MappingProxyType

import numpy as np

from obbhbb_ros.geometry.converter import F_RANGE
from obbhbb_ros.geometry.converter import S_RANGE
from obbhbb_ros.geometry.converter import HullRule
from obbhbb_ros.geometry.converter import convert_by_rule
from obbhbb_ros.geometry.methods import METHODS
from obbhbb_ros.study import grid_search
from obbhbb_ros.study.compass import compass_search
from obbhbb_ros.study.coverage import Coverage
from obbhbb_ros.study.folds import held_out_folds
from obbhbb_ros.study.grid_search import Bench
from obbhbb_ros.study.metrics import overlap_with_hbb
from obbhbb_ros.study.objectives import Match50
from obbhbb_ros.study.objectives import MeanIou
from obbhbb_ros.study.objectives import Objective
from obbhbb_ros.study.objectives import OverlapObjective
from obbhbb_ros.study.ships import Ships

# Below this, a gain on held-out images counts as none.
MIN_GAIN = 0.002
# Minimum number of ships for a rule of their own.
MIN_SHIPS = 30
_FOLDS = 5
_DIGITS = 4
# Bounds of u = 1 - 1/q, which runs from 0 for the rhombus to 1 for the rectangle, and of f and s.
_LOWEST = (0.0, 0.05, 0.05)
_HIGHEST = (1.0, F_RANGE.high, S_RANGE.high)

OBJECTIVES: MappingProxyType[str, type[Objective]] = MappingProxyType(
    {objective.name: objective for objective in (MeanIou, Match50, Coverage)}
)


def make_objective(
    name: str, *, keep: float = 0.95, share: float = 0.95, per_image: int = 1
) -> Objective:
    """
    Make an objective by its name, a key of `OBJECTIVES`.

    `share` and `per_image` are for `Coverage`, but checked for all. Raises ValueError if a value
    is out of range or there is no such objective.

    Examples
    --------
    >>> make_objective('coverage', share=0.9).share
    0.9
    """
    if name not in OBJECTIVES:
        raise ValueError(f'objective must be one of {", ".join(OBJECTIVES)}, not {name!r}')
    coverage = Coverage(keep, share, per_image)
    return coverage if name == coverage.name else OBJECTIVES[name](keep)


DEFAULT_OBJECTIVE = MeanIou()


class Fit(Enum):
    """Whether to fit parameters beside q; automatically: if they gain `MIN_GAIN` held out."""

    AUTO = 'auto'
    ALWAYS = 'always'
    NEVER = 'never'


@dataclass(frozen=True)
class CalibrationPlan:
    """
    How to calibrate.

    Attributes
    ----------
    method : str
        A tunable method.
    objective : Objective
        What to optimise.
    grid : Grid
        Where to search.
    refine : bool
        Whether to refine the best setting of the grid continuously. If not, nothing is held out,
        and `Fit.AUTO` fits q, f and s as Algorithm 2 does, but not q_bow and q_stern.
    f_and_s : Fit
        Whether to fit f and s beside q. With `Coverage`, s is always fitted.
    ends : Fit
        Whether to fit q_bow and q_stern where the bow is known.
    seed : int
        Seed of all splits.

    Raises
    ------
    ValueError
        If the method has no parameters; the message names it.
    """

    method: str = 'superellipse'
    objective: Objective = DEFAULT_OBJECTIVE
    grid: grid_search.Grid = grid_search.GRIDS['paper']
    refine: bool = True
    f_and_s: Fit = Fit.AUTO
    ends: Fit = Fit.AUTO
    seed: int = 0

    def __post_init__(self) -> None:
        """Check the method."""
        grid_search.tunable(self.method)


DEFAULT_PLAN = CalibrationPlan()


@dataclass(frozen=True)
class Calibrator:
    """
    A plan, and what is fitted beside q.

    Attributes
    ----------
    plan : CalibrationPlan
        How to calibrate.
    f_and_s, ends : bool
        Whether f and s, and q_bow and q_stern, are fitted.
    gain_of_f_and_s, gain_of_ends : float or None
        What they gain on held-out images; None if the plan leaves no choice.
    """

    plan: CalibrationPlan
    f_and_s: bool
    ends: bool = False
    gain_of_f_and_s: float | None = None
    gain_of_ends: float | None = None

    def fit(self, ships: Ships) -> HullRule:
        """Fit a rule to ships, see `calibrate`."""
        plan, objective = self.plan, self.plan.objective
        bench = Bench(objective.shaping_ships(ships, plan.seed), plan.method)
        q, f, s = (round(value, _DIGITS) for value in best_shape(bench, plan, self.f_and_s))
        rule = objective.finish(HullRule(plan.method, q, f, s), ships, plan.seed)
        if self.ends and isinstance(objective, OverlapObjective) and ships.boxes.bow.any():
            return fit_bow_and_stern(ships.take(ships.boxes.bow), rule, objective)
        return rule


def calibrate(ships: Ships, plan: CalibrationPlan = DEFAULT_PLAN) -> HullRule:
    """
    Find the best rule for ships.

    Parameters
    ----------
    ships : Ships
        Ships with reference boxes.
    plan : CalibrationPlan
        Objective and search space.

    Returns
    -------
    HullRule
        The rule, its parameters rounded to four decimals; those that are not fitted are 1, or None
        for q_bow and q_stern.

    Raises
    ------
    ValueError
        If a ship has no reference box, there are too few ships for the required coverage, or no s
        in its range gives it.

    Examples
    --------
    >>> from obbhbb_ros.study.hulls import FAMILIES, synthetic_ships
    >>> boxy = synthetic_ships([FAMILIES['rectangular']], [1.0], aspects=2, angles=9)
    >>> calibrate(boxy).q > 50
    True
    """
    return decide(ships, plan).fit(ships)


def decide(ships: Ships, plan: CalibrationPlan) -> Calibrator:
    """Decide on held-out images what to fit beside q, where a plan leaves that open."""
    gain, f_and_s = None, plan.f_and_s is not Fit.NEVER
    if plan.f_and_s is Fit.AUTO and plan.refine:
        gain = gain_over_q(plan.objective.shaping_ships(ships, plan.seed), plan)
        f_and_s = gain >= MIN_GAIN
    one_q = Calibrator(plan, f_and_s, gain_of_f_and_s=gain)
    if plan.ends is not Fit.AUTO:
        return replace(one_q, ends=plan.ends is Fit.ALWAYS)
    if not plan.refine or not has_ends(ships, plan):
        return one_q
    gain_of_ends = bow_gain(ships, one_q)
    return replace(one_q, ends=gain_of_ends >= MIN_GAIN, gain_of_ends=gain_of_ends)


def has_ends(ships: Ships, plan: CalibrationPlan) -> bool:
    """Check whether q_bow and q_stern can be fitted: enough ships, in two images, and a use."""
    if not isinstance(plan.objective, OverlapObjective) or not METHODS[plan.method].two_ended:
        return False
    images = ships.image_of[ships.boxes.bow]
    return len(images) >= MIN_SHIPS and len(np.unique(images)) >= 2


def best_shape(bench: Bench, plan: CalibrationPlan, f_and_s: bool) -> tuple[float, float, float]:
    """Find the best q, f and s: q alone, or all that the objective searches; the others are 1."""
    free = len(plan.objective.parameters) if f_and_s else 1
    fixed = (1.0,) * (3 - free)
    # s does not change the half-extents before shrinking.
    extents = lru_cache(maxsize=1)(bench.extents)

    def value(shape: Sequence[float]) -> tuple[float, ...]:
        q, f, s = (*shape, *fixed)
        return plan.objective.value(bench, extents(q, f) * s)

    q, *others = max(product(*(plan.grid.q, plan.grid.f, plan.grid.s)[:free]), key=value)
    if plan.refine:
        u, *others = compass_search(
            (1.0 - 1.0 / q, *others),
            lambda point: value((_exponent(point[0]), *point[1:])),
            _LOWEST[:free],
            _HIGHEST[:free],
        )
        q = _exponent(u)
    f, s = (*others, *fixed)
    return q, f, s


def _exponent(u: float) -> float:
    """Return q of u = 1 - 1/q."""
    return 1.0 / (1.0 - u) if u < 1.0 else np.inf


def gain_over_q(ships: Ships, plan: CalibrationPlan) -> float:
    """
    Measure what f and s gain over q alone on held-out images, in the metric of the objective.

    They are hardly identifiable: along a ridge of q, f and s the boxes are nearly the same. For
    `Coverage` it is f alone, as s is always fitted. 0 if there are fewer than two images.
    """
    folds, gain = min(_FOLDS, ships.image_count), 0.0
    if folds < 2:
        return 0.0
    for training, rows in held_out_folds(ships, folds, plan.seed):
        bench, new = Bench(training, plan.method), Bench(ships.take(rows), plan.method)
        shapes = [best_shape(bench, plan, f_and_s) for f_and_s in (True, False)]
        more, base = (plan.objective.value(new, new.extents(q, f) * s)[0] for q, f, s in shapes)
        # Without any ship in reach the difference is that of two infinities.
        gain += (more - base) * float(np.mean(rows)) if more > -np.inf else -np.inf
    return gain


def fit_bow_and_stern(ships: Ships, rule: HullRule, objective: OverlapObjective) -> HullRule:
    """
    Fit q_bow and q_stern to ships whose bow is known, beginning at the q of a rule.

    f and s are those of the rule. Raises ValueError if the method has no ends.
    """
    if not METHODS[rule.method].two_ended:
        raise ValueError(f'{rule.method} has no q_bow and q_stern')

    def with_ends(u_bow: float, u_stern: float) -> HullRule:
        q_bow, q_stern = (round(_exponent(u), _DIGITS) for u in (u_bow, u_stern))
        return replace(rule, q_bow=q_bow, q_stern=q_stern)

    def value(rule: HullRule) -> tuple[float, ...]:
        boxes = convert_by_rule(ships.boxes, rule)
        return objective.mean_values(overlap_with_hbb(boxes, ships.reference))

    u = 1.0 - 1.0 / rule.q
    ends = compass_search((u, u), lambda point: value(with_ends(*point)), (0.0, 0.0), (1.0, 1.0))
    return with_ends(*ends)


def bow_gain(ships: Ships, calibrator: Calibrator) -> float:
    """
    Measure what q_bow and q_stern gain over one q on held-out images, on ships with a known bow.

    f and s are the same for both. Raises ValueError if the objective cannot fit ends, or there are
    fewer than two images of such ships.
    """
    one_q, objective = replace(calibrator, ends=False), calibrator.plan.objective
    if not isinstance(objective, OverlapObjective):
        raise ValueError(f'{objective.name} fits no q_bow and q_stern')
    ships = ships.take(ships.boxes.bow)
    folds, gain = min(_FOLDS, ships.image_count), np.zeros(len(ships))
    for training, rows in held_out_folds(ships, folds, one_q.plan.seed):
        base = one_q.fit(training)
        ends = fit_bow_and_stern(training, base, objective)
        new = ships.take(rows)
        with_ends, without = (
            objective.ship_values(overlap_with_hbb(convert_by_rule(new.boxes, rule), new.reference))
            for rule in (ends, base)
        )
        gain[rows] = with_ends[0] - without[0]
    return float(gain.mean())


def enough(ships: Ships, plan: CalibrationPlan, min_ships: int = MIN_SHIPS) -> bool:
    """
    Check whether a group of ships is large enough for a rule of its own.

    It needs `min_ships` in two or more images, and enough of them for the objective.
    """
    is_large = len(ships) >= min_ships and ships.image_count >= 2
    return is_large and plan.objective.is_enough(ships, plan.seed)
