# SPDX-License-Identifier: Apache-2.0
"""Cross-validation of a calibration: its rules, measured on images they were not fitted to."""

from __future__ import annotations

from collections.abc import Callable
from collections.abc import Mapping
from dataclasses import dataclass
from dataclasses import field
from dataclasses import replace
from functools import partial
from itertools import pairwise
from typing import Any
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from obbhbb_ros.geometry.boxes import FloatArray
from obbhbb_ros.geometry.converter import PAPER_RULE
from obbhbb_ros.geometry.converter import HullRule
from obbhbb_ros.geometry.converter import convert_by_rule
from obbhbb_ros.study import evaluation
from obbhbb_ros.study import metrics
from obbhbb_ros.study.calibration import FEWEST
from obbhbb_ros.study.calibration import LEAST_GAIN
from obbhbb_ros.study.calibration import OBJECTIVES
from obbhbb_ros.study.calibration import Plan
from obbhbb_ros.study.calibration import Trials
from obbhbb_ros.study.calibration import calibrate
from obbhbb_ros.study.calibration import covered_shares
from obbhbb_ros.study.calibration import decide
from obbhbb_ros.study.calibration import enough
from obbhbb_ros.study.calibration import folds_of
from obbhbb_ros.study.ships import Ships

CALIBRATED = 'calibrated'
BY_CLASS = 'by class'
_BANDS = 3
# Small ships, as COCO has them: L * W below 32 x 32 px.
SMALL = 32.0**2
# Candidates for a margin, pixels.
_MARGINS = np.arange(-80, 81) * 0.05

# Takes the ships to calibrate on and the ships to sort; returns the group of each of the latter,
# negative for those in no group.
Grouping: TypeAlias = Callable[[Ships, Ships], NDArray[np.intp]]


def no_groups(known: Ships, ships: Ships) -> NDArray[np.intp]:
    """Put no ship into a group."""
    return np.full(len(ships), -1)


def aspect_groups(known: Ships, ships: Ships) -> NDArray[np.intp]:
    """Sort ships into the bands of aspect ratio that hold equally many of the known ships."""
    return np.searchsorted(_aspect_edges(known), ships.aspect)


def class_groups(names: list[str], known: Ships, ships: Ships) -> NDArray[np.intp]:
    """Sort ships by class, for some classes."""
    return ships.class_index(names)


def _aspect_edges(ships: Ships) -> FloatArray:
    """Find the inner edges of bands of aspect ratio with equally many ships."""
    return np.asarray(np.quantile(ships.aspect, np.arange(1, _BANDS) / _BANDS))


@dataclass(frozen=True)
class Gain:
    """
    Gain over one rule, or over another `base`, on held-out images.

    The mean gain in the figure of the objective (IoU, matches, or relative area saved) and its
    95 % bootstrap interval.
    """

    name: str
    mean: float
    low: float
    high: float
    base: str = 'one rule'

    @property
    def earned(self) -> bool:
        """Whether the gain is `LEAST_GAIN` or more, and the whole interval above zero."""
        return self.mean >= LEAST_GAIN and self.low > 0.0

    def __str__(self) -> str:
        """Return the gain in one line."""
        verdict = 'better' if self.earned else 'not clearly better'
        none = 'none, ' if self.mean < LEAST_GAIN else ''
        interval = f'{self.low:+.4f} to {self.high:+.4f}'
        return f'{self.name}: {verdict} than {self.base}, gain {none}{self.mean:+.4f} ({interval})'


@dataclass(eq=False)
class Outcome:
    """
    Result of a calibration.

    Attributes
    ----------
    plan : Plan
        How it was calibrated, see `obbhbb_ros.study.calibration.decide`.
    trials : Trials
        What decided it.
    ships : Ships
        The N ships.
    rule : HullRule
        The rule, from all ships.
    rule_of_class : dict of str to HullRule
        Rules of the classes that gain by one.
    rule_of_aspect : list of (low, high, HullRule)
        Rules by band of aspect ratio, if requested. The node has no parameter for them.
    held_out : dict of str to dict of str to ndarray of shape (N,)
        `obbhbb_ros.study.evaluation.figures` of each way to convert, calibrated on other images.
        Empty without folds.
    gains : list of Gain
        Gains of rules by class and by band over one rule.
    covered : Interval or None
        `coverage`: how the share of ships that keep enough scatters, see
        `obbhbb_ros.study.calibration.covered_shares`.
    notes : list of str
        Other remarks.
    """

    plan: Plan
    trials: Trials
    ships: Ships
    rule: HullRule
    rule_of_class: dict[str, HullRule] = field(default_factory=dict)
    rule_of_aspect: list[tuple[float, float, HullRule]] = field(default_factory=list)
    held_out: dict[str, dict[str, FloatArray]] = field(default_factory=dict)
    gains: list[Gain] = field(default_factory=list)
    covered: evaluation.Interval | None = None
    notes: list[str] = field(default_factory=list)

    def interval(self, name: str, figure: str = 'iou') -> evaluation.Interval:
        """Compute the 95 % interval, by image, of a mean figure of one way to convert."""
        values = self.held_out[name][figure]
        return evaluation.bootstrap_intervals([values], self.ships.image_of)[0]


def run(
    ships: Ships,
    plan: Plan,
    folds: int = 5,
    *,
    per_class: bool = False,
    by_aspect: bool = False,
    seed: int = 0,
) -> Outcome:
    """
    Calibrate, and measure the result on held-out images.

    Parameters
    ----------
    ships : Ships
        Ships with reference boxes.
    plan : Plan
        How to calibrate.
    folds : int
        Folds of the cross-validation by image; 0 for none.
    per_class, by_aspect : bool
        Whether to try rules by class and by aspect ratio. A class gets its own rule only if that
        gains on held-out images.
    seed : int
        Seed of the folds.

    Raises
    ------
    ValueError
        If there are too few ships or images, or groups are requested without folds.

    Examples
    --------
    >>> from obbhbb_ros.study.hulls import FAMILIES, synthetic_ships
    >>> boxy = synthetic_ships([FAMILIES['rectangular']], [1.0], aspects=2, angles=9)
    >>> outcome = run(boxy, Plan(), folds=2)
    >>> round(float(outcome.held_out['calibrated']['iou'].mean()), 2)
    1.0
    """
    if (per_class or by_aspect) and not folds:
        raise ValueError('rules by class or aspect ratio need held-out images: give folds')
    plan, trials = decide(ships, plan)
    outcome = Outcome(plan, trials, ships, calibrate(ships, plan))
    if plan.objective == 'coverage':
        outcome.covered = evaluation.Interval(*covered_shares(ships, outcome.rule, plan))
    if not folds:
        return outcome
    fold = folds_of(ships, folds, seed)
    if not all(enough(ships.take(fold != index), plan, least=1) for index in range(folds)):
        outcome.notes.append(
            f'No held-out figures: without one of {folds} folds there are too few ships for a '
            f'share of {plan.share:g}.'
        )
        return outcome
    classes = _large_classes(outcome) if per_class else []
    groupings: dict[str, Grouping] = {CALIBRATED: no_groups}
    if by_aspect:
        groupings['by aspect ratio'] = aspect_groups
        outcome.rule_of_aspect = _aspect_rules(ships, plan)
    if classes:
        groupings[BY_CLASS] = partial(class_groups, classes)
    _measure(outcome, groupings, folds, seed)
    if plan.objective == 'mean_iou' and (margin := _margin(outcome, folds, seed)):
        outcome.gains.append(margin)
    for name in classes:
        rows = ships.class_ids == name
        gain = _gain(outcome, BY_CLASS, rows, f'class {name}')
        outcome.gains.append(gain)
        if gain.earned:
            outcome.rule_of_class[name] = calibrate(ships.take(rows), _for_class(plan))
    return outcome


def _measure(outcome: Outcome, groupings: Mapping[str, Grouping], folds: int, seed: int) -> None:
    """Score fixed rules and calibrated ones on held-out images, and what groups gain."""
    ships, plan = outcome.ships, outcome.plan
    fixed = {'outer': HullRule('outer'), 'paper': PAPER_RULE, 'default': HullRule()}
    boxes = {name: convert_by_rule(ships.boxes, rule) for name, rule in fixed.items()}
    for name, grouping in groupings.items():
        group_plan = _for_class(plan) if name == BY_CLASS else plan
        boxes[name] = held_out_boxes(ships, plan, folds, seed, grouping, group_plan)
    settings = evaluation.Settings(keep=plan.keep, bootstrap=0)
    for name, xyxy in boxes.items():
        outcome.held_out[name] = evaluation.figures(ships, xyxy, 'hbb', settings)
    outcome.gains += [_gain(outcome, name) for name in groupings if name != CALIBRATED]


def held_out_boxes(
    ships: Ships,
    plan: Plan,
    folds: int = 5,
    seed: int = 0,
    grouping: Grouping = no_groups,
    group_plan: Plan | None = None,
) -> FloatArray:
    """
    Convert each of N ships by rules that were calibrated on other images; boxes, (N, 4), pixels.

    A group that `grouping` makes gets a rule of its own, by `group_plan` if given, if it is large
    enough.
    """
    fold = folds_of(ships, folds, seed)
    xyxy = np.empty((len(ships), 4))
    for index in range(folds):
        known, new = ships.take(fold != index), ships.take(fold == index)
        boxes = convert_by_rule(new.boxes, calibrate(known, plan))
        of_known, of_new = grouping(known, known), grouping(known, new)
        for group in np.unique(of_new[of_new >= 0]):
            mine = of_new == group
            if rule := _own_rule(known, of_known == group, group_plan or plan):
                boxes[mine] = convert_by_rule(new.boxes.take(mine), rule)
        xyxy[fold == index] = boxes
    return xyxy


def _own_rule(ships: Ships, rows: NDArray[np.bool_], plan: Plan) -> HullRule | None:
    """Calibrate on some of the ships, if they are enough."""
    group = ships.take(rows) if rows.any() else None
    return calibrate(group, plan) if group and enough(group, plan) else None


def _for_class(plan: Plan) -> Plan:
    """Return a plan without q_bow and q_stern, which the node does not have for a class."""
    return replace(plan, ends=False)


def _aspect_rules(ships: Ships, plan: Plan) -> list[tuple[float, float, HullRule]]:
    """Calibrate each band of aspect ratio on all its ships."""
    rules = []
    for low, high in pairwise([1.0, *_aspect_edges(ships).tolist(), np.inf]):
        if rule := _own_rule(ships, (ships.aspect >= low) & (ships.aspect < high), plan):
            rules.append((low, high, rule))
    return rules


def fit_margin(ships: Ships, xyxy: FloatArray) -> float:
    """Find the margin on each side, pixels, with which N boxes, (N, 4), have the best mean IoU."""
    worth = [metrics.iou(_grown(xyxy, each), ships.reference).mean() for each in _MARGINS]
    return float(_MARGINS[np.argmax(worth)])


def _grown(xyxy: FloatArray, margin: float) -> FloatArray:
    """Add a margin on each side of boxes, (N, 4)."""
    return xyxy + np.array([-margin, -margin, margin, margin])


def _margin(outcome: Outcome, folds: int, seed: int) -> Gain | None:
    """Try a margin for small ships; None if they are too few or it gains less than `LEAST_GAIN`."""
    ships, plan = outcome.ships, outcome.plan
    small = ships.boxes.length * ships.boxes.width < SMALL
    fold, gain = folds_of(ships, folds, seed), np.zeros(len(ships))
    if min(np.bincount(fold[small], minlength=folds)) < FEWEST:
        return None
    for index in range(folds):
        known, new = ships.take(small & (fold != index)), ships.take(small & (fold == index))
        rule = calibrate(ships.take(fold != index), plan)
        margin = fit_margin(known, convert_by_rule(known.boxes, rule))
        xyxy = convert_by_rule(new.boxes, rule)
        grown = metrics.iou(_grown(xyxy, margin), new.reference)
        gain[small & (fold == index)] = grown - metrics.iou(xyxy, new.reference)
    mine = ships.take(small)
    margin = fit_margin(mine, convert_by_rule(mine.boxes, outcome.rule))
    name = f'margin of {margin:+.2f} px on each side, for ships of L W below 32 x 32 px'
    (interval,) = evaluation.bootstrap_intervals([gain[small]], ships.image_of[small])
    found = Gain(name, float(gain[small].mean()), *interval, base='none')
    return found if found.earned else None


def _large_classes(outcome: Outcome) -> list[str]:
    """List the classes that are large enough for a rule; add a note if there are none to try."""
    ships = outcome.ships
    names = [str(name) for name in np.unique(ships.class_ids) if str(name)]
    large = [name for name in names if enough(ships.take(ships.class_ids == name), outcome.plan)]
    if len(names) >= 2 and large:
        return large
    outcome.notes.append(
        f'per class: nothing to do: needs two or more classes (here {len(names)}), at least one of '
        f'them large enough for a rule (here {len(large)})'
    )
    return []


def _gain(outcome: Outcome, name: str, rows: Any = slice(None), title: str | None = None) -> Gain:
    """Compare groups with one rule, ship by ship."""
    objective = OBJECTIVES[outcome.plan.objective]
    found = outcome.held_out[name][objective.figure]
    base = outcome.held_out[CALIBRATED][objective.figure]
    difference = (objective.sign * (found - base))[rows]
    (interval,) = evaluation.bootstrap_intervals([difference], outcome.ships.image_of[rows])
    return Gain(title or name, float(difference.mean()), *interval)
