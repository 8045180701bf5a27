# SPDX-License-Identifier: Apache-2.0
"""
One HTML page of everything: tables, curves, calibration, synthetic hulls, a gallery of ships.

The page is self-contained: styles and figures stand in it, and it fetches nothing.
"""

from __future__ import annotations

from collections.abc import Iterator
from collections.abc import Mapping
from collections.abc import Sequence
from html import escape

import numpy as np

from obbhbb_ros.boxes import FloatArray
from obbhbb_ros.converter import convert_by_rule
from obbhbb_ros.study import charts
from obbhbb_ros.study.calibration import GRIDS
from obbhbb_ros.study.calibration import Bench
from obbhbb_ros.study.calibration import Plan
from obbhbb_ros.study.calibration import search
from obbhbb_ros.study.evaluation import DEFAULT_RULES
from obbhbb_ros.study.evaluation import PAPER_RULE
from obbhbb_ros.study.evaluation import Settings
from obbhbb_ros.study.evaluation import evaluate
from obbhbb_ros.study.evaluation import overlap
from obbhbb_ros.study.evaluation import score_rows
from obbhbb_ros.study.evaluation import ships_for
from obbhbb_ros.study.hulls import FAMILIES
from obbhbb_ros.study.hulls import FULLNESS
from obbhbb_ros.study.hulls import PAPER_ROWS
from obbhbb_ros.study.hulls import class_name
from obbhbb_ros.study.hulls import comparison_rows
from obbhbb_ros.study.hulls import mean_deviation
from obbhbb_ros.study.hulls import paper_comparison
from obbhbb_ros.study.hulls import synthetic_ships
from obbhbb_ros.study.outcome import outcome_text
from obbhbb_ros.study.outcome import run
from obbhbb_ros.study.plots import COLORS
from obbhbb_ros.study.ships import Ships

TUNABLE = ('superellipse', 'shape_aware')
SENSITIVITY_F = np.round(np.arange(0.5, 1.5001, 0.025), 3)
WIDTHS = {'wide, L/W < 4': (1.0, 4.0), 'L/W 4-6': (4.0, 6.0), 'narrow, L/W >= 6': (6.0, np.inf)}
_FOLDS = 5

_STYLE = """
:root { font: 15px/1.5 system-ui, sans-serif; color: #1c2529; background: #fff; }
body { max-width: 1240px; margin: 0 auto; padding: 24px; }
h1 { font-size: 1.7rem; margin: 0 0 4px; }
h2 { font-size: 1.25rem; margin: 44px 0 8px; padding-top: 12px; border-top: 1px solid #d5dde1; }
h3 { font-size: 1rem; margin: 24px 0 6px; }
p { max-width: 78ch; margin: 6px 0; }
.wide { overflow-x: auto; }
table { border-collapse: collapse; font-size: .84rem; font-variant-numeric: tabular-nums; }
th, td { padding: 4px 9px; text-align: right; white-space: pre; }
th { color: #52636b; border-bottom: 1px solid #aab8be; font-weight: 600; }
th:first-child, td:first-child { text-align: left; }
tbody tr:nth-child(even) { background: #f4f7f8; }
td.best { font-weight: 700; color: #0b7d3e; }
pre { background: #f4f7f8; padding: 12px 14px; overflow-x: auto; font-size: .8rem; }
figure { margin: 8px 0; }
figure svg { width: 100%; max-width: 1180px; height: auto; }
.switch { position: absolute; opacity: 0; }
.switches { position: sticky; top: 0; background: #fff; padding: 8px 0; z-index: 1; }
.switches label { margin-right: 14px; white-space: nowrap; font-size: .86rem; }
.swatch { display: inline-block; width: 18px; height: 0; border-top: 3px solid; margin: 0 4px 3px; }
.gallery { display: grid; grid-template-columns: repeat(auto-fill, minmax(280px, 1fr)); gap: 16px; }
.card { border: 1px solid #d5dde1; border-radius: 4px; padding: 8px; }
.card svg { display: block; width: 100%; height: 230px; background: #eef3f5; }
.card svg * { fill: none; vector-effect: non-scaling-stroke; }
.card .hull { fill: #b4c0c5; }
.card .obb { stroke: #111; stroke-width: 1.2; stroke-dasharray: 4 3; }
.card .reference { stroke: #111; stroke-width: 4; opacity: .35; }
.card p { font-size: .78rem; margin: 4px 0 0; }
"""


def report_page(ships: Ships, title: str, *, gallery: int = 24, seed: int = 0) -> str:
    """
    Write the page for some ships.

    Parameters
    ----------
    ships : Ships
        The ships. Without reference boxes the page has no calibration on them, and compares with
        the oriented boxes only.
    title : str
        What to call them.
    gallery : int
        How many ships to draw, those with the smallest IoU of `superellipse` first.
    seed : int
        Seed of bootstrap samples, splits and synthetic hulls.

    Returns
    -------
    str
        The HTML.

    Raises
    ------
    ModuleNotFoundError
        If matplotlib is not installed.
    ValueError
        If `gallery` is negative.
    """
    if gallery < 0:
        raise ValueError(f'gallery must be 0 or more, not {gallery}')
    known = ships.take(ships.with_reference) if ships.with_reference.any() else None
    parts = [*_head(ships, known, title), *_scores(ships, known, seed)]
    if known is not None:
        parts += _calibration(known, seed)
    parts += _synthetic(seed)
    parts += _gallery(known or ships, 'obb' if known is None else 'hbb', gallery)
    body = '\n'.join(parts)
    return (
        '<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f'<title>obbhbb: {escape(title)}</title>\n<style>{_STYLE}{_switch_styles()}</style>\n'
        f'</head>\n<body>\n{body}\n</body>\n</html>\n'
    )


def _head(ships: Ships, known: Ships | None, title: str) -> Iterator[str]:
    """Say what the page is about."""
    references = 0 if known is None else len(known)
    yield f'<h1>From oriented to axis-aligned boxes: {escape(title)}</h1>'
    yield (
        f'<p>{len(ships)} ships in {ships.image_count} images, {references} of them with a '
        f'reference box; {ships.skipped} boxes without area left out. Mean IoU with 95 % bootstrap '
        'intervals, images drawn with replacement.</p>'
    )


def _scores(ships: Ships, known: Ships | None, seed: int) -> Iterator[str]:
    """Tabulate and draw the scores of all methods."""
    settings = Settings(seed=seed)
    protocols = ('obb',) if known is None else ('obb', 'hbb')
    scores = evaluate(ships, DEFAULT_RULES, protocols, settings)
    yield '<h2>All methods side by side</h2>'
    yield (
        '<p>Two protocols that answer different questions. Protocol <b>obb</b> compares a box with '
        'the oriented box it was made from: overshoot is what it adds, undershoot what it cuts. '
        'Protocol <b>hbb</b> compares it with an axis-aligned box that somebody drew separately: '
        'the box that is wanted. "keep" is the share of ships that keep so much of it.</p>'
    )
    for name, head, rows in score_rows(scores, settings):
        by_column = head[0] == 'stratum'
        yield f'<h3>{escape(name[:1].upper() + name[1:])}</h3>'
        yield _table(head, rows, best=_best_of_rows(rows) if by_column else _best_iou(rows))
    yield '<h2>By angle</h2>'
    yield _figure(charts.svg(charts.angle_figure(scores)))


def _calibration(known: Ships, seed: int) -> Iterator[str]:
    """Calibrate on the ships, and show how the figures hang on the parameters."""
    yield '<h2>Calibration on these ships</h2>'
    yield (
        "<p>The paper's grid (Algorithm 2): mean IoU over q and f, each at its best s, protocol "
        'hbb.</p>'
    )
    surfaces = {name: search(Bench(known, name), GRIDS['paper']) for name in TUNABLE}
    yield _figure(charts.svg(charts.surface_figure(surfaces)))
    folds = min(_FOLDS, known.image_count)
    if folds > 1:
        yield f'<p>Refined continuously; {folds}-fold cross-validation by image:</p>'
        found = run(known, Plan(seed=seed), folds, by_aspect=True, seed=seed)
        yield f'<pre>{escape(outcome_text(found))}</pre>'
    yield '<h2>Sensitivity to fullness, narrow and wide hulls</h2>'
    yield '<p>These ships: mean IoU over f at q = 3 (superellipse) and q = 2.2 (shape_aware).</p>'
    yield _figure(charts.svg(charts.sensitivity_figure(SENSITIVITY_F, sensitivity(known))))


def sensitivity(ships: Ships) -> dict[str, dict[str, FloatArray]]:
    """
    Follow mean IoU over f for wide and narrow hulls, the paper's Future Work.

    Parameters
    ----------
    ships : Ships
        Ships with reference boxes.

    Returns
    -------
    dict of str to dict of str to ndarray
        By method and band of aspect ratio, one mean IoU for each of `SENSITIVITY_F`, at the
        method's own q and s = 1. Bands without ships are left out.
    """
    curves: dict[str, dict[str, FloatArray]] = {name: {} for name in TUNABLE}
    for band, (low, high) in WIDTHS.items():
        rows = (ships.aspect >= low) & (ships.aspect < high)
        if rows.any():
            for name, lines in curves.items():
                bench, q = Bench(ships.take(rows), name), DEFAULT_RULES[name].q
                label = f'{band} ({rows.sum()})'
                lines[label] = np.array([
                    bench.overlap(bench.extents(q, f)).iou.mean() for f in SENSITIVITY_F
                ])
    return curves


def best_errors(ships: Ships) -> dict[str, dict[str, FloatArray]]:
    """
    Find the least mean relative error on the paper's grid by family and fullness.

    Parameters
    ----------
    ships : Ships
        What `synthetic_ships` gives for all families and levels.

    Returns
    -------
    dict of str to dict of str to ndarray
        By method and family, one error for each level of `FULLNESS`.
    """
    return {
        method: {
            family: np.array([
                search(
                    Bench(ships.take(ships.class_ids == class_name(family, full)), method),
                    GRIDS['paper'],
                ).relative_error.min()
                for full in FULLNESS
            ])
            for family in FAMILIES
        }
        for method in TUNABLE
    }


def _synthetic(seed: int) -> Iterator[str]:
    """Show the synthetic hulls and what comes out on them."""
    ships = synthetic_ships(seed=seed)
    compared = paper_comparison()
    yield '<h2>Synthetic hulls</h2>'
    yield (
        "<p>The paper's four families at four levels of fullness. It does not publish its "
        'polygons: the ends of each family were fitted to the row N at fullness 1.00, everything '
        'else is a prediction. Rows: N outer, M midpoint, S the published rule at its best-found '
        'setting. In each cell: the paper, ours, the deviation.</p>'
    )
    yield _figure(charts.svg(charts.hull_panel()))
    yield '<h3>Mean relative error, Table 1 of the paper</h3>'
    yield _table(*comparison_rows(compared))
    deviations = ', '.join(f'{row} {mean_deviation(compared, row):.4f}' for row in PAPER_ROWS)
    yield f'<p>Mean absolute deviation of the predictions: {deviations}.</p>'
    yield "<h3>Best mean relative error on the paper's grid</h3>"
    yield _figure(charts.svg(charts.error_figure(best_errors(ships))))
    yield "<h3>The paper's grid on the synthetic hulls: mean IoU</h3>"
    surfaces = {name: search(Bench(ships, name), GRIDS['paper']) for name in TUNABLE}
    yield _figure(charts.svg(charts.surface_figure(surfaces)))
    yield '<h3>Sensitivity to fullness, synthetic hulls</h3>'
    yield _figure(charts.svg(charts.sensitivity_figure(SENSITIVITY_F, sensitivity(ships))))


def _gallery(ships: Ships, protocol: str, count: int) -> Iterator[str]:
    """Draw the worst ships."""
    ships = ships_for(ships, protocol)
    boxes = {name: convert_by_rule(ships.boxes, rule) for name, rule in DEFAULT_RULES.items()}
    scores = {name: overlap(ships, xyxy, protocol).iou for name, xyxy in boxes.items()}
    worst = np.argsort(scores['superellipse'], kind='stable')[:count]
    yield '<h2>Gallery, the worst first</h2>'
    yield (
        f'<p>The {len(worst)} ships with the smallest IoU of superellipse, protocol {protocol}. '
        'Dashed: oriented box. Thick and grey: reference box. Filled: hull, where the labels have '
        f'it. shape_aware as published (q {PAPER_RULE.q:g}, f {PAPER_RULE.f:g}).</p>'
    )
    yield from (
        f'<input type="checkbox" class="switch" id="show-{name}" checked>'
        for name in DEFAULT_RULES
    )
    switches = ''.join(
        f'<label for="show-{name}"><span class="swatch" style="color:{COLORS[name]}"></span>'
        f'{name}</label>'
        for name in DEFAULT_RULES
    )
    yield f'<div class="switches">Click to hide or show: {switches}</div>'
    yield '<div class="gallery">'
    for row in worst.tolist():
        yield _card(ships, boxes, {name: values[row] for name, values in scores.items()}, row)
    yield '</div>'


def _switch_styles() -> str:
    """Hide the boxes of a method whose switch is off; no script is needed."""
    return ''.join(
        f'#show-{name}:not(:checked) ~ .gallery .m-{name} {{ display: none; }}\n'
        f'#show-{name}:not(:checked) ~ .switches label[for=show-{name}] {{ opacity: .35; }}\n'
        f'#show-{name}:focus-visible ~ .switches label[for=show-{name}] {{ outline: 2px solid; }}\n'
        f'.m-{name} {{ stroke: {COLORS[name]}; stroke-width: {_stroke(name)}; }}\n'
        for name in DEFAULT_RULES
    )


def _stroke(method: str) -> float:
    """Draw the recommended rule thicker, pixels."""
    return 3.0 if method == 'superellipse' else 1.4


def _card(
    ships: Ships, boxes: Mapping[str, FloatArray], scores: Mapping[str, float], row: int
) -> str:
    """Draw one ship with all its boxes."""
    corners, hull, reference = ships.boxes.corners[row], ships.hulls[row], ships.reference[row]
    shapes = []
    if hull is not None:
        shapes.append(f'<polygon class="hull" points="{_points(hull)}"/>')
    if not np.isnan(reference).any():
        shapes.append(_rectangle('reference', reference))
    # The last is on top.
    shapes += [_rectangle(f'm-{name}', boxes[name][row]) for name in reversed(list(boxes))]
    shapes.append(f'<polygon class="obb" points="{_points(corners)}"/>')
    around = [reference, *(xyxy[row] for xyxy in boxes.values())]
    points = np.concatenate([corners, np.reshape(around, (-1, 2))])
    low, high = np.nanmin(points, axis=0), np.nanmax(points, axis=0)
    margin = 0.05 * float(np.max(high - low))
    view = (*(low - margin), *(high - low + 2.0 * margin))
    named = ('superellipse', 'shape_aware', 'outer')
    figures = ', '.join(f'{name} {scores[name]:.3f}' for name in named)
    return (
        f'<div class="card"><svg viewBox="{" ".join(f"{v:.2f}" for v in view)}">'
        f'{"".join(shapes)}</svg><p><b>{escape(ships.names[row])}</b>, '
        f'{escape(str(ships.class_ids[row]))}, tilt {ships.tilt[row]:.0f}°, '
        f'L/W {ships.aspect[row]:.1f}<br>IoU: {figures}</p></div>'
    )


def _points(polygon: FloatArray) -> str:
    """Write vertices for SVG."""
    return ' '.join(f'{x:.2f},{y:.2f}' for x, y in polygon)


def _rectangle(name: str, xyxy: FloatArray) -> str:
    """Write a box for SVG."""
    x0, y0, x1, y1 = xyxy
    size = f'width="{x1 - x0:.2f}" height="{y1 - y0:.2f}"'
    return f'<rect class="{name}" x="{x0:.2f}" y="{y0:.2f}" {size}/>'


def _table(
    head: Sequence[str], rows: Sequence[Sequence[str]], best: set[tuple[int, int]] | None = None
) -> str:
    """Write a table; cells named in `best` as (row, column) stand out."""
    lines = []
    for i, row in enumerate(rows):
        cells = ''.join(
            f'<td class="best">{escape(cell)}</td>' if best and (i, j) in best
            else f'<td>{escape(cell)}</td>'
            for j, cell in enumerate(row)
        )
        lines.append(f'<tr>{cells}</tr>')
    top = ''.join(f'<th>{escape(cell)}</th>' for cell in head)
    body = '\n'.join(lines)
    return (
        f'<div class="wide"><table><thead><tr>{top}</tr></thead>\n'
        f'<tbody>{body}</tbody></table></div>'
    )


def _best_iou(rows: Sequence[Sequence[str]]) -> set[tuple[int, int]]:
    """Find the largest mean IoU of a table of methods."""
    column = 2
    return {(max(range(len(rows)), key=lambda i: float(rows[i][column])), column)}


def _best_of_rows(rows: Sequence[Sequence[str]]) -> set[tuple[int, int]]:
    """Find the largest mean IoU of each stratum."""
    return {
        (i, max(range(2, len(row)), key=lambda j: float(row[j]))) for i, row in enumerate(rows)
    }


def _figure(drawing: str) -> str:
    """Frame a drawing."""
    return f'<figure>{drawing}</figure>'
