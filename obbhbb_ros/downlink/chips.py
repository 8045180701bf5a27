# SPDX-License-Identifier: Apache-2.0
"""
Chips: regions cut out of an image and encoded as files.

The image is never copied as a whole, only the pixels of each chip. Encoding requires Pillow, the
extra `chips`.
"""

from __future__ import annotations

import io
from collections.abc import Callable
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from enum import Enum
from typing import Any
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from obbhbb_ros.downlink.pixel_views import YUV_LAYOUTS
from obbhbb_ros.downlink.pixel_views import BayerView
from obbhbb_ros.downlink.pixel_views import YuvLayout
from obbhbb_ros.downlink.pixel_views import YuvView
from obbhbb_ros.errors import ObbhbbError
from obbhbb_ros.limits import CheckedSettings
from obbhbb_ros.limits import Choices
from obbhbb_ros.limits import Range
from obbhbb_ros.limits import setting
from obbhbb_ros.wire.image import WireImage

Region = tuple[int, int, int, int]
"""x0, y0, x1, y1 in whole pixels, upper ends exclusive."""


# Of `to_8_bits`: pixels sampled on each side, and percent that become black or white.
_MAX_SAMPLES = 256
_CLIPPED = 0.5

# Optimised Huffman tables take a fifth off a chip of usual size, and twice the time above that.
_MAX_OPTIMISED = 1_000_000

# Encoding to which OpenCV decodes a file, by its number of channels. `image_transport` names none
# for a single channel.
_DECODED = {1: '', 3: 'bgr8', 4: 'bgra8'}


class Dropped(str, Enum):
    """Why a region of a frame became no chip, or the chip was not sent."""

    NO_SUBSCRIBER = 'no_subscriber'
    IMAGE_REFUSED = 'image_refused'
    OUTSIDE = 'outside_image'
    ENCODER = 'encoder_failed'
    LINK_BUDGET = 'link_budget'
    LARGER_THAN_BURST = 'larger_than_burst'
    FRAME_CHIPS = 'frame_max_chips'
    FRAME_BYTES = 'frame_max_bytes'
    DEACTIVATED = 'deactivated'
    FAILED = 'failed'


class ChipError(ObbhbbError, ValueError):
    """No chips can be cut from an image; the message says why."""


@dataclass(frozen=True)
class PixelFormat:
    """
    Pixel layout of an encoding.

    Attributes
    ----------
    channels : tuple of int
        Indices of red, green, blue and alpha; a single one for grey.
    depth : int
        Bits per channel.
    bayer : bool
        Whether it is a Bayer mosaic, in which a chip must start at even offsets.
    """

    channels: tuple[int, ...]
    depth: int
    bayer: bool = False


PIXEL_FORMATS: dict[str, PixelFormat] = {
    'mono8': PixelFormat((0,), 8),
    'mono16': PixelFormat((0,), 16),
    'rgb8': PixelFormat((0, 1, 2), 8),
    'bgr8': PixelFormat((2, 1, 0), 8),
    'rgba8': PixelFormat((0, 1, 2, 3), 8),
    'bgra8': PixelFormat((2, 1, 0, 3), 8),
    # OpenCV's names, which say nothing of colours; its order is blue, green, red.
    '8UC1': PixelFormat((0,), 8),
    '16UC1': PixelFormat((0,), 16),
    '8UC3': PixelFormat((2, 1, 0), 8),
    '8UC4': PixelFormat((2, 1, 0, 3), 8),
    **{
        f'bayer_{pattern}{depth}': PixelFormat((0,), depth, bayer=True)
        for pattern in ('rggb', 'bggr', 'gbrg', 'grbg')
        for depth in (8, 16)
    },
}
"""Encodings of `sensor_msgs/Image` whose pixels are cut as they are."""
ENCODINGS = (*PIXEL_FORMATS, *YUV_LAYOUTS)
"""All supported encodings; YUV is converted to red, green and blue."""

_RGB = PixelFormat((0, 1, 2), 8)
_DEEP_COLORS = ('rgb16', 'bgr16', 'rgba16', 'bgra16', '16UC3', '16UC4')
_DEEP_REASON = 'has several channels of 16 bits, which no encoder of Pillow holds'

ImageView: TypeAlias = NDArray[Any] | YuvView | BayerView
"""The pixels of an image without a copy."""


@dataclass(frozen=True)
class Codec:
    """A file format: suffix, and what it supports: bits per channel, channels, lossless, lossy."""

    name: str
    suffix: str
    depths: tuple[int, ...]
    channels: tuple[int, ...]
    lossless: bool
    lossy: bool


CODECS: dict[str, Codec] = {
    codec.name: codec
    for codec in (
        Codec('jpeg', 'jpg', (8,), (1, 3), lossless=False, lossy=True),
        Codec('png', 'png', (8, 16), (1, 3, 4), lossless=True, lossy=False),
        Codec('webp', 'webp', (8,), (3, 4), lossless=True, lossy=True),
        Codec('jpeg2000', 'jp2', (8, 16), (1, 3, 4), lossless=True, lossy=True),
    )
}


@dataclass(frozen=True)
class CodecSettings(CheckedSettings):
    """
    How chips are encoded; ValueError if values are out of range or in conflict.

    Examples
    --------
    >>> CodecSettings('png').exact, CodecSettings('webp').exact
    (True, False)
    """

    codec: str = setting('jpeg', 'File format of the chips.', Choices(tuple(CODECS)))
    quality: int = setting(
        85,
        'Quality of jpeg and webp; for jpeg2000: target file size, as a percentage of the raw '
        'pixels.',
        Range(1, 100),
    )
    lossless: bool = setting(
        False, 'Encode webp and jpeg2000 without loss. png is always lossless, jpeg never.'
    )
    develop: bool = setting(
        False,
        'Develop chips of 8-bit Bayer images to colours, bilinear. If false, they stay mosaics.',
    )

    def __post_init__(self) -> None:
        """Check every value and their combination."""
        super().__post_init__()
        if self.lossless and not CODECS[self.codec].lossless:
            raise ValueError(f'lossless: {self.codec} cannot be; use png, webp or jpeg2000')

    @property
    def exact(self) -> bool:
        """Whether decoded pixels equal the original ones."""
        return self.lossless or not CODECS[self.codec].lossy


def pixel_format(encoding: str, codec: str, develop: bool = False) -> PixelFormat:
    """
    Look up the pixel format of the chips of an encoding.

    Parameters
    ----------
    encoding : str
        As in `sensor_msgs/Image`.
    codec : str
        Name of the codec.
    develop : bool
        Whether Bayer mosaics are developed.

    Raises
    ------
    ChipError
        If the encoding is not supported, or not by the codec.

    Examples
    --------
    >>> pixel_format('bgr8', 'jpeg').channels
    (2, 1, 0)
    """
    if encoding in _DEEP_COLORS:
        raise ChipError(f'{encoding} {_DEEP_REASON}')
    if encoding not in ENCODINGS:
        supported = ', '.join(ENCODINGS)
        raise ChipError(f'images of encoding {encoding!r} cannot be cut, only {supported}')
    layout = _layout(encoding, develop)
    depth = layout.depth
    if depth == 16 and len(layout.channels) > 1:
        raise ChipError(f'{encoding}, developed, {_DEEP_REASON}')
    if depth not in CODECS[codec].depths:
        able = ', '.join(c.name for c in CODECS.values() if depth in c.depths)
        raise ChipError(
            f'{codec} does not support the {depth} bits per channel of {encoding}; use {able}'
        )
    return layout


def _layout(encoding: str, develop: bool) -> PixelFormat:
    """Return the pixel format of the chips of a supported encoding."""
    layout = PIXEL_FORMATS.get(encoding, _RGB)
    return PixelFormat((0, 1, 2), layout.depth) if develop and layout.bayer else layout


def view_of(image: WireImage, develop: bool = False) -> ImageView:
    """
    View the pixels of an image without a copy.

    Parameters
    ----------
    image : WireImage
        The image, with a supported encoding.
    develop : bool
        Whether a Bayer mosaic is developed, which must have 8 bits.

    Returns
    -------
    ndarray, YuvView or BayerView, of shape (height, width, channels)
        Bytes and channels of an array keep the order of the image.

    Raises
    ------
    ChipError
        If size, step and data of the image do not match.
    """
    if not (image.width and image.height):
        raise ChipError(f'the image is empty: {image.width} x {image.height} pixels')
    yuv = YUV_LAYOUTS.get(image.encoding)
    if yuv is not None:
        return _yuv_view(image, yuv)
    layout = PIXEL_FORMATS[image.encoding]
    size = layout.depth // 8
    row = image.width * len(layout.channels) * size
    _require(image, row, image.step * (image.height - 1) + row)
    pixels = np.ndarray(
        (image.height, image.width, len(layout.channels)),
        f'{">" if image.is_bigendian else "<"}u{size}',
        image.data,
        strides=(image.step, len(layout.channels) * size, size),
    )
    if develop and layout.bayer:
        return BayerView(pixels[..., 0], image.encoding[len('bayer_') :][:4])
    return pixels


def _yuv_view(image: WireImage, layout: YuvLayout) -> YuvView:
    """View an image in YUV; ChipError if size, step and data do not match."""
    width, height = image.width // layout.cell[0], image.height // layout.cell[1]
    if (width * layout.cell[0], height * layout.cell[1]) != (image.width, image.height):
        raise ChipError(
            f'{image.encoding} needs whole cells of {layout.cell[0]} x {layout.cell[1]} pixels, '
            f'and the image has {image.width} x {image.height}'
        )
    # In one plane a cell has two samples of luma, one of U and one of V.
    chroma_row = width * (2 if layout.is_planar else 4)
    pitch = image.step * (2 // layout.cell[0]) if layout.is_planar else image.step
    start = image.step * image.height if layout.is_planar else 0
    _require(
        image,
        image.width if layout.is_planar else chroma_row,
        start + pitch * (height - 1) + chroma_row,
    )

    def plane(shape: tuple[int, int], offset: int, strides: tuple[int, int]) -> NDArray[np.uint8]:
        return np.ndarray(shape, np.uint8, image.data, offset, strides)

    pixel = 1 if layout.is_planar else 2
    return YuvView(
        plane((image.height, image.width), layout.luma, (image.step, pixel)),
        plane((height, width), start + layout.u, (pitch, 2 * pixel)),
        plane((height, width), start + layout.v, (pitch, 2 * pixel)),
        layout.cell,
    )


def _require(image: WireImage, row: int, needed: int) -> None:
    """Raise ChipError if step or data of an image are too short, in bytes."""
    if image.step < row:
        raise ChipError(f'step is {image.step}, but {image.width} pixels need {row} bytes')
    if len(image.data) < needed:
        raise ChipError(f'data has {len(image.data)} bytes, but the image needs {needed}')


def placed(region: Region, image_size: tuple[int, int], layout: PixelFormat) -> Region | None:
    """
    Clip a region to an image of `image_size`, width and height; None if nothing is left.

    In a Bayer mosaic the region first grows to whole 2 x 2 cells, so that the chip has the pattern
    of the image.

    Examples
    --------
    >>> placed((-5, 3, 20, 21), (640, 480), PIXEL_FORMATS['bayer_rggb8'])
    (0, 2, 20, 22)
    """
    x0, y0, x1, y1 = region
    if layout.bayer:
        x0, y0, x1, y1 = x0 - x0 % 2, y0 - y0 % 2, x1 + x1 % 2, y1 + y1 % 2
    x0, y0, x1, y1 = max(x0, 0), max(y0, 0), min(x1, image_size[0]), min(y1, image_size[1])
    return (x0, y0, x1, y1) if x0 < x1 and y0 < y1 else None


def cut(view: ImageView, region: Region, layout: PixelFormat) -> NDArray[Any]:
    """
    Copy the pixels of a region inside the image, ready for encoding.

    They are contiguous, in native byte order, with the channels grey or red, green, blue, alpha.

    Examples
    --------
    >>> bgr = np.array([[[3, 2, 1], [6, 5, 4]]], np.uint8)
    >>> cut(bgr, (1, 0, 2, 1), PIXEL_FORMATS['bgr8']).tolist()
    [[[4, 5, 6]]]
    """
    if not isinstance(view, np.ndarray):
        return view.rgb(region)
    x0, y0, x1, y1 = region
    chip = view[y0:y1, x0:x1]
    if layout.channels != tuple(range(len(layout.channels))):
        chip = chip[..., layout.channels]
    return np.ascontiguousarray(chip, view.dtype.newbyteorder('='))


def to_8_bits(pixels: NDArray[Any]) -> NDArray[np.uint8]:
    """
    Stretch 16-bit pixels to 8 bits for display.

    The darkest and the brightest half percent of a sample of the pixels become black and white.

    Parameters
    ----------
    pixels : ndarray of int, shape (height, width) or (height, width, channels)
        Values from 0 to 65535.

    Examples
    --------
    >>> to_8_bits(np.array([[100, 150, 200]], np.uint16)).tolist()
    [[0, 128, 255]]
    """
    height, width = pixels.shape[:2]
    sample = pixels[:: -(-height // _MAX_SAMPLES), :: -(-width // _MAX_SAMPLES)]
    low, high = np.percentile(sample, (_CLIPPED, 100.0 - _CLIPPED))
    steps = (np.arange(2**16) - low) * (255.0 / max(high - low, 1.0))
    table: NDArray[np.uint8] = np.clip(np.round(steps), 0, 255).astype(np.uint8)
    return table[pixels]


def encode(pixels: NDArray[Any], settings: CodecSettings) -> bytes:
    """
    Encode pixels from `cut` to a file of the codec.

    JPEG drops alpha; WebP stores grey as three equal channels. Raises ModuleNotFoundError if
    Pillow is not installed, ValueError or OSError if it cannot encode the pixels.
    """
    from PIL import Image

    codec = CODECS[settings.codec]
    if pixels.shape[2] not in codec.channels:
        pixels = pixels[..., [0, 0, 0]] if pixels.shape[2] == 1 else pixels[..., :3]
    height, width, channels = pixels.shape
    mode = 'I;16' if pixels.dtype.itemsize == 2 else {1: 'L', 3: 'RGB', 4: 'RGBA'}[channels]
    image = Image.frombytes(mode, (width, height), pixels.tobytes())
    options = _pillow_options(settings)
    if settings.codec == 'jpeg' and width * height <= _MAX_OPTIMISED:
        # Pillow fails if the file is larger than it guesses.
        with suppress(OSError):
            return _file(image, settings.codec, {**options, 'optimize': True})
    return _file(image, settings.codec, options)


def _file(image: Any, codec: str, options: Mapping[str, Any]) -> bytes:
    """Write a PIL image to a file in memory."""
    file = io.BytesIO()
    image.save(file, codec, **options)
    return file.getvalue()


def _pillow_options(settings: CodecSettings) -> dict[str, Any]:
    """Translate the settings to the options of Pillow."""
    quality, lossless = settings.quality, settings.lossless
    rates = {} if lossless else {'quality_mode': 'rates', 'quality_layers': [100.0 / quality]}
    options: dict[str, dict[str, Any]] = {
        'jpeg': {'quality': quality},
        'png': {},
        # `exact` also keeps the colours where alpha is 0.
        'webp': {'quality': quality, 'lossless': lossless, 'exact': True},
        'jpeg2000': {'irreversible': not lossless, **rates},
    }
    return options[settings.codec]


@dataclass(frozen=True)
class EncodedChip:
    """A region of a frame: its index in the plan, its place in the image, pixels and file."""

    index: int
    region: Region
    pixels: NDArray[Any]
    data: bytes


@dataclass(frozen=True)
class ChipCutter:
    """
    Cuts regions out of one image and encodes them.

    Attributes
    ----------
    view : ndarray, YuvView or BayerView, of shape (height, width, channels)
        The image.
    layout : PixelFormat
        Its pixel format.
    codec : CodecSettings
        How chips are encoded.
    on_failure : callable
        Called with region and error where the codec cannot hold a chip.
    """

    view: ImageView
    layout: PixelFormat
    codec: CodecSettings
    on_failure: Callable[[Region, Exception], None]

    def cut(self, index: int, region: Region) -> EncodedChip | Dropped:
        """Cut and encode the region of an index; return why there is no chip if there is none."""
        height, width = self.view.shape[:2]
        place = placed(region, (width, height), self.layout)
        if place is None:
            return Dropped.OUTSIDE
        pixels = cut(self.view, place, self.layout)
        try:
            data = encode(pixels, self.codec)
        except (ValueError, OSError, MemoryError) as error:
            # Each format has a maximum size.
            self.on_failure(place, error)
            return Dropped.ENCODER
        return EncodedChip(index, place, pixels, data)


def format_text(encoding: str, codec: str, develop: bool = False) -> str:
    """
    Describe a chip as `image_transport` does in `sensor_msgs/CompressedImage.format`.

    It consists of the encoding of the image, the codec, and for colours the encoding to which
    OpenCV decodes the file. With `develop`, Bayer mosaics are developed.

    Examples
    --------
    >>> format_text('rgb8', 'jpeg')
    'rgb8; jpeg compressed bgr8'
    """
    channels = len(_layout(encoding, develop).channels)
    stored = channels if channels in CODECS[codec].channels else 3
    return f'{encoding}; {codec} compressed {_DECODED[stored]}'
