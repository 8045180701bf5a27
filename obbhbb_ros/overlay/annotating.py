# SPDX-License-Identifier: Apache-2.0
"""
Boxes, labels and legend as lines and texts over an image, for viewers that draw them themselves.

They are those of the picture, in pixels of the full image. The legend is a text for each layer on a
ground of its colour: how wide a viewer's font is nobody knows. No ROS in here.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from obbhbb_ros.overlay.drawing import Layer
from obbhbb_ros.overlay.drawing import Style
from obbhbb_ros.overlay.lettering import Labels
from obbhbb_ros.overlay.lettering import Size
from obbhbb_ros.overlay.lettering import has_room_for_legend
from obbhbb_ros.overlay.lettering import place_labels
from obbhbb_ros.overlay.lettering import text_mask
from obbhbb_ros.overlay.outlines import ink_on
from obbhbb_ros.overlay.outlines import rgb
from obbhbb_ros.overlay.outlines import visible_strokes
from obbhbb_ros.wire.image_annotations import Caption
from obbhbb_ros.wire.image_annotations import Stroke


@dataclass(frozen=True)
class Annotations:
    """Lines, the first at the bottom, texts, and the number of labels that had no room."""

    strokes: list[Stroke]
    captions: list[Caption]
    labels_left_out: int


def annotate(
    size: Size, layers: Sequence[Layer], labels: Labels | None, style: Style
) -> Annotations:
    """
    List lines and texts over an image.

    Parameters
    ----------
    size : tuple of int
        Width and height of the image.
    layers : sequence of Layer
        The boxes, the first below the others. Each has lines, if only lines without points, so that
        the annotations of an image without boxes have its stamp.
    labels : Labels, optional
        The texts beside boxes.
    style : Style
        How to draw; its scale is that of the picture, and does not count here.
    """
    width, text_size = style.line_width_for(size), style.text_size_for(size)
    strokes = [
        Stroke(*stroke)
        for layer in layers
        for stroke in visible_strokes(layer.corners, layer.pen(width), size)
    ]
    captions = _legend(size, layers, text_size) if style.legend else []
    if labels is None or not style.labels:
        return Annotations(strokes, captions, 0)
    covered = np.array([_place_of(caption) for caption in captions]).reshape(-1, 4)
    placed, left_out = place_labels(labels, size, text_size, width, covered)
    ground = rgb(labels.color)
    for label in placed:
        corner = float(label.corner[0]), float(label.corner[1] + label.mask.height)
        captions.append(Caption(label.text, corner, text_size, ink_on(ground), ground))
    return Annotations(strokes, captions, left_out)


def _legend(size: Size, layers: Sequence[Layer], text_size: int) -> list[Caption]:
    """Name the layers in the lower left corner, the upper layers first."""
    titles = [(layer.title, rgb(layer.color)) for layer in layers if layer.title]
    masks = [text_mask(title, text_size) for title, _ in titles]
    row = max((mask.height for mask in masks), default=0) + text_size // 4
    widest = max((mask.width for mask in masks), default=0)
    if not has_room_for_legend((widest, row * len(titles)), size):
        return []
    return [
        Caption(title, (0.0, float(size[1] - number * row)), text_size, ink_on(color), color)
        for number, (title, color) in enumerate(titles)
    ]


def _place_of(caption: Caption) -> tuple[float, float, float, float]:
    """Return left, top, right and bottom of a text, about."""
    mask = text_mask(caption.text, round(caption.size))
    left, bottom = caption.position
    return left, bottom - mask.height, left + mask.width, bottom
