# SPDX-License-Identifier: Apache-2.0
"""Results as text for the terminal."""

from __future__ import annotations

from collections.abc import Mapping
from collections.abc import Sequence

import numpy as np

from obbhbb_ros.geometry.boxes import FloatArray
from obbhbb_ros.geometry.converter import HullRule
from obbhbb_ros.labels import ImageLabels
from obbhbb_ros.study import evaluation
from obbhbb_ros.study import metrics
from obbhbb_ros.study.calibration import LEAST_GAIN
from obbhbb_ros.study.calibration import OBJECTIVES
from obbhbb_ros.study.chip_costs import ENCODERS
from obbhbb_ros.study.chip_costs import Cost
from obbhbb_ros.study.cross_validation import CALIBRATED
from obbhbb_ros.study.cross_validation import Outcome
from obbhbb_ros.study.paper_table import Comparison
from obbhbb_ros.study.rules import TUNABLE_METHODS
from obbhbb_ros.text_tables import text_table


def score_tables(
    scores: Sequence[evaluation.Score],
    settings: evaluation.Settings = evaluation.DEFAULT_SETTINGS,
    found: Sequence[evaluation.Offset] = (),
) -> str:
    """
    Tabulate scores: for each protocol all figures over all ships, then mean IoU by stratum.

    With offsets `found`, they follow, and a note if there is a significant one.
    """
    parts = []
    for protocol, by_stratum in evaluation.nested(scores).items():
        overall = list(by_stratum[evaluation.ALL].values())
        title = (
            f'protocol {protocol}: {metrics.PROTOCOLS[protocol]}, '
            f'{overall[0].ships} ships in {overall[0].images} images'
        )
        parts.append(f'{title}\n{_score_table(overall, settings)}')
        rows = []
        for stratum, by_method in by_stratum.items():
            mine = list(by_method.values())
            rows.append([stratum, str(mine[0].ships), *(f'{score.iou:.4f}' for score in mine)])
        table = text_table(['stratum', 'ships', *by_stratum[evaluation.ALL]], rows)
        parts.append(f'mean IoU by stratum, {title}\n{table}')
    if found:
        parts.append(f'median offset from the reference box, px\n{_offset_table(found)}')
        parts += offset_notes(found)
    return '\n\n'.join(parts)


def known_figures(scores: Sequence[evaluation.Score]) -> dict[str, evaluation.Figure]:
    """Select the figures that are known of any of the scores."""
    return {
        name: figure
        for name, figure in evaluation.FIGURES.items()
        if not all(np.isnan(getattr(score, name)) for score in scores)
    }


def _score_table(scores: Sequence[evaluation.Score], settings: evaluation.Settings) -> str:
    """Tabulate the figures of methods."""
    shown = known_figures(scores)
    head = ['method', 'q / f / s', *(each.heading(settings) for each in shown.values())]
    rows = []
    for score in scores:
        cells = [f'{getattr(score, name):{each.form}}' for name, each in shown.items()]
        rows.append([score.method, _tuned(score), *cells])
    interval = [
        '' if np.isnan(score.iou_low) else f'{score.iou_low:.3f}-{score.iou_high:.3f}'
        for score in scores
    ]
    # Next to the mean IoU.
    for line, cell in zip([head, *rows], ['95 % interval', *interval], strict=True):
        line.insert(3, cell)
    return text_table(head, rows)


def _tuned(score: evaluation.Score) -> str:
    """Format the parameters of a method that has any."""
    if score.method not in TUNABLE_METHODS:
        return ''
    ends = {'bow': score.q_bow, 'stern': score.q_stern}
    given = [f', {name} {q:.4g}' for name, q in ends.items() if q is not None]
    return f'{score.q:.4g} / {score.f:.4g} / {score.s:.4g}{"".join(given)}'


def _offset_table(found: Sequence[evaluation.Offset]) -> str:
    """Tabulate offsets of centres and sides."""
    rows = [
        [
            each.method,
            f'{each.x:+.2f}',
            _range(each.x_interval),
            f'{each.y:+.2f}',
            _range(each.y_interval),
            *(f'{side:+.2f}' for side in (each.left, each.top, each.right, each.bottom)),
        ]
        for each in found
    ]
    head = [
        'method',
        'centre x',
        '95 % interval',
        'centre y',
        '95 % interval',
        'left',
        'top',
        'right',
        'bottom',
    ]
    return text_table(head, rows)


def _range(interval: evaluation.Interval) -> str:
    """Format an interval of pixels."""
    return '' if np.isnan(interval.low) else f'{interval.low:+.2f} to {interval.high:+.2f}'


def offset_notes(found: Sequence[evaluation.Offset]) -> list[str]:
    """Warn of significant offsets, in one line each; methods with the same offset share one."""
    methods: dict[str, list[str]] = {}
    for each in found:
        if each.significant:
            where = (
                f'{each.x:+.2f} px in x ({_range(each.x_interval)}) and '
                f'{each.y:+.2f} px in y ({_range(each.y_interval)})'
            )
            methods.setdefault(where, []).append(each.method)
    return [
        f'note: significant offset from the reference boxes: {where}'
        + ('' if len(names) == len(found) else f', {", ".join(names)}')
        for where, names in methods.items()
    ]


def outcome_text(outcome: Outcome) -> str:
    """Describe the result of a calibration: rule, held-out figures, gains, guarantee."""
    plan = outcome.plan
    parts = [
        f'{plan.method} for {OBJECTIVES[plan.objective].summary}, '
        f'{len(outcome.ships)} ships in {outcome.ships.image_count} images: '
        f'{_parameters(outcome.rule)}'
    ]
    if outcome.held_out:
        parts.append(_held_out_table(outcome))
    if trials := _trial_lines(outcome):
        parts.append('\n'.join(trials))
    if outcome.rule_of_aspect:
        bands = [
            (f'{low:.2f} to {high:.2f}', _parameters(rule))
            for low, high, rule in outcome.rule_of_aspect
        ]
        parts.append(text_table(('L/W', 'rule'), bands))
    if outcome.gains:
        parts.append('\n'.join(map(str, outcome.gains)))
    if outcome.rule_of_class:
        classes = [(name, _parameters(rule)) for name, rule in outcome.rule_of_class.items()]
        parts.append(text_table(('class', 'rule'), classes))
    if plan.objective == 'coverage':
        parts.append(_guarantee(outcome))
    return '\n\n'.join(parts + outcome.notes)


def _held_out_table(outcome: Outcome) -> str:
    """Tabulate the figures on held-out images."""
    rows = []
    for name, found in outcome.held_out.items():
        mean = {key: value.mean() for key, value in found.items()}
        low, high = outcome.interval(name)
        rows.append(
            (
                name,
                f'{mean["iou"]:.4f}',
                f'{low:.3f}-{high:.3f}',
                f'{mean["match"]:.4f}',
                f'{mean["undershoot"]:.4f}',
                f'{mean["kept"]:.1%}',
                f'{mean["area"]:.4f}',
            )
        )
    head = (
        'protocol hbb, held out',
        'mean IoU',
        '95 % interval',
        'match50',
        'undershoot',
        f'keep {outcome.plan.keep:.0%}',
        'area/outer',
    )
    return text_table(head, rows)


def _trial_lines(outcome: Outcome) -> list[str]:
    """Say what was tried beside q, what it gained and whether it was fitted."""
    plan, trials = outcome.plan, outcome.trials
    with_bow = outcome.ships.with_bow.sum()
    tried = {
        ('f' if plan.objective == 'coverage' else 'f and s') + ' over q alone': trials.over_q,
        f'q_bow and q_stern over q, {with_bow} ships with a known bow': trials.ends,
    }
    unit = OBJECTIVES[plan.objective].unit
    return [
        f'{name}: gain {gain:+.4f} of held-out {unit}, fitted'
        if gain >= LEAST_GAIN
        else f'{name}: gain none ({gain:+.4f} of held-out {unit}, below {LEAST_GAIN:g}), not fitted'
        for name, gain in tried.items()
        if gain is not None
    ]


def _guarantee(outcome: Outcome) -> str:
    """State what a calibration for coverage guarantees, on what condition, and its scatter."""
    plan = outcome.plan
    unit = 'ships' if plan.per_image == 1 else f'images of at most {plan.per_image} ships'
    text = (
        f'Guarantee: a new ship keeps {plan.keep:.0%} of its reference box with a probability of '
        f'at least {plan.share:.0%},\nif new {unit} are exchangeable with those that gave s '
        '(half of the images; the others gave q and f).'
    )
    if outcome.covered:
        low, high = outcome.covered
        text += (
            f'\nIt holds on average. One calibration, counted on as many new images, lands between '
            f'{low:.1%} and {high:.1%}\n(95 % interval over images; ships of an image are alike).'
        )
    if outcome.held_out:
        low, high = outcome.interval(CALIBRATED, 'kept')
        share = outcome.held_out[CALIBRATED]['kept'].mean()
        text += (
            f'\nHeld out, {share:.1%} of the ships keep it ({low:.1%} to {high:.1%}, '
            '95 % interval over images).'
        )
    return text


def _parameters(rule: HullRule) -> str:
    """Format the parameters of a rule."""
    values = {'q': rule.q, 'f': rule.f, 's': rule.s, 'q_bow': rule.q_bow, 'q_stern': rule.q_stern}
    return ', '.join(f'{name} {each:.4g}' for name, each in values.items() if each is not None)


def comparison_table(found: Sequence[Comparison]) -> str:
    """Tabulate the paper's Table 1, our numbers and the deviations, from `paper_comparison`."""
    families = list(dict.fromkeys(each.family for each in found))
    rows: dict[str, list[str]] = {}
    for each in sorted(found, key=lambda each: each.fullness):
        name = f'{each.fullness:.2f} {each.row}'
        deviation = 'fitted' if each.fitted else f'{each.deviation:+.3f}'
        rows.setdefault(name, [name]).append(f'{each.paper:.3f}  {each.ours:.3f}  {deviation}')
    return text_table(['paper, ours, deviation', *families], list(rows.values()))


def cost_table(costs: Mapping[str, Cost]) -> str:
    """Tabulate the cost of chips by method, with the difference from `outer` in brackets."""
    outer = costs['outer']
    rows = []
    for name, cost in costs.items():
        cells = [_against(cost.pixels, outer.pixels)]
        cells += [_against(cost.sizes[codec], outer.sizes[codec]) for codec in ENCODERS]
        lost = f'{cost.hull_lost / cost.hull:.2%}' if cost.hull else 'unknown'
        rows.append((name, str(cost.chips), *cells, lost))
    head = [f'{codec} [bytes]' for codec in ENCODERS]
    return text_table(('method', 'chips', 'pixels', *head, 'hull pixels lost'), rows)


def _against(value: int, outer: int) -> str:
    """Format a number and its difference from that of the outer boxes."""
    return f'{value} ({value / outer - 1.0:+.1%})' if outer else str(value)


def scene_table(labels: ImageLabels, boxes: Mapping[str, FloatArray]) -> str:
    """
    Compare the boxes of methods, each (N, 4), `outer` among them, on N ships with known hulls.

    One row per method: mean size, share of the background in the outer boxes that is removed, share
    of the hulls that is kept, mean IoU with the reference.
    """
    hulls = [hull for hull in labels.hulls if hull is not None]
    whole = np.sum(metrics.hull_inside(np.array([metrics.bounds(hull) for hull in hulls]), hulls))
    inside = {name: np.sum(metrics.hull_inside(xyxy, hulls)) for name, xyxy in boxes.items()}
    background = {name: np.sum(metrics.area(xyxy)) - inside[name] for name, xyxy in boxes.items()}
    rows = []
    for name, xyxy in boxes.items():
        width, height = np.mean(xyxy[:, 2:] - xyxy[:, :2], axis=0)
        removed = 1.0 - background[name] / background['outer']
        kept = inside[name] / whole
        overlap = np.mean(metrics.iou(xyxy, labels.reference))
        rows.append(
            (name, f'{width:.1f} x {height:.1f}', f'{removed:.1%}', f'{kept:.1%}', f'{overlap:.3f}')
        )
    return text_table(
        ('method', 'mean size [px]', 'background removed', 'hull kept', 'IoU with hull bounds'),
        rows,
    )
