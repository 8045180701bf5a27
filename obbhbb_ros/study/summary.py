# SPDX-License-Identifier: Apache-2.0
"""Tables for the terminal."""

from __future__ import annotations

from collections.abc import Mapping
from collections.abc import Sequence

import numpy as np

from obbhbb_ros.boxes import FloatArray
from obbhbb_ros.labels import ImageLabels
from obbhbb_ros.study.metrics import background_removed
from obbhbb_ros.study.metrics import hull_inside
from obbhbb_ros.study.metrics import iou


def text_table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Align columns: the first to the left, numbers to the right."""
    widths = [max(map(len, column)) for column in zip(head, *rows, strict=True)]
    lines = [list(head), ['-' * width for width in widths], *map(list, rows)]
    return '\n'.join(
        '  '.join(
            cell.rjust(width) if i else cell.ljust(width)
            for i, (cell, width) in enumerate(zip(line, widths, strict=True))
        )
        for line in lines
    )


def scene_table(labels: ImageLabels, boxes: Mapping[str, FloatArray]) -> str:
    """
    Compare the methods' boxes on ships whose hulls are known.

    Parameters
    ----------
    labels : ImageLabels
        N ships with hulls and reference boxes.
    boxes : mapping of str to ndarray of shape (N, 4)
        Axis-aligned boxes by method, `outer` among them, pixels.

    Returns
    -------
    str
        A row a method: mean size, share of the outer boxes' background removed, share of the
        hulls kept, mean IoU with the reference.
    """
    hulls = [hull for hull in labels.hulls if hull is not None]
    hull_area = np.sum(hull_inside(_bounds(hulls), hulls))
    rows = []
    for name, xyxy in boxes.items():
        width, height = np.mean(xyxy[:, 2:] - xyxy[:, :2], axis=0)
        removed = background_removed(xyxy, boxes['outer'], hulls)
        kept = np.sum(hull_inside(xyxy, hulls)) / hull_area
        overlap = np.mean(iou(xyxy, labels.reference))
        rows.append((
            name, f'{width:.1f} x {height:.1f}', f'{removed:.1%}', f'{kept:.1%}', f'{overlap:.3f}'
        ))
    return text_table(
        ('method', 'mean size [px]', 'background removed', 'hull kept', 'IoU with hull bounds'),
        rows,
    )


def _bounds(hulls: Sequence[FloatArray]) -> FloatArray:
    """Give the bounds of each hull, (N, 4)."""
    return np.array([np.concatenate((hull.min(axis=0), hull.max(axis=0))) for hull in hulls])
