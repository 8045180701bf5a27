# SPDX-License-Identifier: Apache-2.0
"""Pictures of boxes and hulls. Needs matplotlib, the extra `plots`."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from obbhbb_ros.boxes import FloatArray
from obbhbb_ros.boxes import OrientedBoxes
from obbhbb_ros.files import replacing
from obbhbb_ros.labels import ImageLabels

COLORS = {
    'superellipse': '#0b7d3e',
    'shape_aware': '#e08a00',
    'outer': '#1f5fbf',
    'midpoint': '#b0389b',
    'gaussian': '#d03b2a',
    'area_equivalent': '#5f6a72',
    'gaussian_published': '#e79a90',
    'area_equivalent_published': '#a9b1b7',
}
_SEA = '#dfe9ee'
_HULL = '#9aa7ad'
_CLOSE_UPS = 6


def draw_scene(labels: ImageLabels, boxes: Mapping[str, FloatArray], path: Path) -> None:
    """
    Draw an image's ships with the boxes of each method, the whole and some close-ups.

    Parameters
    ----------
    labels : ImageLabels
        N ships.
    boxes : mapping of str to ndarray of shape (N, 4)
        Axis-aligned boxes by method, pixels.
    path : Path
        Picture file to write.

    Raises
    ------
    ModuleNotFoundError
        If matplotlib is not installed.
    """
    import matplotlib as mpl
    from matplotlib.figure import Figure

    figure = Figure(figsize=(17.0, 7.6), layout='constrained')
    with mpl.rc_context({'font.size': 10}):
        halves: Any = figure.subfigures(1, 2, width_ratios=(1.15, 1.0))
        whole, details = halves
        axes = whole.subplots()
        shown = {name: boxes[name] for name in ('outer', 'superellipse') if name in boxes}
        _draw_ships(axes, labels, shown, range(len(labels.class_ids)))
        axes.set_title(f'{labels.image}: oriented boxes (dashed), hulls, {" and ".join(shown)}')
        if labels.size:
            axes.set(xlim=(0, labels.size[0]), ylim=(labels.size[1], 0))
        panels = details.subplots(2, _CLOSE_UPS // 2).ravel()
        for panel, row in zip(panels, _typical(labels), strict=False):
            _draw_close_up(panel, labels, boxes, row)
        # Room below for the legend; 'outside' places are not known to matplotlib 3.6.
        figure.set_layout_engine('constrained', rect=(0.0, 0.08, 1.0, 0.92))
        figure.legend(handles=_legend(boxes), loc='lower center', ncol=5)
    with replacing(path) as whole:
        figure.savefig(whole, dpi=100, format=path.suffix[1:] or 'png')


def _typical(labels: ImageLabels) -> list[int]:
    """Choose ships from upright to diagonal, the longest of each band of tilt."""
    oriented = OrientedBoxes.from_corners(labels.corners)
    tilt = np.abs(np.mod(oriented.theta + np.pi / 4, np.pi / 2) - np.pi / 4)
    band = np.minimum((tilt / (np.pi / 4) * _CLOSE_UPS).astype(int), _CLOSE_UPS - 1)
    chosen = []
    for index in range(_CLOSE_UPS):
        members = np.flatnonzero(band == index)
        if members.size:
            chosen.append(int(members[np.argmax(oriented.length[members])]))
    return chosen


def _draw_close_up(
    axes: Any, labels: ImageLabels, boxes: Mapping[str, FloatArray], row: int
) -> None:
    """Draw one ship with all its boxes."""
    _draw_ships(axes, labels, boxes, [row])
    low, high = labels.corners[row].min(axis=0), labels.corners[row].max(axis=0)
    center, reach = (low + high) / 2.0, 0.62 * (high - low).max()
    axes.set(
        xlim=(center[0] - reach, center[0] + reach),
        ylim=(center[1] + reach, center[1] - reach),
        xticks=[], yticks=[],
    )
    theta = OrientedBoxes.from_corners(labels.corners[row : row + 1]).theta[0]
    axes.set_title(f'{labels.class_ids[row]} {labels.ids[row]}, {np.degrees(theta):.0f}°')


def _draw_ships(
    axes: Any, labels: ImageLabels, boxes: Mapping[str, FloatArray], rows: Any
) -> None:
    """Draw hulls, oriented boxes and axis-aligned boxes of some rows."""
    from matplotlib.patches import Polygon
    from matplotlib.patches import Rectangle

    # Each line is thinner than the one before, so that boxes that agree are all seen.
    widths = np.linspace(0.5 * len(boxes), 1.0, len(boxes))
    axes.set_facecolor(_SEA)
    axes.set_aspect('equal')
    for row in rows:
        hull = labels.hulls[row]
        if hull is not None:
            axes.add_patch(Polygon(hull, facecolor=_HULL, edgecolor='none'))
        axes.add_patch(
            Polygon(labels.corners[row], fill=False, edgecolor='black', lw=1.0, ls=(0, (4, 3)))
        )
        for width, (name, xyxy) in zip(widths, boxes.items(), strict=True):
            x0, y0, x1, y1 = xyxy[row]
            style = {'edgecolor': COLORS[name], 'lw': width, 'fill': False}
            axes.add_patch(Rectangle((x0, y0), x1 - x0, y1 - y0, **style))


def _legend(boxes: Mapping[str, FloatArray]) -> list[Any]:
    """Name what was drawn."""
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    handles: list[Any] = [Patch(facecolor=_HULL, label='hull')]
    handles.append(Line2D([], [], color='black', ls=(0, (4, 3)), label='oriented box'))
    handles += [Line2D([], [], color=COLORS[name], label=name) for name in boxes]
    return handles
