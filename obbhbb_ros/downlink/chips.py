# SPDX-License-Identifier: Apache-2.0
"""
Image and crop plan in, encoded chips out.

The frame is only looked at, never copied: a chip's own pixels are the first that move. Encoding
takes Pillow, the extra `chips`.
"""

from __future__ import annotations

import io
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from obbhbb_ros.wire.image import WireImage

Region = tuple[int, int, int, int]
"""x0, y0, x1, y1 in whole pixels, upper ends exclusive."""


class ChipError(ValueError):
    """An image that no chips can be made of as asked; the text says why."""


@dataclass(frozen=True)
class PixelFormat:
    """
    How an encoding lays out a pixel.

    Attributes
    ----------
    channels : tuple of int
        Where red, green, blue and alpha lie; just one for grey.
    depth : int
        Bits a channel.
    decoded : str
        Encoding that OpenCV decodes a file of such pixels to, as `image_transport` has it in
        `CompressedImage.format`; empty for a single channel.
    bayer : bool
        Whether neighbours are of different colours, so that a chip must start at even offsets.
    """

    channels: tuple[int, ...]
    depth: int
    decoded: str = ''
    bayer: bool = False


PIXEL_FORMATS: dict[str, PixelFormat] = {
    'mono8': PixelFormat((0,), 8),
    'mono16': PixelFormat((0,), 16),
    'rgb8': PixelFormat((0, 1, 2), 8, 'bgr8'),
    'bgr8': PixelFormat((2, 1, 0), 8, 'bgr8'),
    'rgba8': PixelFormat((0, 1, 2, 3), 8, 'bgra8'),
    'bgra8': PixelFormat((2, 1, 0, 3), 8, 'bgra8'),
    **{
        f'bayer_{pattern}{depth}': PixelFormat((0,), depth, bayer=True)
        for pattern in ('rggb', 'bggr', 'gbrg', 'grbg')
        for depth in (8, 16)
    },
}
"""What can be cut, by the name it has in `sensor_msgs/Image.encoding`."""


@dataclass(frozen=True)
class Codec:
    """What a file format can hold: bits a channel, channels, and if it can be exact or inexact."""

    name: str
    depths: tuple[int, ...]
    channels: tuple[int, ...]
    lossless: bool
    lossy: bool


CODECS: dict[str, Codec] = {
    codec.name: codec
    for codec in (
        Codec('jpeg', (8,), (1, 3), lossless=False, lossy=True),
        Codec('png', (8, 16), (1, 3, 4), lossless=True, lossy=False),
        Codec('webp', (8,), (3, 4), lossless=True, lossy=True),
        Codec('jpeg2000', (8, 16), (1, 3, 4), lossless=True, lossy=True),
    )
}


@dataclass(frozen=True)
class CodecSettings:
    """
    How chips are encoded.

    Attributes
    ----------
    codec : str
        One of `CODECS`.
    quality : int
        1 to 100, for inexact encoding. For JPEG 2000 it is percent of the size of the bare pixels.
    lossless : bool
        Whether pixels must come out as they went in; PNG always does that.

    Raises
    ------
    ValueError
        If a value is out of range, or the codec cannot be exact; the message names it.
    """

    codec: str = 'jpeg'
    quality: int = 85
    lossless: bool = False

    def __post_init__(self) -> None:
        """Check the values."""
        if self.codec not in CODECS:
            raise ValueError(f'codec must be one of {", ".join(CODECS)}, not {self.codec!r}')
        if not 1 <= self.quality <= 100:
            raise ValueError(f'quality must be 1 to 100, not {self.quality}')
        if self.lossless and not CODECS[self.codec].lossless:
            raise ValueError(f'lossless: {self.codec} cannot be; use png, webp or jpeg2000')

    @property
    def exact(self) -> bool:
        """Whether pixels come out as they went in."""
        return self.lossless or not CODECS[self.codec].lossy


def pixel_format(encoding: str, codec: str) -> PixelFormat:
    """
    Look up an encoding, and that a codec can hold it.

    Parameters
    ----------
    encoding : str
        As in `sensor_msgs/Image`.
    codec : str
        One of `CODECS`.

    Returns
    -------
    PixelFormat
        How its pixels are laid out.

    Raises
    ------
    ChipError
        If the encoding is unknown, or the codec cannot hold so many bits a channel.
    """
    found = PIXEL_FORMATS.get(encoding)
    if found is None:
        known = ', '.join(PIXEL_FORMATS)
        raise ChipError(f'images of encoding {encoding!r} cannot be cut, only {known}')
    if found.depth not in CODECS[codec].depths:
        able = ', '.join(c.name for c in CODECS.values() if found.depth in c.depths)
        raise ChipError(
            f'{codec} cannot hold the {found.depth} bits a channel of {encoding}; use {able}'
        )
    return found


def view_of(image: WireImage) -> NDArray[Any]:
    """
    Look at the pixels of an image where they lie.

    Parameters
    ----------
    image : WireImage
        An image of one of `PIXEL_FORMATS`.

    Returns
    -------
    ndarray of uint8 or uint16, shape (height, width, channels)
        A view with the image's own order of bytes and channels; it keeps the message alive.

    Raises
    ------
    ChipError
        If the message does not hold the pixels that it tells of.
    """
    layout = PIXEL_FORMATS[image.encoding]
    size = layout.depth // 8
    row = image.width * len(layout.channels) * size
    if not (image.width and image.height):
        raise ChipError(f'an image of {image.width} x {image.height} pixels')
    if image.step < row:
        raise ChipError(f'step is {image.step}, a row of {image.width} pixels takes {row} bytes')
    needed = image.step * (image.height - 1) + row
    if len(image.data) < needed:
        raise ChipError(f'data has {len(image.data)} bytes, the image takes {needed}')
    return np.ndarray(
        (image.height, image.width, len(layout.channels)),
        f'{">" if image.is_bigendian else "<"}u{size}',
        image.data,
        strides=(image.step, len(layout.channels) * size, size),
    )


def placed(region: Region, image_size: tuple[int, int], layout: PixelFormat) -> Region | None:
    """
    Place a region in an image.

    Parameters
    ----------
    region : tuple of int
        x0, y0, x1, y1.
    image_size : tuple of int
        Width and height, pixels.
    layout : PixelFormat
        Of the image. Where it is a Bayer mosaic, the region grows to whole 2 x 2 cells, so that
        the chip has the pattern of the image.

    Returns
    -------
    tuple of int, or None
        The part of the region that lies in the image; None if there is none.
    """
    x0, y0, x1, y1 = region
    if layout.bayer:
        x0, y0, x1, y1 = x0 - x0 % 2, y0 - y0 % 2, x1 + x1 % 2, y1 + y1 % 2
    x0, y0, x1, y1 = max(x0, 0), max(y0, 0), min(x1, image_size[0]), min(y1, image_size[1])
    return (x0, y0, x1, y1) if x0 < x1 and y0 < y1 else None


def cut(view: NDArray[Any], region: Region, layout: PixelFormat) -> NDArray[Any]:
    """
    Copy the pixels of a region, ready to be encoded.

    Parameters
    ----------
    view : ndarray, shape (height, width, channels)
        The image, from `view_of`.
    region : tuple of int
        x0, y0, x1, y1 within the image.
    layout : PixelFormat
        Of the image.

    Returns
    -------
    ndarray of uint8 or uint16, shape (y1 - y0, x1 - x0, channels)
        Contiguous, in the machine's order of bytes; channels in the order grey or red, green,
        blue, alpha.
    """
    x0, y0, x1, y1 = region
    chip = view[y0:y1, x0:x1]
    if layout.channels != tuple(range(len(layout.channels))):
        chip = chip[..., layout.channels]
    return np.ascontiguousarray(chip, view.dtype.newbyteorder('='))


def encode(pixels: NDArray[Any], settings: CodecSettings) -> bytes:
    """
    Encode a chip.

    Parameters
    ----------
    pixels : ndarray of uint8 or uint16, shape (H, W, C)
        From `cut`. JPEG leaves out alpha; WebP holds grey as three equal channels.
    settings : CodecSettings
        How.

    Returns
    -------
    bytes
        A file of the codec.

    Raises
    ------
    ModuleNotFoundError
        If Pillow is not installed.
    ValueError, OSError
        If Pillow cannot encode such pixels.
    """
    from PIL import Image

    codec = CODECS[settings.codec]
    if pixels.shape[2] not in codec.channels:
        pixels = pixels[..., [0, 0, 0]] if pixels.shape[2] == 1 else pixels[..., :3]
    height, width, channels = pixels.shape
    mode = 'I;16' if pixels.dtype.itemsize == 2 else {1: 'L', 3: 'RGB', 4: 'RGBA'}[channels]
    image = Image.frombytes(mode, (width, height), np.ascontiguousarray(pixels).tobytes())
    file = io.BytesIO()
    image.save(file, settings.codec, **_options(settings))
    return file.getvalue()


def _options(settings: CodecSettings) -> dict[str, Any]:
    """Say to Pillow what the settings mean for their codec."""
    if settings.codec == 'png':
        return {}
    if settings.codec == 'jpeg2000':
        if settings.lossless:
            return {'irreversible': False}
        rate = 100.0 / settings.quality
        return {'irreversible': True, 'quality_mode': 'rates', 'quality_layers': [rate]}
    if settings.codec == 'webp':
        # Exact also where alpha is 0.
        return {'quality': settings.quality, 'lossless': settings.lossless, 'exact': True}
    return {'quality': settings.quality}


def format_text(encoding: str, codec: str) -> str:
    """
    Say what a chip is, as `image_transport` does in `sensor_msgs/CompressedImage.format`.

    Parameters
    ----------
    encoding : str
        Encoding of the image, one of `PIXEL_FORMATS`.
    codec : str
        One of `CODECS`.

    Returns
    -------
    str
        Such as 'rgb8; jpeg compressed bgr8': encoding of the image, codec, and what OpenCV decodes
        the file to where that has colours.
    """
    layout = PIXEL_FORMATS[encoding]
    decoded = layout.decoded
    if len(layout.channels) not in CODECS[codec].channels:
        decoded = 'bgr8'
    return f'{encoding}; {codec} compressed {decoded}'
