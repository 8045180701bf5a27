# SPDX-License-Identifier: Apache-2.0
"""Images that travel as JPEG or PNG: decoded exactly, or refused before they are."""

import contextlib
import io
import struct
import zlib

import numpy as np
import pytest
from PIL import Image

from obbhbb_ros.downlink import decoding
from obbhbb_ros.downlink.chips import cut
from obbhbb_ros.downlink.chips import pixel_format
from obbhbb_ros.downlink.chips import view_of
from obbhbb_ros.downlink.decoding import decoded
from obbhbb_ros.wire.buffer import WireError
from obbhbb_ros.wire.image import CompressedWireImage

RANDOM = np.random.default_rng(1)
PIXELS = {
    'mono8': RANDOM.integers(0, 256, (9, 14)).astype(np.uint8),
    'mono16': RANDOM.integers(0, 2**16, (9, 14)).astype(np.uint16),
    'rgb8': RANDOM.integers(0, 256, (9, 14, 3)).astype(np.uint8),
    'rgba8': RANDOM.integers(0, 256, (9, 14, 4)).astype(np.uint8),
}


def file_of(pixels, codec='png', **options):
    file = io.BytesIO()
    Image.fromarray(pixels).save(file, codec, **options)
    return file.getvalue()


def compressed(data, text='bgr8; png compressed bgr8'):
    return CompressedWireImage((5, 6), 'camera', text, memoryview(data))


def png_header(width, height, depth, colors):
    """Write a PNG that has a header and next to nothing else."""
    header = b'IHDR' + struct.pack('>2I5B', width, height, depth, colors, 0, 0, 0)
    data = b'IDAT' + zlib.compress(bytes(64))
    chunks = (
        struct.pack('>I', len(c) - 4) + c + struct.pack('>I', zlib.crc32(c)) for c in (header, data)
    )
    return b'\x89PNG\r\n\x1a\n' + b''.join(chunks)


@pytest.mark.parametrize('encoding', PIXELS)
def test_a_png_has_its_pixels(encoding) -> None:
    seen = PIXELS[encoding]
    image = decoded(compressed(file_of(seen)))
    assert (image.stamp, image.frame_id, image.encoding) == ((5, 6), 'camera', encoding)
    assert (image.width, image.height) == (14, 9)
    chip = cut(view_of(image), (2, 1, 9, 8), pixel_format(encoding, 'png'))
    np.testing.assert_array_equal(chip, seen.reshape(9, 14, -1)[1:8, 2:9])


def test_a_jpeg_has_what_pillow_reads() -> None:
    data = file_of(PIXELS['rgb8'], 'jpeg')
    image = decoded(compressed(data, 'rgb8; jpeg compressed bgr8'))
    assert image.encoding == 'rgb8'
    np.testing.assert_array_equal(view_of(image), np.asarray(Image.open(io.BytesIO(data))))


@pytest.mark.parametrize(
    ('original', 'encoding', 'kept'),
    [
        ('bayer_grbg8', 'mono8', 'bayer_grbg8'),
        ('bayer_grbg16', 'mono16', 'bayer_grbg16'),
        ('bayer_grbg16', 'mono8', 'mono8'),
        ('bayer_grbg8', 'rgb8', 'rgb8'),
    ],
)
def test_a_mosaic_that_travels_as_grey_stays_one(original, encoding, kept) -> None:
    data = file_of(PIXELS[encoding])
    assert decoded(compressed(data, f'{original}; png compressed ')).encoding == kept


@pytest.mark.parametrize('colors', [2, 4, 6])
def test_colours_of_16_bits_are_refused(colors) -> None:
    with pytest.raises(WireError, match='several channels of 16 bits'):
        decoded(compressed(png_header(10, 10, 16, colors)))


def test_an_image_that_is_too_large_is_refused_before_it_is_decoded(monkeypatch) -> None:
    with pytest.raises(WireError, match='9000 x 9000 pixels, the maximum is 80000000'):
        decoded(compressed(png_header(9000, 9000, 8, 2)))
    with pytest.raises(WireError):
        decoded(compressed(png_header(2**31 - 1, 2**31 - 1, 8, 2)))
    monkeypatch.setattr(decoding, 'MAX_FILE_BYTES', 20)
    with pytest.raises(WireError, match=r'a file of .* bytes, the maximum is 20'):
        decoded(compressed(file_of(PIXELS['rgb8'])))


GOOD = {codec: file_of(PIXELS['rgb8'], codec) for codec in ('png', 'jpeg')}


@pytest.mark.parametrize('codec', GOOD)
def test_a_damaged_file_is_an_image_or_a_wire_error(codec) -> None:
    data = GOOD[codec]
    random = np.random.default_rng(2)
    for length in range(0, len(data), 7):
        damaged = bytearray(data)
        for place in random.integers(0, len(data), 3):
            damaged[place] = random.integers(0, 256)
        for attempt in (data[:length], bytes(damaged)):
            with contextlib.suppress(WireError):
                view_of(decoded(compressed(attempt)))


@pytest.mark.parametrize('data', [b'', b'GIF89a', file_of(PIXELS['rgb8'], 'gif')])
def test_another_kind_of_file_is_refused(data) -> None:
    with pytest.raises(WireError, match='no image in the file'):
        decoded(compressed(data))


def test_inks_are_refused() -> None:
    file = io.BytesIO()
    Image.new('CMYK', (8, 8)).save(file, 'jpeg')
    with pytest.raises(WireError, match='pixels of mode CMYK'):
        decoded(compressed(file.getvalue()))
