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
from obbhbb_ros.study.bootstrap import Interval
from obbhbb_ros.study.calibration import MIN_GAIN
from obbhbb_ros.study.chip_costs import ENCODERS
from obbhbb_ros.study.chip_costs import Cost
from obbhbb_ros.study.coverage import Coverage
from obbhbb_ros.study.cross_validation import CALIBRATED
from obbhbb_ros.study.cross_validation import CalibrationResult
from obbhbb_ros.study.paper_table import Comparison
from obbhbb_ros.study.rules import TUNABLE_METHODS
from obbhbb_ros.text_tables import text_table


def score_tables(
    scores: Sequence[evaluation.Score],
    settings: evaluation.EvaluationSettings = evaluation.DEFAULT_SETTINGS,
    offsets: Sequence[evaluation.Offset] = (),
    notes: Sequence[str] = (),
) -> str:
    """
    Tabulate scores: for each protocol every metric over all ships, then mean IoU by stratum.

    The offsets follow, if there are any, with a note for significant ones, then other notes.
    """
    parts = []
    for protocol, by_stratum in evaluation.nested(scores).items():
        overall = list(by_stratum[evaluation.ALL].values())
        count = f'{overall[0].ships} ships in {overall[0].images} images'
        title = f'protocol {protocol}: {metrics.PROTOCOLS[protocol]}, {count}'
        parts.append(f'{title}\n{_score_table(overall, settings)}')
        rows = []
        for stratum, by_method in by_stratum.items():
            of_stratum = list(by_method.values())
            means = [f'{score.iou:.4f}' for score in of_stratum]
            rows.append([stratum, str(of_stratum[0].ships), *means])
        table = text_table(['stratum', 'ships', *by_stratum[evaluation.ALL]], rows)
        parts.append(f'mean IoU by stratum, {title}\n{table}')
    if offsets:
        parts.append(f'median offset from the reference box, px\n{_offset_table(offsets)}')
        parts += offset_notes(offsets)
    return '\n\n'.join([*parts, *notes])


def known_metrics(scores: Sequence[evaluation.Score]) -> dict[str, evaluation.Metric]:
    """Select the metrics, besides mean IoU, that are known for at least one of the scores."""
    return {
        name: metric
        for name, metric in evaluation.METRICS.items()
        if name != 'iou' and not all(np.isnan(getattr(score, name)) for score in scores)
    }


def _score_table(
    scores: Sequence[evaluation.Score], settings: evaluation.EvaluationSettings
) -> str:
    """Tabulate the metrics of methods."""
    shown = known_metrics(scores)
    head = ['method', 'q / f / s', 'mean IoU', '95 % interval']
    head += [metric.heading(settings) for metric in shown.values()]
    rows = []
    for score in scores:
        low, high = score.iou_low, score.iou_high
        interval = '' if np.isnan(low) else f'{low:.3f}-{high:.3f}'
        cells = [f'{getattr(score, name):{metric.form}}' for name, metric in shown.items()]
        rows.append([score.method, tuned_text(score), f'{score.iou:.4f}', interval, *cells])
    return text_table(head, rows)


def tuned_text(score: evaluation.Score) -> str:
    """Format the parameters of a method; empty for one without."""
    if score.method not in TUNABLE_METHODS:
        return ''
    ends = {'bow': score.q_bow, 'stern': score.q_stern}
    texts = [f', {name} {q:.4g}' for name, q in ends.items() if q is not None]
    return f'{score.q:.4g} / {score.f:.4g} / {score.s:.4g}{"".join(texts)}'


def _offset_table(offsets: Sequence[evaluation.Offset]) -> str:
    """Tabulate offsets of centres and sides."""
    sides = ('left', 'top', 'right', 'bottom')
    rows = []
    for offset in offsets:
        x = (f'{offset.x:+.2f}', _pixel_range(offset.x_interval))
        y = (f'{offset.y:+.2f}', _pixel_range(offset.y_interval))
        rows.append([offset.method, *x, *y, *(f'{getattr(offset, side):+.2f}' for side in sides)])
    centre = ('centre x', '95 % interval', 'centre y', '95 % interval')
    return text_table(('method', *centre, *sides), rows)


def _pixel_range(interval: Interval) -> str:
    """Format an interval of pixels."""
    return '' if np.isnan(interval.low) else f'{interval.low:+.2f} to {interval.high:+.2f}'


def offset_notes(offsets: Sequence[evaluation.Offset]) -> list[str]:
    """
    Warn of significant offsets, in one line each; methods with the same offset share one.

    An axis whose interval contains zero is not named.
    """
    methods: dict[str, list[str]] = {}
    for offset in offsets:
        where = ' and '.join(
            f'{value:+.2f} px in {axis} ({_pixel_range(interval)})'
            for axis, (value, interval) in offset.significant_axes.items()
        )
        if where:
            methods.setdefault(where, []).append(offset.method)
    return [
        f'note: significant offset from the reference boxes: {where}'
        + ('' if len(names) == len(offsets) else f', {", ".join(names)}')
        for where, names in methods.items()
    ]


def calibration_text(result: CalibrationResult) -> str:
    """Describe the result of a calibration: rule, held-out metrics, gains, guarantee."""
    plan = result.calibrator.plan
    count = f'{len(result.ships)} ships in {result.ships.image_count} images'
    parts = [f'{plan.method} for {plan.objective.summary}, {count}: {rule_text(result.rule)}']
    if result.held_out:
        parts.append(_held_out_table(result))
    if lines := _decision_lines(result):
        parts.append('\n'.join(lines))
    if result.rule_of_aspect:
        bands = {f'{low:.2f} to {high:.2f}': rule for low, high, rule in result.rule_of_aspect}
        parts.append(_rule_table('L/W', bands))
    if result.gains:
        parts.append('\n'.join(map(str, result.gains)))
    if result.rule_of_class:
        parts.append(_rule_table('class', result.rule_of_class))
    if isinstance(plan.objective, Coverage):
        parts.append(_guarantee(result, plan.objective))
    return '\n\n'.join([*parts, *result.notes])


def _rule_table(group: str, rules: Mapping[str, HullRule]) -> str:
    """Tabulate the rules of groups."""
    return text_table((group, 'rule'), [(name, rule_text(rule)) for name, rule in rules.items()])


def _held_out_table(result: CalibrationResult) -> str:
    """Tabulate the metrics on held-out images."""
    settings = evaluation.EvaluationSettings(keep=result.calibrator.plan.objective.keep)
    shown = {name: evaluation.METRICS[name] for name in ('match', 'undershoot', 'kept', 'area')}
    head = ['protocol hbb, held out', 'mean IoU', '95 % interval']
    head += [metric.heading(settings) for metric in shown.values()]
    rows = []
    for name, values in result.held_out.items():
        low, high = result.interval(name)
        cells = [f'{values[key].mean():{metric.form}}' for key, metric in shown.items()]
        rows.append([name, f'{values["iou"].mean():.4f}', f'{low:.3f}-{high:.3f}', *cells])
    return text_table(head, rows)


def _decision_lines(result: CalibrationResult) -> list[str]:
    """Report what was tried beside q, what it gained and whether it was fitted."""
    calibrator = result.calibrator
    objective = calibrator.plan.objective
    beside_q, unit = ' and '.join(objective.parameters[1:]), objective.unit
    ends = f'q_bow and q_stern over q, {result.ships.boxes.bow.sum()} ships with a known bow'
    gains = {f'{beside_q} over q alone': calibrator.gain_of_f_and_s, ends: calibrator.gain_of_ends}
    return [
        f'{name}: gain {gain:+.4f} of held-out {unit}, fitted'
        if gain >= MIN_GAIN
        else f'{name}: gain none ({gain:+.4f} of held-out {unit}, below {MIN_GAIN:g}), not fitted'
        for name, gain in gains.items()
        if gain is not None
    ]


def _guarantee(result: CalibrationResult, objective: Coverage) -> str:
    """State what a calibration for coverage guarantees, on what condition, and its scatter."""
    per_image = objective.per_image
    unit = 'ships' if per_image == 1 else f'images of at most {per_image} ships'
    text = (
        f'Guarantee: a new ship keeps {objective.keep:.0%} of its reference box with a probability '
        f'of at least {objective.share:.0%},\n'
        f'if new {unit} are exchangeable with those that gave s '
        '(half of the images; the others gave q and f).'
    )
    if result.scatter:
        low, high = result.scatter
        text += (
            f'\nIt holds on average. One calibration, counted on as many new images, lands between '
            f'{low:.1%} and {high:.1%}\n(95 % interval over images; ships of an image are alike).'
        )
    if result.held_out:
        low, high = result.interval(CALIBRATED, 'kept')
        share = result.held_out[CALIBRATED]['kept'].mean()
        text += (
            f'\nHeld out, {share:.1%} of the ships keep it ({low:.1%} to {high:.1%}, '
            '95 % interval over images).'
        )
    return text


def rule_text(rule: HullRule) -> str:
    """Format the parameters of a rule."""
    values = {'q': rule.q, 'f': rule.f, 's': rule.s, 'q_bow': rule.q_bow, 'q_stern': rule.q_stern}
    return ', '.join(f'{name} {value:.4g}' for name, value in values.items() if value is not None)


def comparison_table(comparisons: Sequence[Comparison]) -> str:
    """Tabulate the paper's Table 1, our numbers and the deviations, from `paper_comparison`."""
    families = list(dict.fromkeys(comparison.family for comparison in comparisons))
    rows: dict[str, list[str]] = {}
    for comparison in sorted(comparisons, key=lambda comparison: comparison.fullness):
        name = f'{comparison.fullness:.2f} {comparison.row}'
        rows.setdefault(name, [name]).append(str(comparison))
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
        size = f'{width:.1f} x {height:.1f}'
        rows.append((name, size, f'{removed:.1%}', f'{kept:.1%}', f'{overlap:.3f}'))
    head = ('method', 'mean size [px]', 'background removed', 'hull kept', 'IoU with hull bounds')
    return text_table(head, rows)
