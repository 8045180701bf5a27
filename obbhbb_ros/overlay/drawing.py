# SPDX-License-Identifier: Apache-2.0
"""
Drawing of boxes and labels over an image: arrays in, JPEG out. No ROS in here.

Lines and text scale with the picture. Boxes have a rim and labels a background, so that they stand
out from sea, quay and snow; a legend names the layers. Drawing requires Pillow.
"""

from __future__ import annotations

import io
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from obbhbb_ros.downlink.chips import ENCODINGS
from obbhbb_ros.downlink.chips import PIXEL_FORMATS
from obbhbb_ros.downlink.chips import ChipError
from obbhbb_ros.downlink.chips import ImageView
from obbhbb_ros.downlink.chips import to_8_bits
from obbhbb_ros.downlink.chips import view_of
from obbhbb_ros.errors import ObbhbbError
from obbhbb_ros.geometry.boxes import FloatArray
from obbhbb_ros.limits import CheckedSettings
from obbhbb_ros.limits import Range
from obbhbb_ros.limits import setting
from obbhbb_ros.overlay.lettering import Labels
from obbhbb_ros.overlay.lettering import Size
from obbhbb_ros.overlay.lettering import has_room_for_legend
from obbhbb_ros.overlay.lettering import place_labels
from obbhbb_ros.overlay.lettering import text_mask
from obbhbb_ros.overlay.outlines import Pen
from obbhbb_ros.overlay.outlines import finite
from obbhbb_ros.overlay.outlines import ink_on
from obbhbb_ros.overlay.outlines import outline
from obbhbb_ros.overlay.outlines import rgb
from obbhbb_ros.wire.image import WireImage

# Ratios of the picture's mean side to line width and text size: legible with the whole picture on
# one screen.
_SIDES_PER_LINE = 550.0
_SIDES_PER_TEXT = 64.0
_MIN_TEXT_SIZE = 10
# Maximum side of a JPEG, pixels.
_MAX_SIDE = 65_500
_LEGEND_GROUND, _LEGEND_INK = (16, 28, 36), (255, 255, 255)
_NOWHERE = np.empty((0, 4))
# Pillow's names of pixels in memory.
_RAW_MODES = {'rgb8': 'RGB', 'bgr8': 'BGR', 'rgba8': 'RGBX', 'bgra8': 'BGRX'}


class OverlayError(ObbhbbError, ValueError):
    """No picture can be drawn of an image; the message says why."""


@dataclass(frozen=True)
class Style(CheckedSettings):
    """How a picture is drawn; ValueError if a value is out of range."""

    scale: float = setting(
        1.0,
        'Size of the picture relative to the image; a small one suits a slow link.',
        Range(0.01, 1.0),
    )
    quality: int = setting(80, 'JPEG quality of the picture.', Range(1, 100))
    line_width: int = setting(
        0, 'Line width, pixels of the picture. 0: suited to its size.', Range(0, 1000)
    )
    text_size: int = setting(
        0, 'Text size, pixels of the picture. 0: suited to its size.', Range(0, 500)
    )
    labels: bool = setting(
        True, 'Write class and score beside the detections, best score first, where there is room.'
    )

    legend: bool = setting(
        True, 'Name the layers in the lower left corner, where the picture is large enough.'
    )

    def line_width_for(self, size: Size) -> int:
        """Return the line width of a picture of `size`, pixels."""
        return self.line_width or max(1, round(math.sqrt(size[0] * size[1]) / _SIDES_PER_LINE))

    def text_size_for(self, size: Size) -> int:
        """Return the text size of a picture of `size`, pixels."""
        suitable = round(math.sqrt(size[0] * size[1]) / _SIDES_PER_TEXT)
        return self.text_size or max(_MIN_TEXT_SIZE, suitable)


@dataclass(frozen=True)
class Layer:
    """
    Boxes of one kind.

    Attributes
    ----------
    color : str
        '#rrggbb'.
    corners : ndarray, shape (N, 4, 2)
        Corners in order around each box, pixels of the image. Boxes with a NaN or
        infinite corner are not drawn.
    title : str
        Name in the legend; without one, the layer is not in it.
    dashed : bool
        Whether the lines are dashed.
    """

    color: str
    corners: FloatArray
    title: str = ''
    dashed: bool = False

    def pen(self, width: int) -> Pen:
        """Return what the layer is drawn with, given the width of its lines."""
        return Pen(rgb(self.color), width, self.dashed)


@dataclass(frozen=True)
class Picture:
    """A JPEG file, and the number of labels for which it had no room."""

    data: bytes
    labels_left_out: int


def lines(corners: FloatArray) -> FloatArray:
    """
    List the edges of boxes.

    Parameters
    ----------
    corners : ndarray, shape (N, 4, 2)
        Corners in order around each box.

    Returns
    -------
    ndarray, shape (4 K, 2, 2)
        Both ends of all edges of the K boxes that are finite.
    """
    drawn = corners[finite(corners)]
    return np.stack((drawn, np.roll(drawn, -1, axis=1)), axis=2).reshape(-1, 2, 2)


def draw(image: WireImage, layers: Sequence[Layer], labels: Labels | None, style: Style) -> Picture:
    """
    Draw boxes and texts over an image.

    Parameters
    ----------
    image : WireImage
        The image, with an encoding of `obbhbb_ros.downlink.chips.ENCODINGS`. 16 bits are
        stretched by `to_8_bits`; a Bayer mosaic is shown as grey.
    layers : sequence of Layer
        The boxes, the first below the others.
    labels : Labels, optional
        The texts.
    style : Style
        How to draw.

    Returns
    -------
    Picture
        The file.

    Raises
    ------
    OverlayError
        If the image has another encoding, its size and data do not match, or it is too large for a
        JPEG.
    """
    from PIL import ImageDraw

    picture = picture_of(image, style.scale)
    # Rounded, the picture may differ from the image times the scale by half a pixel.
    factor = np.array(picture.size) / (image.width, image.height)
    canvas = ImageDraw.Draw(picture)
    width = style.line_width_for(picture.size)
    for layer in layers:
        outline(canvas, layer.corners * factor, layer.pen(width))
    taken = _explain(canvas, layers, style) if style.legend else _NOWHERE
    left_out = 0
    if labels is not None and style.labels:
        left_out = _write(canvas, labels.scaled(factor), style, taken)
    file = io.BytesIO()
    try:
        # Thin lines are mostly colour, which JPEG otherwise halves.
        picture.save(file, 'jpeg', quality=style.quality, subsampling='4:4:4')
    except (OSError, ValueError) as error:
        size = f'{picture.width} x {picture.height}'
        raise OverlayError(f'jpeg cannot hold a picture of {size} pixels: {error}') from None
    return Picture(file.getvalue(), left_out)


def picture_of(image: WireImage, scale: float = 1.0) -> Any:
    """
    Show an image as a Pillow image of mode RGB.

    Raises OverlayError if its encoding is not supported or its size and data do not match.
    """
    from PIL import Image

    if image.encoding not in ENCODINGS:
        supported = ', '.join(ENCODINGS)
        raise OverlayError(
            f'images of encoding {image.encoding!r} cannot be shown, only {supported}'
        )
    try:
        view = view_of(image)
    except ChipError as error:
        raise OverlayError(str(error)) from None
    size = image.width, image.height
    if max(size) * scale > _MAX_SIDE:
        raise OverlayError(f'jpeg cannot hold a picture of {size[0]} x {size[1]} pixels')
    if image.encoding in _RAW_MODES and image.step == view.shape[1] * view.shape[2]:
        picture = Image.frombytes('RGB', size, image.data, 'raw', _RAW_MODES[image.encoding])
    else:
        pixels = _shown(view, image.encoding)
        mode = 'L' if pixels.shape[2] == 1 else 'RGB'
        picture = Image.frombytes(mode, size, np.ascontiguousarray(pixels))
    if scale != 1.0:
        scaled = [max(1, round(side * scale)) for side in size]
        picture = picture.resize(scaled, Image.Resampling.BOX, reducing_gap=1.0)
    # Only now: in full size colours would take three times the memory of grey.
    return picture if picture.mode == 'RGB' else picture.convert('RGB')


def _shown(view: ImageView, encoding: str) -> NDArray[np.uint8]:
    """Return grey, or red, green and blue, of all pixels in 8 bits."""
    if not isinstance(view, np.ndarray):
        height, width, _ = view.shape
        return view.rgb((0, 0, width, height))
    layout = PIXEL_FORMATS[encoding]
    pixels = view[..., layout.channels[:3]]
    return to_8_bits(pixels) if layout.depth == 16 else pixels


def _explain(canvas: Any, layers: Sequence[Layer], style: Style) -> FloatArray:
    """Draw the legend, the upper layers first; return the place it takes, (K, 4), K at most 1."""
    picture = canvas.im.size
    width, text_size = style.line_width_for(picture), style.text_size_for(picture)
    named = [layer for layer in reversed(layers) if layer.title]
    texts = [text_mask(layer.title, text_size) for layer in named]
    margin = text_size // 2
    key = 2 * text_size
    row = max((text.height for text in texts), default=0) + 2 * width
    size = (
        key + 2 * margin + max((text.width for text in texts), default=0),
        len(named) * row + margin,
    )
    if not named or not has_room_for_legend(size, picture):
        return _NOWHERE
    left, top = 0, picture[1] - size[1]
    canvas.rectangle((left, top, left + size[0] - 1, picture[1] - 1), _LEGEND_GROUND)
    for number, (layer, text) in enumerate(zip(named, texts, strict=True)):
        y = top + margin // 2 + number * row
        # A small box as the layer has them.
        x0, y0 = left + margin, y + row // 4
        x1, y1 = x0 + key - margin // 2, y + row - row // 4
        box = np.array([[(x0, y0), (x1, y0), (x1, y1), (x0, y1)]], float)
        outline(canvas, box, layer.pen(width))
        canvas.bitmap((left + margin + key, y + width), text, _LEGEND_INK)
    return np.array([[left, top, left + size[0], picture[1]]], float)


def _write(canvas: Any, labels: Labels, style: Style, covered: FloatArray) -> int:
    """Write the labels that have room clear of `covered`, best first; return how many have none."""
    size = canvas.im.size
    ground = rgb(labels.color)
    ink = ink_on(ground)
    sizes = style.text_size_for(size), style.line_width_for(size)
    placed, left_out = place_labels(labels, size, *sizes, covered)
    for label in placed:
        x, y = label.corner
        canvas.rectangle((x, y, x + label.mask.width - 1, y + label.mask.height - 1), ground)
        canvas.bitmap((x, y), label.mask, ink)
    return left_out
