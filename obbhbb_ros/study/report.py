# SPDX-License-Identifier: Apache-2.0
"""
One HTML page with everything: tables, curves, calibration, synthetic hulls, a gallery of ships.

The page contains its styles and figures, and loads nothing. Needs Jinja2 and matplotlib, the extra
`plots`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from jinja2 import Environment
from jinja2 import PackageLoader
from jinja2 import StrictUndefined

from obbhbb_ros.boxes import FloatArray
from obbhbb_ros.converter import convert_by_rule
from obbhbb_ros.study import drawing
from obbhbb_ros.study.calibration import Plan
from obbhbb_ros.study.cross_validation import run
from obbhbb_ros.study.evaluation import ALL
from obbhbb_ros.study.evaluation import Settings
from obbhbb_ros.study.evaluation import evaluate
from obbhbb_ros.study.evaluation import nested
from obbhbb_ros.study.evaluation import overlap
from obbhbb_ros.study.evaluation import ships_for
from obbhbb_ros.study.grid_search import GRIDS
from obbhbb_ros.study.grid_search import Bench
from obbhbb_ros.study.grid_search import search
from obbhbb_ros.study.hulls import FAMILIES
from obbhbb_ros.study.hulls import FULLNESS
from obbhbb_ros.study.hulls import class_name
from obbhbb_ros.study.hulls import synthetic_ships
from obbhbb_ros.study.metrics import PROTOCOLS
from obbhbb_ros.study.paper_table import PAPER_ROWS
from obbhbb_ros.study.paper_table import mean_deviation
from obbhbb_ros.study.paper_table import paper_comparison
from obbhbb_ros.study.rules import DEFAULT_RULES
from obbhbb_ros.study.rules import PAPER_RULE
from obbhbb_ros.study.rules import TUNABLE_METHODS
from obbhbb_ros.study.ships import Ships
from obbhbb_ros.study.tables import outcome_text

SENSITIVITY_F = np.round(np.arange(0.5, 1.5001, 0.025), 3)
WIDTHS = {'wide, L/W < 4': (1.0, 4.0), 'L/W 4-6': (4.0, 6.0), 'narrow, L/W >= 6': (6.0, np.inf)}
_FOLDS = 5


@dataclass(frozen=True, eq=False)
class Card:
    """
    One ship of the gallery.

    Attributes
    ----------
    name, class_id : str
        The ship and its class.
    tilt, aspect : float
        Degrees; length over width.
    corners : ndarray, shape (4, 2)
        Oriented box, pixels.
    hull : ndarray of shape (K, 2), or None
        Hull polygon, if the labels have it, pixels.
    reference : ndarray of shape (4,), or None
        Reference box, xyxy, pixels.
    boxes : dict of str to ndarray of shape (4,)
        Box by method, xyxy, pixels.
    iou : dict of str to float
        IoU by method.
    """

    name: str
    class_id: str
    tilt: float
    aspect: float
    corners: FloatArray
    hull: FloatArray | None
    reference: FloatArray | None
    boxes: Mapping[str, FloatArray]
    iou: Mapping[str, float]

    @property
    def view(self) -> tuple[float, ...]:
        """Left, top, width and height of the picture, with a margin, pixels."""
        drawn = [*self.boxes.values()] + ([] if self.reference is None else [self.reference])
        points = np.concatenate([self.corners, np.reshape(drawn, (-1, 2))])
        low, high = points.min(axis=0), points.max(axis=0)
        margin = 0.05 * float(np.max(high - low))
        return (*(low - margin), *(high - low + 2.0 * margin))


def report_page(ships: Ships, title: str, *, gallery: int = 24, seed: int = 0) -> str:
    """
    Write the page for some ships.

    Parameters
    ----------
    ships : Ships
        The ships. Without reference boxes the page has no calibration on them, and compares with
        the oriented boxes only.
    title : str
        Name of the data.
    gallery : int
        Number of ships to draw, those with the smallest IoU of `superellipse` first.
    seed : int
        Seed of bootstrap samples, splits and synthetic hulls.

    Returns
    -------
    str
        The HTML.

    Raises
    ------
    ValueError
        If `gallery` is negative.
    """
    if gallery < 0:
        raise ValueError(f'gallery must be 0 or more, not {gallery}')
    known = ships.take(ships.with_reference) if ships.with_reference.any() else None
    protocol = 'obb' if known is None else 'hbb'
    settings = Settings(seed=seed)
    scores = evaluate(ships, DEFAULT_RULES, list(PROTOCOLS) if known else ['obb'], settings)
    synthetic = synthetic_ships(seed=seed)
    comparison = paper_comparison()
    environment = Environment(
        loader=PackageLoader('obbhbb_ros.study'), autoescape=True, undefined=StrictUndefined,
        trim_blocks=True, lstrip_blocks=True,
    )
    environment.globals.update(
        ALL=ALL, FULLNESS=FULLNESS, PAPER_ROWS=PAPER_ROWS, PAPER_RULE=PAPER_RULE,
        PROTOCOLS=PROTOCOLS, RULES=DEFAULT_RULES, TUNABLE_METHODS=TUNABLE_METHODS,
        color_of=drawing.color_of,
    )
    return environment.get_template('report.html').render(
        title=title,
        ships=ships,
        references=len(known) if known else 0,
        settings=settings,
        scores=nested(scores),
        angles=drawing.svg(drawing.angle_figure(scores)),
        calibration=_calibration(known, seed) if known else None,
        comparison=comparison,
        deviations={row: mean_deviation(comparison, row) for row in PAPER_ROWS},
        hulls=drawing.svg(drawing.hull_panel()),
        errors=drawing.svg(drawing.error_figure(best_errors(synthetic))),
        synthetic=_parameter_figures(synthetic),
        protocol=protocol,
        cards=gallery_cards(ships_for(ships, protocol), protocol, gallery),
    )


def _calibration(known: Ships, seed: int) -> dict[str, Any]:
    """Calibrate on ships with reference boxes, for the page."""
    folds = min(_FOLDS, known.image_count)
    outcome = run(known, Plan(seed=seed), folds, by_aspect=True, seed=seed) if folds > 1 else None
    text = outcome_text(outcome) if outcome else None
    return {'folds': folds, 'text': text, **_parameter_figures(known)}


def _parameter_figures(ships: Ships) -> dict[str, str]:
    """Draw how mean IoU depends on the parameters."""
    surfaces = {name: search(Bench(ships, name), GRIDS['paper']) for name in TUNABLE_METHODS}
    return {
        'surfaces': drawing.svg(drawing.surface_figure(surfaces)),
        'sensitivity': drawing.svg(drawing.sensitivity_figure(SENSITIVITY_F, sensitivity(ships))),
    }


def sensitivity(ships: Ships) -> dict[str, dict[str, FloatArray]]:
    """
    Compute mean IoU over f for wide and narrow hulls, the paper's Future Work.

    Parameters
    ----------
    ships : Ships
        Ships with reference boxes.

    Returns
    -------
    dict of str to dict of str to ndarray
        By method and band of aspect ratio, one mean IoU per value of `SENSITIVITY_F`, at the
        method's default q and s = 1. Bands without ships are left out.
    """
    curves: dict[str, dict[str, FloatArray]] = {name: {} for name in TUNABLE_METHODS}
    for band, (low, high) in WIDTHS.items():
        rows = (ships.aspect >= low) & (ships.aspect < high)
        if rows.any():
            for name, lines in curves.items():
                bench, q = Bench(ships.take(rows), name), DEFAULT_RULES[name].q
                lines[f'{band} ({rows.sum()})'] = np.array([
                    bench.overlap(bench.extents(q, f)).iou.mean() for f in SENSITIVITY_F
                ])
    return curves


def best_errors(ships: Ships) -> dict[str, dict[str, FloatArray]]:
    """
    Find the smallest mean relative error on the paper's grid by family and fullness.

    Parameters
    ----------
    ships : Ships
        Result of `synthetic_ships` for all families and levels.

    Returns
    -------
    dict of str to dict of str to ndarray
        By method and family, one error per level of `FULLNESS`.
    """

    def least(method: str, family: str, full: float) -> float:
        mine = ships.take(ships.class_ids == class_name(family, full))
        return float(search(Bench(mine, method), GRIDS['paper']).relative_error.min())

    return {
        method: {
            family: np.array([least(method, family, full) for full in FULLNESS])
            for family in FAMILIES
        }
        for method in TUNABLE_METHODS
    }


def gallery_cards(ships: Ships, protocol: str, count: int) -> list[Card]:
    """
    Collect what to draw of the ships with the smallest IoU of `superellipse`.

    Parameters
    ----------
    ships : Ships
        Ships that the protocol can score.
    protocol : str
        A key of `PROTOCOLS`.
    count : int
        Maximum number of ships.

    Returns
    -------
    list of Card
        The worst ship first.
    """
    boxes = {name: convert_by_rule(ships.boxes, rule) for name, rule in DEFAULT_RULES.items()}
    scores = {name: overlap(ships, xyxy, protocol).iou for name, xyxy in boxes.items()}
    worst = np.argsort(scores['superellipse'], kind='stable')[:count]
    return [
        Card(
            name=ships.names[row],
            class_id=str(ships.class_ids[row]),
            tilt=ships.tilt[row],
            aspect=ships.aspect[row],
            corners=ships.boxes.corners[row],
            hull=ships.hulls[row],
            reference=ships.reference[row] if ships.with_reference[row] else None,
            boxes={name: xyxy[row] for name, xyxy in boxes.items()},
            iou={name: values[row] for name, values in scores.items()},
        )
        for row in worst.tolist()
    ]
