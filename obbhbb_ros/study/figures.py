# SPDX-License-Identifier: Apache-2.0
"""
All pictures of the study: charts of its results, and ships with their boxes. Needs matplotlib.

One function per figure; `save` writes a figure to a file, `svg` makes it part of a page.
"""

from __future__ import annotations

import io
from collections.abc import Iterable
from collections.abc import Iterator
from collections.abc import Mapping
from collections.abc import Sequence
from contextlib import contextmanager
from html import escape
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib import patches
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from numpy.typing import NDArray
from PIL import Image

from obbhbb_ros.colors import METHOD_COLORS
from obbhbb_ros.colors import ORIENTED_COLOR
from obbhbb_ros.files import replacing
from obbhbb_ros.geometry.boxes import FloatArray
from obbhbb_ros.geometry.boxes import OrientedBoxes
from obbhbb_ros.geometry.converter import convert_by_rule
from obbhbb_ros.labels import ImageLabels
from obbhbb_ros.study import evaluation
from obbhbb_ros.study.chip_costs import ENCODERS
from obbhbb_ros.study.chip_costs import RULES
from obbhbb_ros.study.chip_costs import Cost
from obbhbb_ros.study.grid_search import Surface
from obbhbb_ros.study.hulls import FAMILIES
from obbhbb_ros.study.hulls import FULLNESS
from obbhbb_ros.study.metrics import PROTOCOLS
from obbhbb_ros.study.metrics import bounds

_SEA = '#dfe9ee'
_HULL = '#9aa7ad'
_HULL_EDGE = '#5f6a72'
_BEST = '#d03b2a'
_LINES = ('#1f5fbf', '#0b7d3e', '#e08a00', '#b0389b', '#5f6a72')
_SHADES = ('#9ecae1', '#6baed6', '#3182bd', '#08519c')
_DASHES = (0, (4, 3))
_SHORT_DASHES = (0, (3, 3))
_MARKERS = 'o^s*Dv<>'
_CLOSE_UPS = 6
_PANEL_WIDTH = 5.6
# Of the picture of a ship, as a share of its longer side.
_MARGIN = 0.12
# Of a picture that is shrunk: matplotlib takes 0.2 s for a million pixels.
_MAX_SIDE = 800
_STYLE = {
    'axes.spines.right': False,
    'axes.spines.top': False,
    'axes.grid': True,
    'grid.alpha': 0.25,
    'font.size': 10.0,
    'svg.fonttype': 'none',
    'svg.hashsalt': 'obbhbb',
}


def color_of(method: str) -> str:
    """Return the colour of a method, black if it has none yet."""
    return METHOD_COLORS.get(method, 'black')


def save(figure: Figure, path: Path, dpi: int = 120) -> None:
    """Write a figure to a file, in the format of its suffix, PNG without one."""
    with _styled(), replacing(path) as whole:
        figure.savefig(whole, dpi=dpi, format=path.suffix[1:] or 'png')


def svg(figure: Figure, alt: str) -> str:
    """Write a figure as an `<svg>` element for a page, with a text for those who cannot see it."""
    file = io.StringIO()
    with _styled():
        figure.savefig(file, format='svg', metadata={'Date': None})
    text = file.getvalue()
    return f'<svg role="img" aria-label="{escape(alt)}"' + text.partition('<svg')[2]


@contextmanager
def _styled() -> Iterator[None]:
    """Apply the style of the charts, in a `with` block or as a decorator."""
    with mpl.rc_context(_STYLE):
        yield


def _panels(count: int, height: float, **options: Any) -> tuple[Figure, Any]:
    """Make a figure with panels side by side."""
    figure = Figure(figsize=(_PANEL_WIDTH * count, height), layout='constrained')
    return figure, figure.subplots(1, count, squeeze=False, **options)[0]


def _add_legend_below(figure: Figure, share: float, handles: Sequence[Any], **options: Any) -> None:
    """Put a legend under the panels; matplotlib 3.6 has no 'outside' locations."""
    figure.set_layout_engine('constrained', rect=(0.0, share, 1.0, 1.0 - share))
    figure.legend(handles=handles, loc='lower center', **options)


def _add_box(axes: Any, xyxy: FloatArray, color: str, width: float, dashes: Any = 'solid') -> None:
    """Outline an axis-aligned box, (4,)."""
    x0, y0, x1, y1 = xyxy
    line = {'ec': color, 'lw': width, 'ls': dashes}
    axes.add_patch(patches.Rectangle((x0, y0), x1 - x0, y1 - y0, fill=False, **line))


def _dashes_of(method: str) -> Any:
    """Return the dashes of a method; boxes of `gaussian` lie nearly on those of `shape_aware`."""
    return _SHORT_DASHES if method == 'gaussian' else 'solid'


def _add_oriented_box(axes: Any, corners: FloatArray) -> None:
    """Outline an oriented box by its corners, (4, 2)."""
    axes.add_patch(patches.Polygon(corners, fill=False, ec=ORIENTED_COLOR, ls=_DASHES))


@_styled()
def angle_figure(scores: Sequence[evaluation.Score]) -> Figure:
    """
    Draw mean IoU over the bands of tilt, as the paper's angle-stratified figures do.

    One panel per protocol, one line per method, with 95 % intervals if there are any.
    """
    by_protocol = evaluation.nested(scores)
    figure, panels = _panels(len(by_protocol), 4.6)
    for axes, (protocol, by_stratum) in zip(panels, by_protocol.items(), strict=True):
        _draw_bands(axes, by_stratum)
        axes.set_title(f'protocol {protocol}: {PROTOCOLS[protocol]}', fontsize=10)
    handles, _ = panels[0].get_legend_handles_labels()
    _add_legend_below(figure, 0.13, handles, ncol=4, frameon=False)
    return figure


def _draw_bands(axes: Any, by_stratum: Mapping[str, Mapping[str, evaluation.Score]]) -> None:
    """Draw mean IoU over the bands of tilt."""
    bands = list(evaluation.TILT_BANDS)
    for index, method in enumerate(next(iter(by_stratum.values()))):
        scores = {x: by_stratum[band][method] for x, band in enumerate(bands) if band in by_stratum}
        means = [score.iou for score in scores.values()]
        spread = np.array([[s.iou - s.iou_low, s.iou_high - s.iou] for s in scores.values()])
        style = {
            'color': color_of(method),
            'marker': _MARKERS[index % len(_MARKERS)],
            'lw': 2.2 if method == 'superellipse' else 1.4,
            'ls': '--' if method.endswith('published') else '-',
        }
        errors = np.nan_to_num(spread.reshape(-1, 2)).clip(0.0).T
        axes.errorbar(list(scores), means, errors, label=method, capsize=2, **style)
    axes.set(xticks=range(len(bands)), xticklabels=bands, xlim=(-0.25, len(bands) - 0.75))
    axes.set(ylim=(0.0, 1.0), ylabel='mean IoU')


@_styled()
def surface_figure(surfaces: Mapping[str, Surface]) -> Figure:
    """Draw mean IoU over q and f, each at its best s, with a frame around the best setting."""
    figure, panels = _panels(len(surfaces), 3.9)
    best_s = {title: surface.mean_iou.max(axis=2) for title, surface in surfaces.items()}
    limits = min(v.min() for v in best_s.values()), max(v.max() for v in best_s.values())
    for axes, (title, surface) in zip(panels, surfaces.items(), strict=True):
        _draw_surface(axes, best_s[title], *limits)
        grid = surface.grid
        axes.set(xlabel='q', xticks=range(len(grid.q)), xticklabels=[f'{q:g}' for q in grid.q])
        axes.set(ylabel='f', yticks=range(len(grid.f)), yticklabels=[f'{f:g}' for f in grid.f])
        q, f, s = surface.best()
        axes.set_title(f'{title}: best q {q:g}, f {f:g}, s {s:g}', fontsize=10)
    return figure


def _draw_surface(axes: Any, values: FloatArray, low: float, high: float) -> None:
    """Draw one surface, (Q, F), with its numbers; the colours run from `low` to `high`."""
    axes.grid(visible=False)
    axes.imshow(values.T, origin='lower', aspect='auto', cmap='YlGnBu', vmin=low, vmax=high)
    for (i, j), value in np.ndenumerate(values):
        color = 'white' if value > (low + high) / 2.0 else 'black'
        axes.text(i, j, f'{value:.3f}', ha='center', va='center', color=color, fontsize=8)
    i, j = np.unravel_index(int(np.argmax(values)), values.shape)
    _add_box(axes, np.array([i - 0.5, j - 0.5, i + 0.5, j + 0.5]), _BEST, 2.5)


@_styled()
def error_figure(errors: Mapping[str, Mapping[str, FloatArray]]) -> Figure:
    """Draw the lowest relative errors by method and family, one for each level of `FULLNESS`."""
    figure, panels = _panels(len(errors), 3.4, sharey=True)
    for axes, (method, families) in zip(panels, errors.items(), strict=True):
        for index, (full, shade) in enumerate(zip(FULLNESS, _SHADES, strict=True)):
            x = np.arange(len(families)) + (index - 1.5) * 0.2
            heights = [values[index] for values in families.values()]
            axes.bar(x, heights, 0.18, color=shade, label=f'fullness {full:.2f}')
        axes.set(xticks=range(len(families)), xticklabels=list(families), title=method)
    panels[0].set_ylabel('mean relative error')
    panels[0].legend(frameon=False, fontsize=8)
    return figure


@_styled()
def sensitivity_figure(f: FloatArray, curves: Mapping[str, Mapping[str, FloatArray]]) -> Figure:
    """Draw mean IoU over K values of f, (K,) for each panel and line, and mark the best f."""
    figure, panels = _panels(len(curves), 3.8)
    for axes, (title, lines) in zip(panels, curves.items(), strict=True):
        for color, (name, values) in zip(_LINES, lines.items(), strict=False):
            best = int(np.argmax(values))
            label = f'{name}: best f {f[best]:.2f}'
            axes.plot(f, values, color=color, label=label)
            axes.plot(f[best], values[best], 'o', color=color)
        axes.set(xlabel='f', ylabel='mean IoU', title=title)
        axes.legend(frameon=False, fontsize=8)
    return figure


@_styled()
def hull_panel() -> Figure:
    """Draw the synthetic hulls, one row per fullness, with their oriented and reference boxes."""
    angle, aspect = np.radians(25.0), 4.0
    turn = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * [1.0, 1.0 / aspect] @ turn
    figure = Figure(figsize=(10.0, 6.6), layout='constrained')
    grid = figure.subplots(len(FULLNESS), len(FAMILIES))
    for row, full in zip(grid, FULLNESS, strict=True):
        for axes, family in zip(row, FAMILIES.values(), strict=True):
            hull = family.outline(full) * [1.0, 1.0 / aspect] @ turn
            axes.add_patch(patches.Polygon(hull, facecolor=_HULL, edgecolor=_HULL_EDGE))
            _add_oriented_box(axes, corners)
            _add_box(axes, bounds(hull), METHOD_COLORS['superellipse'], 2.0)
            axes.set(xlim=(-1.2, 1.2), ylim=(0.8, -0.8), xticks=[], yticks=[], aspect='equal')
            axes.set_title(f'{family.name} {full:.2f}', fontsize=9)
            axes.axis('off')
    figure.suptitle('Synthetic hulls, their oriented box (dashed) and reference box (green)')
    return figure


def scene_figure(labels: ImageLabels, boxes: Mapping[str, FloatArray]) -> Figure:
    """Draw the N ships of an image and the boxes, (N, 4), of each method, with some close-ups."""
    figure = Figure(figsize=(17.0, 7.6), layout='constrained')
    halves: Any = figure.subfigures(1, 2, width_ratios=(1.15, 1.0))
    whole, details = halves
    axes = whole.subplots()
    shown = {name: boxes[name] for name in ('outer', 'superellipse') if name in boxes}
    _draw_ships(axes, labels, shown, range(len(labels.class_ids)))
    axes.set_title(f'{labels.image}: oriented boxes (dashed), hulls, {" and ".join(shown)}')
    axes.set(xlabel='px', ylabel='px')
    if labels.size:
        axes.set(xlim=(0, labels.size[0]), ylim=(labels.size[1], 0))
    oriented = OrientedBoxes.from_corners(labels.corners)
    panels = details.subplots(2, _CLOSE_UPS // 2).ravel()
    for panel, row in zip(panels, _typical(oriented), strict=False):
        _draw_ships(panel, labels, boxes, [row])
        low, high = labels.corners[row].min(axis=0), labels.corners[row].max(axis=0)
        (x, y), reach = (low + high) / 2.0, 0.68 * (high - low).max()
        panel.set(xlim=(x - reach, x + reach), ylim=(y + reach, y - reach), xticks=[], yticks=[])
        _add_scale(panel, x - 0.92 * reach, y + 0.88 * reach, reach)
        degrees = np.degrees(oriented.theta[row])
        panel.set_title(f'{labels.class_ids[row]} {labels.ids[row]}, {degrees:.0f}°')
    handles = [
        patches.Patch(facecolor=_HULL, label='hull'),
        *_handles_of(boxes),
    ]
    _add_legend_below(figure, 0.08, handles, ncol=5)
    return figure


def _handles_of(methods: Iterable[str]) -> list[Line2D]:
    """Return the lines of a legend: oriented box and methods."""
    return [
        Line2D([], [], color=ORIENTED_COLOR, ls=_DASHES, label='oriented box'),
        *(
            Line2D([], [], color=color_of(name), ls=_dashes_of(name), label=name)
            for name in methods
        ),
    ]


def _add_scale(axes: Any, x: float, y: float, longest: float) -> None:
    """Draw a bar from (x, y) to the right, of a round number of pixels up to the longest."""
    power = 10.0 ** np.floor(np.log10(longest))
    length = max(power * step for step in (1.0, 2.0, 5.0) if power * step <= longest)
    axes.plot((x, x + length), (y, y), color='black', lw=2.0, solid_capstyle='butt')
    axes.annotate(f'{length:g} px', (x, y), (0, 3), textcoords='offset points', fontsize=9)


def _typical(oriented: OrientedBoxes) -> list[int]:
    """Choose ships from upright to diagonal, the longest of each band of tilt."""
    tilt = np.abs(np.mod(oriented.theta + np.pi / 4, np.pi / 2) - np.pi / 4)
    band = np.minimum((tilt / (np.pi / 4) * _CLOSE_UPS).astype(int), _CLOSE_UPS - 1)
    members = [np.flatnonzero(band == index) for index in range(_CLOSE_UPS)]
    return [int(rows[np.argmax(oriented.length[rows])]) for rows in members if rows.size]


def _draw_ships(
    axes: Any, labels: ImageLabels, boxes: Mapping[str, FloatArray], rows: Iterable[int]
) -> None:
    """Draw hulls, oriented boxes and axis-aligned boxes of some rows."""
    # Each line is thinner than the one below it, so that equal boxes are all visible.
    widths = np.linspace(0.5 * len(boxes), 1.0, len(boxes))
    axes.set_facecolor(_SEA)
    axes.set_aspect('equal')
    for row in rows:
        hull = labels.hulls[row]
        if hull is not None:
            axes.add_patch(patches.Polygon(hull, facecolor=_HULL, edgecolor='none'))
        _add_oriented_box(axes, labels.corners[row])
        for width, (name, xyxy) in zip(widths, boxes.items(), strict=True):
            _add_box(axes, xyxy[row], color_of(name), width, _dashes_of(name))


def ship_figure(
    labels: ImageLabels, pixels: NDArray[Any], boxes: Mapping[str, FloatArray], row: int
) -> Figure:
    """Draw a ship on its image, (H, W, C), with its oriented box and the boxes of all methods."""
    points = np.concatenate(
        [labels.corners[row], *(xyxy[row].reshape(2, 2) for xyxy in boxes.values())]
    )
    margin = _MARGIN * np.ptp(points, axis=0).max()
    low, high = points.min(axis=0) - margin, points.max(axis=0) + margin
    (x0, y0), (x1, y1) = (
        np.clip(edge, 0, pixels.shape[1::-1]).astype(int) for edge in (np.floor(low), np.ceil(high))
    )
    figure = Figure(figsize=(6.4, 7.2), layout='constrained')
    axes = figure.subplots()
    gray: Any = {'cmap': 'gray', 'vmin': 0, 'vmax': 255} if pixels.shape[2] == 1 else {}
    shown, step = _shrunk(pixels[y0:y1, x0:x1])
    rows, columns = shown.shape[:2]
    extent = (x0, x0 + step * columns, y0 + step * rows, y0)
    axes.imshow(shown, extent=extent, **gray)
    axes.set(xlim=(low[0], high[0]), ylim=(high[1], low[1]), xticks=[], yticks=[])
    # The dashes are black.
    axes.add_patch(patches.Polygon(labels.corners[row], fill=False, ec='white', lw=2.0))
    _add_oriented_box(axes, labels.corners[row])
    widths = np.linspace(0.5 * len(boxes), 1.0, len(boxes))
    for width, (name, xyxy) in zip(widths, boxes.items(), strict=True):
        _add_box(axes, xyxy[row], color_of(name), width, _dashes_of(name))
    name = labels.ids[row] or str(row + 1)
    axes.set_title(f'{labels.image}: {labels.class_ids[row]} {name}')
    _add_legend_below(figure, 0.12, _handles_of(boxes), ncol=3, fontsize=8)
    return figure


def _shrunk(pixels: NDArray[Any]) -> tuple[NDArray[Any], int]:
    """Average pixels, (H, W, C), in squares that are small in the figure; and return their side."""
    step = max(1, max(pixels.shape[:2]) // _MAX_SIDE)
    if step == 1:
        return pixels, 1
    picture = Image.fromarray(pixels[..., 0] if pixels.shape[2] == 1 else pixels)
    return np.atleast_3d(np.asarray(picture.reduce(step))), step


def cost_figure(
    costs: Mapping[str, Cost], labels: ImageLabels, pixels: NDArray[Any], title: str
) -> Figure:
    """
    Draw an image, (H, W, C), with its boxes, and the cost of chips relative to the outer boxes.

    The title says where the data come from.
    """
    figure = Figure(figsize=(15.0, 5.6), layout='constrained')
    scene, bars = figure.subplots(1, 2, width_ratios=(1.1, 1.0))
    scene.imshow(pixels, cmap='gray' if pixels.shape[2] == 1 else None)
    scene.set(title=title, xticks=[], yticks=[])
    boxes = OrientedBoxes.from_corners(labels.corners)
    for name in ('outer', 'superellipse'):
        for xyxy in convert_by_rule(boxes, RULES[name]):
            _add_box(scene, xyxy, color_of(name), 1.3)
    outer = costs['outer']
    for index, (name, cost) in enumerate(costs.items()):
        values = [cost.pixels / outer.pixels]
        values += [cost.sizes[codec] / outer.sizes[codec] for codec in ENCODERS]
        lost = f', {cost.hull_lost / cost.hull:.1%} of the hulls lost' if cost.hull else ''
        x = np.arange(len(values)) + 0.27 * (index - 1)
        drawn = bars.bar(x, values, 0.25, color=color_of(name), label=name + lost)
        bars.bar_label(drawn, [f'{value:.0%}' for value in values], fontsize=8)
    bars.set_xticks(range(1 + len(ENCODERS)), ['pixels', *ENCODERS])
    bars.set(title='cost of the chips', ylabel='relative to the outer boxes', ylim=(0.0, 1.25))
    bars.legend(loc='upper center', ncols=1, frameon=False)
    return figure
