# SPDX-License-Identifier: Apache-2.0
"""
The report, one HTML page: tables, curves, calibration, synthetic hulls, a gallery of ships.

The page contains its styles and figures, and loads no other file. Needs Jinja2 and matplotlib, the
extra `plots`.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from obbhbb_ros.geometry.boxes import FloatArray
from obbhbb_ros.geometry.converter import convert_by_rule
from obbhbb_ros.study import evaluation
from obbhbb_ros.study import figures
from obbhbb_ros.study import grid_search
from obbhbb_ros.study import hulls
from obbhbb_ros.study import paper_table
from obbhbb_ros.study.calibration import CalibrationPlan
from obbhbb_ros.study.cross_validation import run
from obbhbb_ros.study.metrics import PROTOCOLS
from obbhbb_ros.study.pages import environment
from obbhbb_ros.study.rules import DEFAULT_RULES
from obbhbb_ros.study.rules import TUNABLE_METHODS
from obbhbb_ros.study.ships import Ships
from obbhbb_ros.study.tables import calibration_text
from obbhbb_ros.study.tables import known_metrics
from obbhbb_ros.study.tables import offset_notes

SENSITIVITY_F = np.round(np.arange(0.5, 1.5001, 0.025), 3)
WIDTHS = {'wide, L/W < 4': (1.0, 4.0), 'L/W 4-6': (4.0, 6.0), 'narrow, L/W >= 6': (6.0, np.inf)}
_FOLDS = 5


def report_page(ships: Ships, title: str, *, gallery: int = 24, seed: int = 0) -> str:
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

    Raises
    ------
    ValueError
        If `gallery` is negative.
    """
    if gallery < 0:
        raise ValueError(f'gallery must be 0 or more, not {gallery}')
    known = ships.take(ships.with_reference) if ships.with_reference.any() else None
    protocol = 'obb' if known is None else 'hbb'
    settings = evaluation.EvaluationSettings(seed=seed)
    protocols = tuple(PROTOCOLS) if known else ('obb',)
    scores = evaluation.evaluate(ships, DEFAULT_RULES, protocols, settings)
    synthetic = hulls.synthetic_ships(seed=seed)
    comparison = paper_table.paper_comparison()
    templates = environment()
    templates.globals.update(
        ALL=evaluation.ALL,
        PROTOCOLS=PROTOCOLS,
        RULES=DEFAULT_RULES,
        TUNABLE_METHODS=TUNABLE_METHODS,
        color_of=figures.color_of,
        known_metrics=known_metrics,
    )
    return templates.get_template('report.html').render(
        title=title,
        rows=[(full, row) for full in hulls.FULLNESS for row in paper_table.PAPER_ROWS],
        ships=ships,
        references=len(known) if known else 0,
        settings=settings,
        scores=evaluation.nested(scores),
        notes=offset_notes(evaluation.offsets(known, settings=settings)) if known else [],
        angles=figures.svg(figures.angle_figure(scores)),
        calibration=_calibration(known, seed) if known else None,
        comparison=comparison,
        deviations={
            row: paper_table.mean_deviation(comparison, row) for row in paper_table.PAPER_ROWS
        },
        hulls=figures.svg(figures.hull_panel()),
        errors=figures.svg(figures.error_figure(_best_errors(synthetic))),
        synthetic=_parameter_figures(synthetic),
        protocol=protocol,
        cards=list(_cards(evaluation.ships_for(ships, protocol), protocol, gallery)),
    )


def _calibration(known: Ships, seed: int) -> dict[str, Any]:
    """Calibrate on ships with reference boxes."""
    folds = min(_FOLDS, known.image_count)
    outcome = run(known, CalibrationPlan(seed=seed), folds, by_aspect=True) if folds > 1 else None
    text = calibration_text(outcome) if outcome else None
    return {'folds': folds, 'text': text, **_parameter_figures(known)}


def _parameter_figures(ships: Ships) -> dict[str, str]:
    """Draw how mean IoU depends on the parameters."""
    surfaces = {name: _paper_grid(ships, name) for name in TUNABLE_METHODS}
    return {
        'surfaces': figures.svg(figures.surface_figure(surfaces)),
        'sensitivity': figures.svg(figures.sensitivity_figure(SENSITIVITY_F, _sensitivity(ships))),
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

    def least(method: str, family: str, full: float) -> float:
        mine = ships.take(ships.class_ids == hulls.class_name(family, full))
        return float(_paper_grid(mine, method).relative_error.min())

    return {
        method: {
            family: np.array([least(method, family, full) for full in hulls.FULLNESS])
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
        mine = {name: xyxy[row] for name, xyxy in boxes.items()}
        points = np.concatenate([corners, np.reshape([reference, *mine.values()], (-1, 2))])
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
            'boxes': mine,
            'iou': {name: values[row] for name, values in scores.items()},
            # Left, top, width and height.
            'view': (*(low - margin), *(high - low + 2.0 * margin)),
        }
