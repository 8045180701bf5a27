# SPDX-License-Identifier: Apache-2.0
"""
Images that travel as files, decoded when somebody wants their pixels. Requires Pillow.

What the header of a file says is checked before anything is decoded.
"""

from __future__ import annotations

import io
from typing import Any
from typing import TypeAlias

import numpy as np

from obbhbb_ros.downlink.chips import PIXEL_FORMATS
from obbhbb_ros.wire.buffer import WireError
from obbhbb_ros.wire.image import CompressedWireImage
from obbhbb_ros.wire.image import WireImage

AnyImage: TypeAlias = WireImage | CompressedWireImage
"""An image as it arrived."""

MAX_FILE_BYTES = 2**28
"""Maximum size of a file that is decoded, bytes."""
MAX_PIXELS = 80_000_000
"""Maximum size of the image in it, pixels."""

# What Pillow calls pixels, and their encoding and bytes.
_MODES = {
    'L': ('mono8', 1),
    # Grey of 16 bits, by old and new versions.
    'I': ('mono16', 2),
    'I;16': ('mono16', 2),
    'RGB': ('rgb8', 3),
    'RGBA': ('rgba8', 4),
}
# Where the header of a PNG has bits per channel and kind of colours; 0 is grey.
_PNG_DEPTH, _PNG_COLORS = 24, 25


def decoded(image: AnyImage) -> WireImage:
    """
    Decode an image that arrived as a JPEG or PNG; return any other as it is.

    Raises
    ------
    WireError
        If the file is damaged, of another format, too large, or has several channels of 16 bits.
    """
    if isinstance(image, WireImage):
        return image
    try:
        return _decoded(image)
    except WireError:
        raise
    except Exception as error:
        # Pillow raises many kinds of errors at damaged files.
        raise WireError(f'no image in the file: {error}') from None


def _decoded(image: CompressedWireImage) -> WireImage:
    """Decode a file."""
    from PIL import Image

    if len(image.data) > MAX_FILE_BYTES:
        raise WireError(f'a file of {len(image.data)} bytes, the maximum is {MAX_FILE_BYTES}')
    with Image.open(io.BytesIO(image.data), formats=('JPEG', 'PNG')) as file:
        width, height = file.size
        if width * height > MAX_PIXELS:
            raise WireError(f'an image of {width} x {height} pixels, the maximum is {MAX_PIXELS}')
        _require_depth(file, image.data)
        if file.mode not in _MODES:
            raise WireError(f'pixels of mode {file.mode}, only {", ".join(_MODES)} can be read')
        encoding, size = _MODES[file.mode]
        pixels = np.asarray(file).astype('<u2' if encoding == 'mono16' else np.uint8).tobytes()
    original = image.format.partition(';')[0].strip()
    layout = PIXEL_FORMATS.get(original)
    if layout is not None and layout.channels == (0,) and layout.depth == 8 * size:
        # The mosaic of a Bayer image travels as grey.
        encoding = original
    return WireImage(
        stamp=image.stamp,
        frame_id=image.frame_id,
        encoding=encoding,
        width=width,
        height=height,
        step=width * size,
        is_bigendian=False,
        data=memoryview(pixels),
    )


def _require_depth(file: Any, data: memoryview) -> None:
    """Raise WireError for colours of 16 bits, of which Pillow would drop eight without a word."""
    if file.format == 'PNG' and data[_PNG_DEPTH] == 16 and data[_PNG_COLORS]:
        raise WireError('a PNG with several channels of 16 bits, of which Pillow keeps only 8')
