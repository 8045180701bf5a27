# SPDX-License-Identifier: Apache-2.0
"""What a calibration comes to: rules, how they do on images they have not seen, a YAML file."""

from __future__ import annotations

import json
from collections.abc import Callable
from collections.abc import Mapping
from collections.abc import Sequence
from dataclasses import dataclass
from dataclasses import field
from itertools import pairwise
from typing import Any

import numpy as np

from obbhbb_ros.boxes import FloatArray
from obbhbb_ros.converter import HullRule
from obbhbb_ros.converter import convert_by_rule
from obbhbb_ros.methods import ONBOARD_METHODS
from obbhbb_ros.study.calibration import OBJECTIVES
from obbhbb_ros.study.calibration import Plan
from obbhbb_ros.study.calibration import aspect_edges
from obbhbb_ros.study.calibration import aspect_groups
from obbhbb_ros.study.calibration import calibrate
from obbhbb_ros.study.calibration import class_groups
from obbhbb_ros.study.calibration import enough
from obbhbb_ros.study.calibration import folds_of
from obbhbb_ros.study.calibration import held_out_boxes
from obbhbb_ros.study.calibration import one_rule
from obbhbb_ros.study.calibration import rule_by_group
from obbhbb_ros.study.evaluation import FIGURES
from obbhbb_ros.study.evaluation import PAPER_RULE
from obbhbb_ros.study.evaluation import Settings
from obbhbb_ros.study.evaluation import bootstrap_interval
from obbhbb_ros.study.evaluation import figures
from obbhbb_ros.study.ships import Ships
from obbhbb_ros.study.summary import text_table

ASPECT_BANDS = 3
CALIBRATED = 'calibrated'


@dataclass(frozen=True)
class Gain:
    """
    What groups with rules of their own gain over one rule, on held-out images.

    Attributes
    ----------
    name : str
        The groups.
    mean : float
        Mean gain in what the objective counts: IoU, matches, or relative area saved.
    low, high : float
        95 % bootstrap interval, images drawn with replacement.
    """

    name: str
    mean: float
    low: float
    high: float

    @property
    def earned(self) -> bool:
        """Whether the gain is above zero beyond chance."""
        return self.low > 0.0

    def __str__(self) -> str:
        """Say it in a line."""
        verdict = 'earns its place' if self.earned else 'does not earn its place'
        interval = f'{self.low:+.4f} to {self.high:+.4f}'
        return f'{self.name}: {verdict}, gain {self.mean:+.4f} ({interval})'


@dataclass(eq=False)
class Outcome:
    """
    What a calibration found.

    Attributes
    ----------
    plan : Plan
        What was asked for.
    ships : Ships
        On which, N of them.
    rule : HullRule
        The rule, from all ships.
    rule_of_class : dict of str to HullRule
        Rules of classes that earned one.
    rule_of_aspect : list of (low, high, HullRule)
        Rules by band of aspect ratio, where asked for. The node has no parameter for them.
    held_out : dict of str to ndarray of shape (9, N)
        `obbhbb_ros.study.evaluation.figures` of each way to convert; what was learnt was learnt
        on other images. Empty without folds.
    gains : list of Gain
        Of classes and bands over one rule.
    notes : list of str
        What else there is to say.
    """

    plan: Plan
    ships: Ships
    rule: HullRule
    rule_of_class: dict[str, HullRule] = field(default_factory=dict)
    rule_of_aspect: list[tuple[float, float, HullRule]] = field(default_factory=list)
    held_out: dict[str, FloatArray] = field(default_factory=dict)
    gains: list[Gain] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)


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
    Calibrate, and measure on held-out images what it is worth.

    Parameters
    ----------
    ships : Ships
        Ships with reference boxes.
    plan : Plan
        What to look for, and where.
    folds : int
        Parts of the cross-validation by image; 0 for none.
    per_class, by_aspect : bool
        Whether to try rules by class and by aspect ratio. A class gets its rule only if that
        gains on held-out images.
    seed : int
        Seed of the parts.

    Returns
    -------
    Outcome
        Rules and figures.

    Raises
    ------
    ValueError
        If there are too few ships or images, or groups are asked for without folds.
    """
    if (per_class or by_aspect) and not folds:
        raise ValueError('rules by class or aspect ratio are judged on held-out images: give folds')
    outcome = Outcome(plan, ships, calibrate(ships, plan))
    if not folds:
        return outcome
    fold = folds_of(ships, folds, seed)
    if not all(enough(ships.take(fold != index), plan, least=1) for index in range(folds)):
        outcome.notes.append(
            f'No held-out figures: without one of {folds} folds the ships are too few for a '
            f'share of {plan.share:g}.'
        )
        return outcome
    settings = Settings(keep=plan.keep, bootstrap=0)

    def measure(xyxy: FloatArray) -> FloatArray:
        return figures(ships, xyxy, 'hbb', settings)

    def held_out(fit: Callable[[Ships, Ships], FloatArray]) -> FloatArray:
        return measure(held_out_boxes(ships, fit, folds, seed))

    fixed = {'outer': HullRule('outer'), 'paper': PAPER_RULE, 'default': HullRule()}
    for name, rule in fixed.items():
        outcome.held_out[name] = measure(convert_by_rule(ships.boxes, rule))
    outcome.held_out[CALIBRATED] = held_out(one_rule(plan))
    if by_aspect:
        name = 'by aspect ratio'
        outcome.held_out[name] = held_out(rule_by_group(plan, aspect_groups(ASPECT_BANDS)))
        outcome.gains.append(_gain(outcome, name))
        outcome.rule_of_aspect = _aspect_rules(ships, plan)
    if per_class:
        _try_classes(outcome, held_out)
    return outcome


def _try_classes(
    outcome: Outcome, held_out: Callable[[Callable[[Ships, Ships], FloatArray]], FloatArray]
) -> None:
    """Give each class its own rule that gains by it."""
    ships, plan = outcome.ships, outcome.plan
    names = [str(name) for name in np.unique(ships.class_ids) if str(name)]
    large = [name for name in names if enough(ships.take(ships.class_ids == name), plan)]
    if len(names) < 2 or not large:
        outcome.notes.append(
            f'per class: nothing to do, {len(names)} classes, {len(large)} of them large enough'
        )
        return
    outcome.held_out['by class'] = held_out(rule_by_group(plan, class_groups(large)))
    outcome.gains.append(_gain(outcome, 'by class'))
    for name in large:
        rows = ships.class_ids == name
        gain = _gain(outcome, 'by class', rows, f'class {name}')
        outcome.gains.append(gain)
        if gain.earned:
            outcome.rule_of_class[name] = calibrate(ships.take(rows), plan)


def _gain(
    outcome: Outcome, name: str, rows: Any = slice(None), title: str | None = None
) -> Gain:
    """Compare groups with one rule, ship by ship."""
    column, sign = {
        'mean_iou': ('iou', 1.0), 'match50': ('match', 1.0), 'coverage': ('area', -1.0)
    }[outcome.plan.objective]
    index = FIGURES.index(column)
    found, base = outcome.held_out[name][index], outcome.held_out[CALIBRATED][index]
    difference = (sign * (found - base))[rows]
    images = outcome.ships.image_of[rows]
    low, high = bootstrap_interval(difference, images)
    return Gain(title or name, float(difference.mean()), low, high)


def _aspect_rules(ships: Ships, plan: Plan) -> list[tuple[float, float, HullRule]]:
    """Calibrate each band of aspect ratio on all its ships."""
    edges = [1.0, *aspect_edges(ships, ASPECT_BANDS).tolist(), np.inf]
    rules = []
    for low, high in pairwise(edges):
        rows = (ships.aspect >= low) & (ships.aspect < high)
        if rows.any() and enough(ships.take(rows), plan):
            rules.append((low, high, calibrate(ships.take(rows), plan)))
    return rules


def outcome_text(outcome: Outcome) -> str:
    """
    Write an outcome for the terminal.

    Parameters
    ----------
    outcome : Outcome
        What `run` gives.

    Returns
    -------
    str
        The rule, held-out figures, what groups gain, and what is guaranteed.
    """
    plan = outcome.plan
    parts = [
        f'{plan.method} for {OBJECTIVES[plan.objective]}, '
        f'{len(outcome.ships)} ships in {outcome.ships.image_count} images: {_shape(outcome.rule)}'
    ]
    if outcome.held_out:
        parts.append(_held_out_table(outcome))
    if outcome.rule_of_aspect:
        rows = [(f'{low:.2f} to {high:.2f}', _shape(rule))
                for low, high, rule in outcome.rule_of_aspect]
        parts.append(text_table(('L/W', 'rule'), rows))
    if outcome.gains:
        parts.append('\n'.join(map(str, outcome.gains)))
    if outcome.rule_of_class:
        rows = [(name, _shape(rule)) for name, rule in outcome.rule_of_class.items()]
        parts.append(text_table(('class', 'rule'), rows))
    if plan.objective == 'coverage':
        parts.append(guarantee(plan))
    return '\n\n'.join(parts + outcome.notes)


def guarantee(plan: Plan) -> str:
    """Say what a coverage calibration promises, and under which assumption."""
    unit = 'ships' if plan.per_image == 1 else 'images'
    held = '' if plan.per_image == 1 else f' of at most {plan.per_image} ships'
    return (
        f'Guarantee: a new ship keeps {plan.keep:.0%} of its reference box with a probability of '
        f'at least {plan.share:.0%},\nif new {unit}{held} are exchangeable with those that gave s '
        '(half of the images; the others gave q and f).'
    )


def _held_out_table(outcome: Outcome) -> str:
    """Lay the held-out figures out."""
    rows = []
    for name, table in outcome.held_out.items():
        mean = dict(zip(FIGURES, table.mean(axis=1).tolist(), strict=True))
        low, high = bootstrap_interval(table[0], outcome.ships.image_of)
        rows.append((
            name, f'{mean["iou"]:.4f}', f'{low:.3f}-{high:.3f}', f'{mean["match"]:.4f}',
            f'{mean["undershoot"]:.4f}', f'{mean["kept"]:.1%}', f'{mean["area"]:.4f}',
        ))
    head = (
        'protocol hbb, held out', 'mean IoU', '95 % interval', 'match50', 'undershoot',
        f'keep {outcome.plan.keep:.0%}', 'area/outer',
    )
    return text_table(head, rows)


def _shape(rule: HullRule) -> str:
    """Write the parameters of a rule."""
    return f'q {rule.q:.4g}, f {rule.f:.4g}, s {rule.s:.4g}'


def yaml_text(
    rule: HullRule, rule_of_class: Mapping[str, HullRule], notes: Sequence[str] = ()
) -> str:
    """
    Write rules as a parameter file of the node.

    Parameters
    ----------
    rule : HullRule
        For every class that has none of its own.
    rule_of_class : mapping of str to HullRule
        By class.
    notes : sequence of str
        Comments for the top, one line each.

    Returns
    -------
    str
        YAML that `--params-file` takes, for a node of any name in any namespace. What it does not
        set keeps the node's default.

    Raises
    ------
    ValueError
        If the node does not offer a rule's method, or a class id cannot be part of a parameter's
        name.
    """
    _check_writable({'': rule, **rule_of_class})
    lines = [f'# {line}' for note in notes for line in note.splitlines()]
    lines += ['/**:', '  ros__parameters:', *_values(rule, '    ')]
    if rule_of_class:
        lines += [f'    class_ids: {json.dumps(list(rule_of_class))}', '    classes:']
        for class_id, own in rule_of_class.items():
            lines += [f'      {json.dumps(class_id)}:', *_values(own, '        ')]
    return '\n'.join(lines) + '\n'


def _check_writable(rules: Mapping[str, HullRule]) -> None:
    """Refuse what the node could not read."""
    for class_id, rule in rules.items():
        if rule.method not in ONBOARD_METHODS:
            raise ValueError(f'the node does not offer the method {rule.method}')
        if class_id != class_id.strip() or not class_id.isprintable():
            raise ValueError(f'class {class_id!r} cannot be part of a parameter name')


def _values(rule: HullRule, indent: str) -> list[str]:
    """Write a rule's four values, doubles with a point so that ROS takes them for doubles."""
    numbers = [f'{indent}{name}: {_double(getattr(rule, name))}' for name in ('q', 'f', 's')]
    return [f'{indent}method: {json.dumps(rule.method)}', *numbers]


def _double(value: float) -> str:
    """Write a double for YAML."""
    return repr(float(value)) if np.isfinite(value) else '.inf'
