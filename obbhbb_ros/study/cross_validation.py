# SPDX-License-Identifier: Apache-2.0
"""Cross-validation of a calibration: its rules, measured on images they were not fitted to."""

from __future__ import annotations

from collections.abc import Callable
from collections.abc import Iterator
from collections.abc import Mapping
from collections.abc import Sequence
from dataclasses import dataclass
from dataclasses import field
from dataclasses import replace
from functools import partial
from itertools import pairwise
from types import MappingProxyType
from typing import Any
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from obbhbb_ros.geometry.boxes import FloatArray
from obbhbb_ros.geometry.converter import PAPER_RULE
from obbhbb_ros.geometry.converter import HullRule
from obbhbb_ros.geometry.converter import convert_by_rule
from obbhbb_ros.study import metrics
from obbhbb_ros.study.bootstrap import Interval
from obbhbb_ros.study.bootstrap import bootstrap_intervals
from obbhbb_ros.study.calibration import MIN_GAIN
from obbhbb_ros.study.calibration import MIN_SHIPS
from obbhbb_ros.study.calibration import CalibrationPlan
from obbhbb_ros.study.calibration import Calibrator
from obbhbb_ros.study.calibration import decide
from obbhbb_ros.study.calibration import enough
from obbhbb_ros.study.cautions import cautions
from obbhbb_ros.study.coverage import Coverage
from obbhbb_ros.study.evaluation import EvaluationSettings
from obbhbb_ros.study.evaluation import ship_metrics
from obbhbb_ros.study.folds import folds_of
from obbhbb_ros.study.folds import held_out_folds
from obbhbb_ros.study.objectives import MeanIou
from obbhbb_ros.study.ships import Ships

CALIBRATED = 'calibrated'
BY_CLASS = 'by class'
BY_ASPECT = 'by aspect ratio'
# What calibrated rules are compared with.
FIXED_RULES: MappingProxyType[str, HullRule] = MappingProxyType(
    {'outer': HullRule('outer'), 'paper': PAPER_RULE, 'default': HullRule()}
)
_BANDS = 3
# Small ships, as COCO has them: L * W below 32 x 32 px.
SMALL = 32.0**2
# Candidates for a margin, pixels.
_MARGINS = np.arange(-80, 81) * 0.05
# Of a box, xyxy.
_OUTWARD = np.array([-1.0, -1.0, 1.0, 1.0])

# Takes the ships to calibrate on and the ships to sort; returns the group of each of the latter,
# negative for those in no group.
Grouping: TypeAlias = Callable[[Ships, Ships], NDArray[np.intp]]


def no_groups(training: Ships, ships: Ships) -> NDArray[np.intp]:
    """Put no ship into a group."""
    return np.full(len(ships), -1)


def aspect_groups(training: Ships, ships: Ships) -> NDArray[np.intp]:
    """Sort ships into the bands of aspect ratio that hold equally many of the training ships."""
    return np.searchsorted(_aspect_edges(training), ships.aspect)


def class_groups(names: Sequence[str], training: Ships, ships: Ships) -> NDArray[np.intp]:
    """Sort ships by class, for some classes."""
    number = {name: index for index, name in enumerate(names)}
    return np.array([number.get(name, -1) for name in ships.class_ids.tolist()], dtype=np.intp)


def _aspect_edges(ships: Ships) -> FloatArray:
    """Find the inner edges of bands of aspect ratio with equally many ships."""
    return np.asarray(np.quantile(ships.aspect, np.arange(1, _BANDS) / _BANDS))


@dataclass(frozen=True)
class Gain:
    """
    Gain over one rule, or over another `base`, on held-out images.

    The mean gain in the metric of the objective (IoU, matches, or relative area saved) and its
    95 % bootstrap interval.
    """

    name: str
    mean: float
    low: float
    high: float
    base: str = 'one rule'

    @property
    def earned(self) -> bool:
        """Whether the gain is `MIN_GAIN` or more, and the whole interval above zero."""
        return self.mean >= MIN_GAIN and self.low > 0.0

    def __str__(self) -> str:
        """Return the gain in one line."""
        verdict = 'better' if self.earned else 'not clearly better'
        none = 'none, ' if self.mean < MIN_GAIN else ''
        interval = f'{self.low:+.4f} to {self.high:+.4f}'
        return f'{self.name}: {verdict} than {self.base}, gain {none}{self.mean:+.4f} ({interval})'


@dataclass(frozen=True, eq=False)
class CalibrationResult:
    """
    Result of a calibration.

    Attributes
    ----------
    calibrator : Calibrator
        How it was calibrated: the plan, and what is fitted beside q.
    ships : Ships
        The N ships.
    rule : HullRule
        The rule, from all ships.
    scatter : Interval or None
        `Coverage`: how the share of ships that keep enough scatters, see `Coverage.scatter`.
    held_out : mapping of str to dict of str to ndarray of shape (N,)
        `obbhbb_ros.study.evaluation.ship_metrics` of the fixed and of the calibrated rules; the
        latter were calibrated on other images. Empty without folds.
    gains : sequence of Gain
        Gains of rules by class and by band over one rule, and of a margin for small ships.
    rule_of_aspect : sequence of (low, high, HullRule)
        Rules by band of aspect ratio, if requested. The node has no parameter for them.
    rule_of_class : mapping of str to HullRule
        Rules of the classes that gain by one.
    notes : sequence of str
        Other remarks.
    """

    calibrator: Calibrator
    ships: Ships
    rule: HullRule
    scatter: Interval | None = None
    held_out: Mapping[str, dict[str, FloatArray]] = field(default_factory=dict)
    gains: Sequence[Gain] = ()
    rule_of_aspect: Sequence[tuple[float, float, HullRule]] = ()
    rule_of_class: Mapping[str, HullRule] = field(default_factory=dict)
    notes: Sequence[str] = ()

    def interval(self, name: str, metric: str = 'iou') -> Interval:
        """Compute the 95 % interval, by image, of a mean metric of one way to convert."""
        values = self.held_out[name][metric]
        return bootstrap_intervals([values], self.ships.image_of)[0]

    def gain(
        self, name: str, base: str = CALIBRATED, rows: Any = slice(None), title: str = ''
    ) -> Gain:
        """
        Compare one way to convert with another, ship by ship, in the metric of the objective.

        `rows` selects ships by any NumPy index.
        """
        objective = self.calibrator.plan.objective
        values, others = (self.held_out[way][objective.metric] for way in (name, base))
        difference = (objective.sign * (values - others))[rows]
        (interval,) = bootstrap_intervals([difference], self.ships.image_of[rows])
        over = 'one rule' if base == CALIBRATED else base
        return Gain(title or name, float(difference.mean()), *interval, base=over)


def run(
    ships: Ships,
    plan: CalibrationPlan,
    folds: int = 5,
    *,
    per_class: bool = False,
    by_aspect: bool = False,
) -> CalibrationResult:
    """
    Calibrate, and measure the result on held-out images.

    Parameters
    ----------
    ships : Ships
        Ships with reference boxes.
    plan : CalibrationPlan
        How to calibrate; its seed is also that of the folds.
    folds : int
        Folds of the cross-validation by image; 0 for none.
    per_class, by_aspect : bool
        Whether to try rules by class and by aspect ratio. A class gets its own rule only if that
        gains on held-out images.

    Raises
    ------
    ValueError
        If there are too few ships or images, or groups are requested without folds.

    Examples
    --------
    >>> from obbhbb_ros.study.hulls import FAMILIES, synthetic_ships
    >>> boxy = synthetic_ships([FAMILIES['rectangular']], [1.0], aspects=2, angles=9)
    >>> result = run(boxy, CalibrationPlan(), folds=2)
    >>> round(float(result.held_out['calibrated']['iou'].mean()), 2)
    1.0
    """
    if (per_class or by_aspect) and not folds:
        raise ValueError('rules by class or aspect ratio need held-out images: give folds')
    calibrator = decide(ships, plan)
    rule = calibrator.fit(ships)
    scatter = plan.objective.scatter(ships, rule, plan.seed)
    result = CalibrationResult(calibrator, ships, rule, scatter, notes=cautions(ships))
    if not folds:
        return result
    if note := _folds_note(ships, plan, folds):
        return replace(result, notes=[*result.notes, note])
    return _with_held_out(result, folds, per_class, by_aspect)


def _with_held_out(
    result: CalibrationResult, folds: int, per_class: bool, by_aspect: bool
) -> CalibrationResult:
    """Add what is measured on held-out images, and the rules that earn their place there."""
    ships, calibrator = result.ships, result.calibrator
    # The node has no q_bow and q_stern for a class.
    for_class = replace(calibrator, ends=False)
    classes, notes = _large_classes(ships, calibrator.plan) if per_class else ([], [])
    groupings: dict[str, tuple[Grouping, Calibrator]] = {CALIBRATED: (no_groups, calibrator)}
    if by_aspect:
        groupings[BY_ASPECT] = aspect_groups, calibrator
    if classes:
        groupings[BY_CLASS] = partial(class_groups, classes), for_class
    held_out = dict(_held_out_metrics(result, groupings, folds))
    rules = _aspect_rules(ships, calibrator) if by_aspect else ()
    result = replace(result, held_out=held_out, rule_of_aspect=rules)
    result = replace(result, notes=[*result.notes, *notes])
    gains = [result.gain(name) for name in groupings if name != CALIBRATED]
    is_iou = isinstance(calibrator.plan.objective, MeanIou)
    if is_iou and (margin := _margin_gain(result, folds)):
        gains.append(margin)
    rule_of_class = {}
    for class_id in classes:
        rows = ships.class_ids == class_id
        gain = result.gain(BY_CLASS, rows=rows, title=f'class {class_id}')
        gains.append(gain)
        if gain.earned:
            rule_of_class[class_id] = for_class.fit(ships.take(rows))
    return replace(result, gains=gains, rule_of_class=rule_of_class)


def _folds_note(ships: Ships, plan: CalibrationPlan, folds: int) -> str | None:
    """Explain why nothing can be held out; None if it can."""
    if all(enough(training, plan, 1) for training, _ in held_out_folds(ships, folds, plan.seed)):
        return None
    objective = plan.objective
    share = f' for a share of {objective.share:g}' if isinstance(objective, Coverage) else ''
    return f'No held-out figures: without one of {folds} folds there are too few ships{share}.'


def _held_out_metrics(
    result: CalibrationResult, groupings: Mapping[str, tuple[Grouping, Calibrator]], folds: int
) -> Iterator[tuple[str, dict[str, FloatArray]]]:
    """Measure the fixed rules and, on held-out images, the calibrated ones."""
    ships, calibrator = result.ships, result.calibrator
    settings = EvaluationSettings(keep=calibrator.plan.objective.keep, bootstrap=0)
    for name, rule in FIXED_RULES.items():
        yield name, ship_metrics(ships, convert_by_rule(ships.boxes, rule), 'hbb', settings)
    for name, (grouping, of_group) in groupings.items():
        xyxy = held_out_boxes(ships, calibrator, folds, grouping, of_group)
        yield name, ship_metrics(ships, xyxy, 'hbb', settings)


def held_out_boxes(
    ships: Ships,
    calibrator: Calibrator,
    folds: int = 5,
    grouping: Grouping = no_groups,
    of_group: Calibrator | None = None,
) -> FloatArray:
    """
    Convert each of N ships by rules that were calibrated on other images; boxes, (N, 4), pixels.

    A group that `grouping` makes gets a rule of its own, by `of_group` if given, if it is large
    enough.
    """
    xyxy = np.empty((len(ships), 4))
    for training, rows in held_out_folds(ships, folds, calibrator.plan.seed):
        new = ships.take(rows)
        boxes = convert_by_rule(new.boxes, calibrator.fit(training))
        training_groups, groups = grouping(training, training), grouping(training, new)
        for group in np.unique(groups[groups >= 0]):
            members = groups == group
            if rule := _group_rule(training, training_groups == group, of_group or calibrator):
                boxes[members] = convert_by_rule(new.boxes[members], rule)
        xyxy[rows] = boxes
    return xyxy


def _group_rule(ships: Ships, rows: NDArray[np.bool_], calibrator: Calibrator) -> HullRule | None:
    """Calibrate on some of the ships, if they are enough."""
    group = ships.take(rows) if rows.any() else None
    return calibrator.fit(group) if group and enough(group, calibrator.plan) else None


def _aspect_rules(ships: Ships, calibrator: Calibrator) -> list[tuple[float, float, HullRule]]:
    """Calibrate each band of aspect ratio on all its ships."""
    rules = []
    for low, high in pairwise([1.0, *_aspect_edges(ships).tolist(), np.inf]):
        if rule := _group_rule(ships, (ships.aspect >= low) & (ships.aspect < high), calibrator):
            rules.append((low, high, rule))
    return rules


def fit_margin(ships: Ships, xyxy: FloatArray) -> float:
    """Find the margin on each side, pixels, with which N boxes, (N, 4), have the best mean IoU."""
    means = [metrics.iou(xyxy + margin * _OUTWARD, ships.reference).mean() for margin in _MARGINS]
    return float(_MARGINS[np.argmax(means)])


def _margin_gain(result: CalibrationResult, folds: int) -> Gain | None:
    """Try a margin for small ships; None if they are too few or it gains less than `MIN_GAIN`."""
    ships, calibrator = result.ships, result.calibrator
    small = ships.boxes.length * ships.boxes.width < SMALL
    fold, gain = folds_of(ships, folds, calibrator.plan.seed), np.zeros(len(ships))
    if min(np.bincount(fold[small], minlength=folds)) < MIN_SHIPS:
        return None
    for training, rows in held_out_folds(ships, folds, calibrator.plan.seed):
        rule = calibrator.fit(training)
        others, new = ships.take(small & ~rows), ships.take(small & rows)
        margin = fit_margin(others, convert_by_rule(others.boxes, rule))
        xyxy = convert_by_rule(new.boxes, rule)
        grown = metrics.iou(xyxy + margin * _OUTWARD, new.reference)
        gain[small & rows] = grown - metrics.iou(xyxy, new.reference)
    small_ships = ships.take(small)
    margin = fit_margin(small_ships, convert_by_rule(small_ships.boxes, result.rule))
    name = f'margin of {margin:+.2f} px on each side, for ships of L W below 32 x 32 px'
    (interval,) = bootstrap_intervals([gain[small]], ships.image_of[small])
    total = Gain(name, float(gain[small].mean()), *interval, base='none')
    return total if total.earned else None


def _large_classes(ships: Ships, plan: CalibrationPlan) -> tuple[list[str], list[str]]:
    """List the classes that are large enough for a rule; and, if there are none to try, why."""
    names = [str(name) for name in np.unique(ships.class_ids) if str(name)]
    large = [name for name in names if enough(ships.take(ships.class_ids == name), plan)]
    if len(names) >= 2 and large:
        return large, []
    note = (
        f'per class: nothing to do: needs two or more classes (here {len(names)}), at least one of '
        f'them large enough for a rule (here {len(large)})'
    )
    return [], [note]
