# SPDX-License-Identifier: Apache-2.0
"""Texts beside boxes: what they say, how large they are, and where there is room for them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from dataclasses import replace
from functools import lru_cache
from typing import Any
from typing import TypeAlias

import numpy as np

from obbhbb_ros.geometry.boxes import FloatArray
from obbhbb_ros.overlay.outlines import finite

# Scores from here on are written with an exponent.
_MAX_PLAIN_SCORE = 1000.0
# Labels that are tried; no picture has room for that many.
_MAX_LABELS = 2000
_MAX_TEXT_LENGTH = 24
_MAX_CACHED_TEXTS = 256
# A legend that needs more of a side of the picture is left out.
_MAX_LEGEND_SHARE = 1.0 / 3.0

Size: TypeAlias = tuple[int, int]
"""Width and height, pixels."""


@dataclass(frozen=True)
class Labels:
    """
    Texts beside boxes.

    Attributes
    ----------
    color : str
        Of the background, '#rrggbb'.
    corners : ndarray, shape (N, 4, 2)
        Of the boxes, as in `Layer`.
    texts : sequence of str
        N texts; an empty one is not written.
    scores : ndarray, shape (N,)
        If there is not room for all texts, those of the best scores are written.
    """

    color: str
    corners: FloatArray
    texts: Sequence[str]
    scores: FloatArray

    def scaled(self, factor: FloatArray) -> Labels:
        """Return the labels in pixels of a picture that is larger or smaller by a factor."""
        return replace(self, corners=self.corners * factor)


@dataclass(frozen=True)
class PlacedLabel:
    """
    A text that has room.

    Attributes
    ----------
    text : str
        The text.
    mask : PIL.Image.Image
        What `text_mask` makes of it.
    corner : tuple of int
        x and y of its upper left corner, pixels of the picture.
    """

    text: str
    mask: Any
    corner: tuple[int, int]


def label_text(class_id: str, score: float) -> str:
    """
    Write class and score in one short line; an empty class or a NaN score is left out.

    Examples
    --------
    >>> label_text('tanker', 0.876), label_text('', 0.5), label_text('tanker', float('nan'))
    ('tanker 0.88', '0.50', 'tanker')
    >>> label_text('', 1e308)
    '1e+308'
    """
    shown = ''.join(c if c.isprintable() else '?' for c in class_id[: _MAX_TEXT_LENGTH + 1])
    if len(shown) > _MAX_TEXT_LENGTH:
        shown = shown[: _MAX_TEXT_LENGTH - 1] + '…'
    number = f'{score:.2f}' if abs(score) < _MAX_PLAIN_SCORE else f'{score:.3g}'
    return ' '.join(filter(None, (shown, '' if math.isnan(score) else number)))


def has_room_for_legend(legend: Size, picture: Size) -> bool:
    """Return whether a legend leaves enough of a picture to see."""
    return all(
        side <= _MAX_LEGEND_SHARE * whole for side, whole in zip(legend, picture, strict=True)
    )


def place_labels(
    labels: Labels, size: Size, text_size: int, gap: int, covered: FloatArray
) -> tuple[list[PlacedLabel], int]:
    """
    Find places for labels, those of the best scores first.

    Parameters
    ----------
    labels : Labels
        The labels, in pixels of the picture.
    size : tuple of int
        Width and height of the picture.
    text_size : int
        Size of the font, pixels.
    gap : int
        Pixels between a box and its label.
    covered : ndarray, shape (K, 4)
        Left, top, right and bottom of places that are taken already.

    Returns
    -------
    list of PlacedLabel
        The labels that have room.
    int
        How many have none.
    """
    low, high = labels.corners.min(axis=1), labels.corners.max(axis=1)
    visible = finite(labels.corners) & ((high > 0.0) & (low < size)).all(axis=1)
    # A label must hide neither another one nor the middle of a box.
    middles = (low[visible] + high[visible]) / 2.0
    order = np.argsort(-np.nan_to_num(labels.scores), kind='stable')
    rows = [row for row in order.tolist() if visible[row] and labels.texts[row]]
    taken = np.concatenate((np.hstack((middles, middles)), covered, np.zeros((len(rows), 4))))
    first = len(middles) + len(covered)
    placed: list[PlacedLabel] = []
    for row in rows[:_MAX_LABELS]:
        mask = text_mask(labels.texts[row], text_size)
        count = first + len(placed)
        corner = _place(mask.size, low[row] - gap, high[row] + gap, size, taken[:count])
        if corner is not None:
            taken[count] = *corner, corner[0] + mask.width, corner[1] + mask.height
            placed.append(PlacedLabel(labels.texts[row], mask, corner))
    return placed, len(rows) - len(placed)


def _place(
    text: Size, low: FloatArray, high: FloatArray, size: Size, taken: FloatArray
) -> tuple[int, int] | None:
    """Find room above or below a box, inside the picture and clear of `taken`, (K, 4)."""
    width, height = text
    left, top, right, bottom = taken.T
    x = int(min(max(low[0], 0.0), max(size[0] - width, 0)))
    for preferred in (int(low[1]) - height, int(high[1]) + 1):
        y = min(max(preferred, 0), max(size[1] - height, 0))
        covers = (left < x + width) & (right > x) & (top < y + height) & (bottom > y)
        if not covers.any():
            return x, y
    return None


@lru_cache(maxsize=_MAX_CACHED_TEXTS)
def text_mask(text: str, size: int) -> Any:
    """Write a text with a margin, as a Pillow image of mode L: 255 where there is ink."""
    from PIL import Image
    from PIL import ImageDraw

    font = _font(size)
    margin = max(1, size // 6)
    ascent, descent = font.getmetrics()
    width = math.ceil(font.getlength(text)) + 2 * margin
    mask = Image.new('L', (width, ascent + descent + margin // 2))
    ImageDraw.Draw(mask).text((margin, 0), text, 255, font)
    return mask


@lru_cache(maxsize=8)
def _font(size: int) -> Any:
    """Load the font that comes with Pillow."""
    from PIL import ImageFont

    return ImageFont.load_default(size)
