# SPDX-License-Identifier: Apache-2.0
"""
Colours of a region, from pixels that have none of their own: YUV and Bayer mosaics.

Only the region is converted, never the whole image, and it may begin at any pixel.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

# BT.601 of limited range, in 2^-20, with the three decimals that OpenCV has: luma, and what V adds
# to red, U and V to green, U to blue.
_SHIFT = 20
_LUMA, _RED_V, _GREEN_U, _GREEN_V, _BLUE_U = (
    int(factor * 2**_SHIFT) for factor in (1.164, 1.596, -0.391, -0.813, 2.018)
)
_BLACK, _GREY = 16, 128
# Rows that are converted at once: the intermediate numbers stay in the cache of the processor.
_BAND = 64


@dataclass(frozen=True)
class YuvLayout:
    """
    Where the samples of a YUV encoding are.

    Attributes
    ----------
    cell : tuple of int
        Pixels, horizontally and vertically, that share one U and one V.
    luma, u, v : int
        Offset of the first sample, bytes; of U and V in their plane if they have one.
    is_planar : bool
        Whether U and V alternate in a plane behind that of the luma; otherwise all are in one.
    """

    cell: tuple[int, int]
    luma: int
    u: int
    v: int
    is_planar: bool = False


_UYVY, _YUYV = YuvLayout((2, 1), 1, 0, 2), YuvLayout((2, 1), 0, 1, 3)
YUV_LAYOUTS = {
    # Two names for the same order, in both cases the older one first.
    'yuv422': _UYVY,
    'uyvy': _UYVY,
    'yuv422_yuy2': _YUYV,
    'yuyv': _YUYV,
    'nv12': YuvLayout((2, 2), 0, 0, 1, is_planar=True),
    'nv21': YuvLayout((2, 2), 0, 1, 0, is_planar=True),
    'nv24': YuvLayout((1, 1), 0, 0, 1, is_planar=True),
}
"""Supported YUV encodings of `sensor_msgs/Image`."""


@dataclass(frozen=True)
class YuvView:
    """
    An image in YUV.

    Attributes
    ----------
    luma : ndarray of uint8, shape (height, width)
        Y.
    u, v : ndarray of uint8, shape (height / cell height, width / cell width)
        U and V of each cell.
    cell : tuple of int
        Width and height of a cell, pixels.
    """

    luma: NDArray[np.uint8]
    u: NDArray[np.uint8]
    v: NDArray[np.uint8]
    cell: tuple[int, int]

    @property
    def shape(self) -> tuple[int, int, int]:
        """Height, width and channels of the image."""
        return (*self.luma.shape, 3)

    def rgb(self, region: tuple[int, int, int, int]) -> NDArray[Any]:
        """
        Convert a region by BT.601, limited range; all pixels of a cell have its U and V.

        Parameters
        ----------
        region : tuple of int
            x0, y0, x1, y1 inside the image.

        Returns
        -------
        ndarray of uint8, shape (y1 - y0, x1 - x0, 3)
            Red, green and blue.
        """
        x0, y0, x1, y1 = region
        pixels = np.empty((y1 - y0, x1 - x0, 3), np.uint8)
        for top in range(y0, y1, _BAND):
            bottom = min(top + _BAND, y1)
            band = pixels[top - y0 : bottom - y0]
            luma = np.maximum(self.luma[top:bottom, x0:x1].astype(np.int32) - _BLACK, 0) * _LUMA
            for channel, chroma in enumerate(self._chroma((x0, top, x1, bottom))):
                band[..., channel] = np.clip((luma + chroma) >> _SHIFT, 0, 255)
        return pixels

    def _chroma(self, region: tuple[int, int, int, int]) -> list[NDArray[np.int32]]:
        """Return what U and V add to red, green and blue, with half a unit for rounding."""
        x0, y0, x1, y1 = region
        width, height = self.cell
        cells = slice(y0 // height, -(-y1 // height)), slice(x0 // width, -(-x1 // width))
        u, v = (plane[cells].astype(np.int32) - _GREY for plane in (self.u, self.v))
        half = 1 << (_SHIFT - 1)
        of_cells = (half + _RED_V * v, half + _GREEN_U * u + _GREEN_V * v, half + _BLUE_U * u)
        top, left = y0 % height, x0 % width
        return [
            values.repeat(height, 0).repeat(width, 1)[top : top + y1 - y0, left : left + x1 - x0]
            for values in of_cells
        ]


@dataclass(frozen=True)
class BayerView:
    """
    A Bayer mosaic of 8 bits.

    Attributes
    ----------
    mosaic : ndarray of uint8, shape (height, width)
        The pixels.
    pattern : str
        Colours of the first cell, row by row, for example 'rggb'.
    """

    mosaic: NDArray[np.uint8]
    pattern: str

    @property
    def shape(self) -> tuple[int, int, int]:
        """Height, width and channels of the developed image."""
        return (*self.mosaic.shape, 3)

    def rgb(self, region: tuple[int, int, int, int]) -> NDArray[Any]:
        """
        Develop a region: a colour that a pixel lacks is the mean of the neighbours that have it.

        Beyond its border the image is mirrored. Parameters and result as in `YuvView.rgb`.
        """
        x0, y0, x1, y1 = region
        height, width = self.mosaic.shape
        # Mirrored at the outermost pixels, the colours of the pattern go on as they are.
        rows = _mirrored(np.arange(y0 - 1, y1 + 1), height)
        columns = _mirrored(np.arange(x0 - 1, x1 + 1), width)
        mosaic = self.mosaic[rows][:, columns].astype(np.float32)
        colors = np.array([list(self.pattern[:2]), list(self.pattern[2:])])
        of_pixels = colors[(rows % 2)[:, None], (columns % 2)[None, :]]
        channels = [_filled(mosaic, of_pixels == color, color) for color in 'rgb']
        return np.stack(channels, axis=-1)


def _mirrored(indices: NDArray[np.int_], size: int) -> NDArray[np.int_]:
    """Reflect indices just outside 0 to size - 1 at the outermost pixels."""
    reflected = size - 1 - np.abs(size - 1 - np.abs(indices))
    return np.clip(reflected, 0, size - 1)


def _filled(mosaic: NDArray[np.float32], known: NDArray[np.bool_], color: str) -> NDArray[np.uint8]:
    """Return one colour of all pixels but the outermost: the mean of the nearest known ones."""
    # Of red and blue one pixel in four is known, of green one in two. The weights of the known ones
    # under a kernel add up to 1 wherever it lies.
    beside, diagonal = (0.25, 0.0) if color == 'g' else (0.5, 0.25)
    weights = ((diagonal, beside, diagonal), (beside, 1.0, beside), (diagonal, beside, diagonal))
    values = np.where(known, mosaic, np.float32(0.0))
    height, width = mosaic.shape[0] - 2, mosaic.shape[1] - 2
    total = np.zeros((height, width), np.float32)
    for y, row in enumerate(weights):
        for x, weight in enumerate(row):
            if weight:
                total += np.float32(weight) * values[y : y + height, x : x + width]
    return (total + 0.5).astype(np.uint8)
