# SPDX-License-Identifier: Apache-2.0
"""Figures of numbers: angle bands, calibration surfaces, hull forms. Needs the extra `plots`."""

from __future__ import annotations

import io
from collections.abc import Mapping
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING
from typing import Any

import numpy as np

from obbhbb_ros.boxes import FloatArray
from obbhbb_ros.files import replacing
from obbhbb_ros.study.calibration import Surface
from obbhbb_ros.study.evaluation import TILT_BANDS
from obbhbb_ros.study.evaluation import Score
from obbhbb_ros.study.evaluation import tilt_band
from obbhbb_ros.study.hulls import FAMILIES
from obbhbb_ros.study.hulls import FULLNESS
from obbhbb_ros.study.metrics import PROTOCOLS
from obbhbb_ros.study.plots import COLORS

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_MARKERS = 'o^s*Dv<>'
_STYLE = {
    'axes.spines.right': False, 'axes.spines.top': False, 'axes.grid': True, 'grid.alpha': 0.25,
    'font.size': 10.0, 'svg.fonttype': 'none', 'svg.hashsalt': 'obbhbb',
}


def _figure(width: float, height: float) -> Figure:
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), layout='constrained')


def _styled() -> Any:
    import matplotlib as mpl

    return mpl.rc_context(_STYLE)


def angle_figure(scores: Sequence[Score]) -> Figure:
    """
    Draw mean IoU over the bands of tilt, as the paper's angle-stratified figures do.

    Parameters
    ----------
    scores : sequence of Score
        What `evaluate` gives.

    Returns
    -------
    Figure
        A panel a protocol, a line a method, 95 % intervals where there are any.
    """
    protocols = list(dict.fromkeys(score.protocol for score in scores))
    bands = [tilt_band(*band) for band in TILT_BANDS]
    with _styled():
        figure = _figure(5.6 * len(protocols), 4.6)
        panels = figure.subplots(1, len(protocols), squeeze=False)[0]
        for axes, protocol in zip(panels, protocols, strict=True):
            _draw_bands(axes, [score for score in scores if score.protocol == protocol], bands)
            axes.set_title(f'protocol {protocol}: {PROTOCOLS[protocol]}', fontsize=10)
        handles, names = panels[0].get_legend_handles_labels()
        # Room below for the legend; 'outside' places are not known to matplotlib 3.6.
        figure.set_layout_engine('constrained', rect=(0.0, 0.13, 1.0, 0.87))
        figure.legend(handles, names, loc='lower center', ncol=4, frameon=False)
    return figure


def _draw_bands(axes: Any, scores: Sequence[Score], bands: Sequence[str]) -> None:
    """Draw one protocol."""
    for index, method in enumerate(dict.fromkeys(score.method for score in scores)):
        found = {s.stratum: s for s in scores if s.method == method and s.stratum in bands}
        x = [i for i, band in enumerate(bands) if band in found]
        mine = [found[bands[i]] for i in x]
        y = np.array([score.iou for score in mine])
        spread = np.array([[s.iou - s.iou_low, s.iou_high - s.iou] for s in mine]).reshape(-1, 2)
        axes.errorbar(
            x, y, np.nan_to_num(spread).clip(0.0).T, label=method,
            color=COLORS.get(method, 'black'), marker=_MARKERS[index % len(_MARKERS)],
            lw=2.2 if method == 'superellipse' else 1.4, capsize=2,
            ls='--' if method.endswith('published') else '-',
        )
    axes.set(
        xticks=range(len(bands)), xticklabels=bands, xlim=(-0.25, len(bands) - 0.75),
        ylim=(0.0, 1.0), ylabel='mean IoU',
    )


def surface_figure(surfaces: Mapping[str, Surface]) -> Figure:
    """
    Draw mean IoU over q and f, each at its best s.

    Parameters
    ----------
    surfaces : mapping of str to Surface
        By title.

    Returns
    -------
    Figure
        A panel each, the best setting framed.
    """
    with _styled():
        figure = _figure(5.6 * len(surfaces), 3.9)
        panels = figure.subplots(1, len(surfaces), squeeze=False)[0]
        low = min(s.mean_iou.max(axis=2).min() for s in surfaces.values())
        high = max(s.mean_iou.max() for s in surfaces.values())
        for axes, (title, surface) in zip(panels, surfaces.items(), strict=True):
            _draw_surface(axes, surface, low, high)
            q, f, s = surface.best()
            axes.set_title(f'{title}: best q {q:g}, f {f:g}, s {s:g}', fontsize=10)
    return figure


def _draw_surface(axes: Any, surface: Surface, low: float, high: float) -> None:
    """Draw one surface, with its numbers."""
    from matplotlib.patches import Rectangle

    values = surface.mean_iou.max(axis=2)
    axes.grid(visible=False)
    axes.imshow(values.T, origin='lower', aspect='auto', cmap='YlGnBu', vmin=low, vmax=high)
    grid = surface.grid
    middle = (low + high) / 2.0
    for (i, j), value in np.ndenumerate(values):
        color = 'white' if value > middle else 'black'
        axes.text(i, j, f'{value:.3f}', ha='center', va='center', color=color, fontsize=8)
    i, j = np.unravel_index(int(np.argmax(values)), values.shape)
    frame = Rectangle((i - 0.5, j - 0.5), 1, 1, fill=False, edgecolor='#d03b2a', lw=2.5)
    axes.add_patch(frame)
    axes.set(
        xticks=range(len(grid.q)), xticklabels=[f'{q:g}' for q in grid.q], xlabel='q',
        yticks=range(len(grid.f)), yticklabels=[f'{f:g}' for f in grid.f], ylabel='f',
    )


def error_figure(errors: Mapping[str, Mapping[str, FloatArray]]) -> Figure:
    """
    Draw the best relative error by family and fullness.

    Parameters
    ----------
    errors : mapping of str to mapping of str to ndarray
        By method and family, one error for each level of `FULLNESS`.

    Returns
    -------
    Figure
        A panel a method.
    """
    with _styled():
        figure = _figure(5.6 * len(errors), 3.4)
        panels = figure.subplots(1, len(errors), squeeze=False, sharey=True)[0]
        shades = ['#9ecae1', '#6baed6', '#3182bd', '#08519c']
        for axes, (method, families) in zip(panels, errors.items(), strict=True):
            table = np.array(list(families.values()))
            for index, (full, shade) in enumerate(zip(FULLNESS, shades, strict=True)):
                x = np.arange(len(families)) + (index - 1.5) * 0.2
                axes.bar(x, table[:, index], 0.18, color=shade, label=f'fullness {full:.2f}')
            axes.set(xticks=range(len(families)), xticklabels=list(families), title=method)
        panels[0].set_ylabel('mean relative error')
        panels[0].legend(frameon=False, fontsize=8)
    return figure


def sensitivity_figure(
    fullness: FloatArray, curves: Mapping[str, Mapping[str, FloatArray]]
) -> Figure:
    """
    Draw mean IoU over f for narrow and wide hulls.

    Parameters
    ----------
    fullness : ndarray, shape (K,)
        Values of f.
    curves : mapping of str to mapping of str to ndarray of shape (K,)
        By panel and line.

    Returns
    -------
    Figure
        The best f of each line marked.
    """
    with _styled():
        figure = _figure(5.6 * len(curves), 3.8)
        panels = figure.subplots(1, len(curves), squeeze=False)[0]
        colors = ['#1f5fbf', '#0b7d3e', '#e08a00', '#b0389b', '#5f6a72']
        for axes, (title, lines) in zip(panels, curves.items(), strict=True):
            for color, (name, values) in zip(colors, lines.items(), strict=False):
                best = int(np.argmax(values))
                label = f'{name}: best f {fullness[best]:.2f}'
                axes.plot(fullness, values, color=color, label=label)
                axes.plot(fullness[best], values[best], 'o', color=color)
            axes.set(xlabel='f', ylabel='mean IoU', title=title)
            axes.legend(frameon=False, fontsize=8)
    return figure


def hull_panel() -> Figure:
    """
    Draw the synthetic families at each fullness, with oriented and axis-aligned reference box.

    Returns
    -------
    Figure
        A row a fullness, a column a family.
    """
    from matplotlib.patches import Polygon
    from matplotlib.patches import Rectangle

    angle, aspect = np.radians(25.0), 4.0
    turn = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * [1.0, 1.0 / aspect] @ turn
    with _styled():
        figure = _figure(10.0, 6.6)
        grid = figure.subplots(len(FULLNESS), len(FAMILIES))
        for row, full in zip(grid, FULLNESS, strict=True):
            for axes, family in zip(row, FAMILIES.values(), strict=True):
                hull = family.outline(full) * [1.0, 1.0 / aspect] @ turn
                low, high = hull.min(axis=0), hull.max(axis=0)
                axes.add_patch(Polygon(hull, facecolor='#9aa7ad', edgecolor='#5f6a72'))
                axes.add_patch(Polygon(corners, fill=False, ls=(0, (4, 3))))
                box = Rectangle(tuple(low), *(high - low), fill=False, edgecolor='#0b7d3e', lw=2)
                axes.add_patch(box)
                axes.set(xlim=(-1.2, 1.2), ylim=(0.8, -0.8), xticks=[], yticks=[], aspect='equal')
                axes.set_title(f'{family.name} {full:.2f}', fontsize=9)
                axes.axis('off')
        figure.suptitle('Synthetic hulls, their oriented box (dashed) and reference box (green)')
    return figure


def save(figure: Figure, path: Path) -> None:
    """
    Write a figure to a picture file, its folder made where there is none.

    Parameters
    ----------
    figure : Figure
        The figure.
    path : Path
        Picture file; the suffix tells the format.
    """
    with _styled(), replacing(path) as whole:
        figure.savefig(whole, dpi=120, format=path.suffix[1:] or 'png')


def svg(figure: Figure) -> str:
    """
    Write a figure as an `<svg>` element for a page.

    Parameters
    ----------
    figure : Figure
        The figure.

    Returns
    -------
    str
        The element, without the XML declaration a file would have.
    """
    file = io.StringIO()
    with _styled():
        figure.savefig(file, format='svg', metadata={'Date': None})
    text = file.getvalue()
    return text[text.index('<svg'):]
