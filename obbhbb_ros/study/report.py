# SPDX-License-Identifier: Apache-2.0
"""
The report, one HTML page: its conclusion, the user's ships, and the synthetic hulls of the paper.

The page contains its styles and figures, and loads no other file. Needs Jinja2 and matplotlib, the
extra `plots`.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import product
from typing import Any

import numpy as np

from obbhbb_ros.geometry.boxes import FloatArray
from obbhbb_ros.geometry.converter import convert_by_rule
from obbhbb_ros.pages import rendered
from obbhbb_ros.study import evaluation
from obbhbb_ros.study import figures
from obbhbb_ros.study import grid_search
from obbhbb_ros.study import hulls
from obbhbb_ros.study import metrics
from obbhbb_ros.study import paper_table
from obbhbb_ros.study import tables
from obbhbb_ros.study.calibration import CalibrationPlan
from obbhbb_ros.study.cautions import cautions
from obbhbb_ros.study.cross_validation import CALIBRATED
from obbhbb_ros.study.cross_validation import CalibrationResult
from obbhbb_ros.study.cross_validation import run
from obbhbb_ros.study.metrics import PROTOCOLS
from obbhbb_ros.study.rules import DEFAULT_RULES
from obbhbb_ros.study.rules import TUNABLE_METHODS
from obbhbb_ros.study.ships import Ships

SENSITIVITY_F = np.round(np.arange(0.5, 1.5001, 0.025), 3)
WIDTHS = {'wide, L/W < 4': (1.0, 4.0), 'L/W 4-6': (4.0, 6.0), 'narrow, L/W >= 6': (6.0, np.inf)}
_MAX_FOLDS = 5


def report_page(
    ships: Ships, title: str, *, gallery: int = 24, seed: int = 0, command: str = ''
) -> str:
    """
    Return the report on some ships, as HTML.

    Parameters
    ----------
    ships : Ships
        The ships. Without reference boxes the report has no calibration on them, and compares
        with the oriented boxes only.
    title : str
        Name of the data.
    gallery : int
        Number of ships to draw, those with the lowest IoU of `superellipse` first.
    seed : int
        Seed of bootstrap samples, splits and synthetic hulls.
    command : str
        Command line to name on the page.

    Raises
    ------
    ValueError
        If `gallery` is negative.
    """
    if gallery < 0:
        raise ValueError(f'gallery must be 0 or more, not {gallery}')
    referenced = ships.take(ships.with_reference) if ships.with_reference.any() else None
    protocols = tuple(PROTOCOLS) if referenced else ('obb',)
    settings = evaluation.EvaluationSettings(seed=seed)
    scores = evaluation.evaluate(ships, DEFAULT_RULES, protocols, settings)
    result = _cross_validated(referenced, seed) if referenced else None
    offsets = evaluation.offsets(referenced, settings=settings) if referenced else []
    return rendered(
        'study',
        'report.html',
        title,
        command,
        ALL=evaluation.ALL,
        PROTOCOLS=PROTOCOLS,
        RULES=DEFAULT_RULES,
        TUNABLE_METHODS=TUNABLE_METHODS,
        color_of=figures.color_of,
        svg=figures.svg,
        known_metrics=tables.known_metrics,
        tuned_text=tables.tuned_text,
        conclusion=conclusion(referenced, result),
        ships=ships,
        references=len(referenced) if referenced else 0,
        settings=settings,
        scores=evaluation.nested(scores),
        # The text of a calibration has them.
        notes=[*tables.offset_notes(offsets), *([] if result else cautions(ships))],
        angles=figures.angle_figure(scores),
        calibration=_calibration(referenced, result) if referenced else None,
        protocol=protocols[-1],
        cards=list(_cards(evaluation.ships_for(ships, protocols[-1]), protocols[-1], gallery)),
        **_synthetic_study(seed),
    )


def conclusion(ships: Ships | None, result: CalibrationResult | None) -> str:
    """
    Say in a sentence which q is best, and what it gains over the outer box and over the default.

    Parameters
    ----------
    ships : Ships or None
        The ships with reference boxes, if there are any.
    result : CalibrationResult or None
        Their calibration, if they lie in more than one image.
    """
    default = f'the default, q {DEFAULT_RULES["superellipse"].q:g}'
    if ships is None:
        return (
            f'No ship has a reference box, so no best q can be found: use {default}, and give '
            'labels with reference boxes to calibrate.'
        )
    if result is None or not result.held_out:
        iou, outer = (
            metrics.iou(convert_by_rule(ships.boxes, DEFAULT_RULES[name]), ships.reference).mean()
            for name in ('superellipse', 'outer')
        )
        return (
            f'Too few images to calibrate on some and measure on others: use {default}, whose mean '
            f'IoU is {iou:.4f}, where the outer box has {outer:.4f}.'
        )
    best, gain = tables.rule_text(result.rule), result.gain(CALIBRATED, 'default')
    name = CALIBRATED if gain.earned else 'default'
    over_outer = result.gain(name, 'outer')
    mean = result.held_out[name]['iou'].mean()
    fit = (
        f'a mean IoU of {mean:.4f} on held-out images, {over_outer.mean:+.4f} against the outer '
        f'box ({over_outer.low:+.4f} to {over_outer.high:+.4f})'
    )
    against = f'{gain.mean:+.4f} ({gain.low:+.4f} to {gain.high:+.4f})'
    if gain.earned:
        return f'For these ships use {best}: it has {fit} and {against} against {default}.'
    return (
        f'For these ships use {default}: it has {fit}; a rule calibrated on them, {best}, makes '
        f'a difference of {against}.'
    )


def _cross_validated(ships: Ships, seed: int) -> CalibrationResult | None:
    """Calibrate on ships with reference boxes; None if they lie in one image."""
    folds = min(_MAX_FOLDS, ships.image_count)
    return run(ships, CalibrationPlan(seed=seed), folds, by_aspect=True) if folds > 1 else None


def _calibration(ships: Ships, result: CalibrationResult | None) -> dict[str, Any]:
    """Describe the calibration on ships with reference boxes, and draw what it depends on."""
    text = tables.calibration_text(result) if result else None
    return {'folds': min(_MAX_FOLDS, ships.image_count), 'text': text, **_parameter_figures(ships)}


def _synthetic_study(seed: int) -> dict[str, Any]:
    """Measure and draw the synthetic hulls, and compare them with the paper's Table 1."""
    ships, comparison = hulls.synthetic_ships(seed=seed), paper_table.paper_comparison()
    rows = tuple(paper_table.PAPER_ROWS)
    return {
        'comparison': comparison,
        'rows': list(product(hulls.FULLNESS, rows)),
        'deviations': {row: paper_table.mean_deviation(comparison, row) for row in rows},
        'hulls': figures.hull_panel(),
        'errors': figures.error_figure(_best_errors(ships)),
        'synthetic': _parameter_figures(ships),
    }


def _parameter_figures(ships: Ships) -> dict[str, Any]:
    """Draw how mean IoU depends on the parameters."""
    surfaces = {name: _paper_grid(ships, name) for name in TUNABLE_METHODS}
    return {
        'surfaces': figures.surface_figure(surfaces),
        'sensitivity': figures.sensitivity_figure(SENSITIVITY_F, _sensitivity(ships)),
    }


def _paper_grid(ships: Ships, method: str) -> grid_search.Surface:
    """Search the paper's grid."""
    return grid_search.search(grid_search.Bench(ships, method), grid_search.GRIDS['paper'])


def _sensitivity(ships: Ships) -> dict[str, dict[str, FloatArray]]:
    """
    Compute mean IoU for each of `SENSITIVITY_F` by method and width, the paper's Future Work.

    q is the method's default and s is 1. Bands without ships are left out.
    """
    curves: dict[str, dict[str, FloatArray]] = {name: {} for name in TUNABLE_METHODS}
    for band, rows in evaluation.in_bands(ships.aspect, WIDTHS).items():
        if rows.any():
            for name, lines in curves.items():
                bench, q = grid_search.Bench(ships.take(rows), name), DEFAULT_RULES[name].q
                lines[f'{band} ({rows.sum()})'] = np.array(
                    [bench.overlap(bench.extents(q, f)).iou.mean() for f in SENSITIVITY_F]
                )
    return curves


def _best_errors(ships: Ships) -> dict[str, dict[str, FloatArray]]:
    """Find the smallest mean relative error on the paper's grid by method, family and fullness."""

    def min_error(method: str, family: str, full: float) -> float:
        members = ships.take(ships.class_ids == hulls.class_name(family, full))
        return float(_paper_grid(members, method).relative_error.min())

    return {
        method: {
            family: np.array([min_error(method, family, full) for full in hulls.FULLNESS])
            for family in hulls.FAMILIES
        }
        for method in TUNABLE_METHODS
    }


def _cards(ships: Ships, protocol: str, count: int) -> Iterator[dict[str, Any]]:
    """Collect the gallery: the ships with the lowest IoU of `superellipse`, worst first."""
    boxes = {name: convert_by_rule(ships.boxes, rule) for name, rule in DEFAULT_RULES.items()}
    scores = {name: evaluation.overlap(ships, xyxy, protocol).iou for name, xyxy in boxes.items()}
    for row in np.argsort(scores['superellipse'], kind='stable')[:count].tolist():
        corners, reference = ships.boxes.corners[row], ships.reference[row]
        by_method = {name: xyxy[row] for name, xyxy in boxes.items()}
        points = np.concatenate([corners, np.reshape([reference, *by_method.values()], (-1, 2))])
        low, high = np.nanmin(points, axis=0), np.nanmax(points, axis=0)
        margin = 0.05 * float(np.max(high - low))
        yield {
            'name': ships.names[row],
            'class_id': ships.class_ids[row],
            'tilt': ships.tilt[row],
            'aspect': ships.aspect[row],
            'corners': corners,
            'hull': ships.hulls[row],
            'reference': reference if ships.with_reference[row] else None,
            'boxes': by_method,
            'iou': {name: values[row] for name, values in scores.items()},
            # Left, top, width and height.
            'view': (*(low - margin), *(high - low + 2.0 * margin)),
        }
