# SPDX-License-Identifier: Apache-2.0
"""Chips: exactly the image's pixels, whatever its encoding, and files that hold them."""

import io

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from obbhbb_ros.downlink.chips import CODECS
from obbhbb_ros.downlink.chips import PIXEL_FORMATS
from obbhbb_ros.downlink.chips import ChipCutter
from obbhbb_ros.downlink.chips import ChipError
from obbhbb_ros.downlink.chips import CodecSettings
from obbhbb_ros.downlink.chips import Dropped
from obbhbb_ros.downlink.chips import cut
from obbhbb_ros.downlink.chips import encode
from obbhbb_ros.downlink.chips import format_text
from obbhbb_ros.downlink.chips import pixel_format
from obbhbb_ros.downlink.chips import placed
from obbhbb_ros.downlink.chips import view_of
from obbhbb_ros.wire.image import WireImage

EXACT = [
    CodecSettings('png'),
    CodecSettings('webp', lossless=True),
    CodecSettings('jpeg2000', lossless=True),
]
WIDTH, HEIGHT = 37, 29


def picture(encoding, seed=0, width=WIDTH, height=HEIGHT):
    """Make up what a camera sees: grey, or red, green, blue, alpha."""
    layout = PIXEL_FORMATS[encoding]
    shape = height, width, len(layout.channels)
    random = np.random.default_rng(seed)
    return random.integers(0, 2**layout.depth, shape).astype(f'u{layout.depth // 8}')


def image_of(seen, encoding, is_bigendian=False, padding=0):
    """Write what is seen as a driver does."""
    stored = np.empty_like(seen)
    stored[..., PIXEL_FORMATS[encoding].channels] = seen
    height, width = seen.shape[:2]
    rows = stored.astype(stored.dtype.newbyteorder('>' if is_bigendian else '<'))
    rows = rows.view(np.uint8).reshape(height, -1)
    rows = np.pad(rows, ((0, 0), (0, padding)), constant_values=0xA5)
    return WireImage(
        (1, 2),
        'camera',
        encoding,
        width,
        height,
        rows.shape[1],
        is_bigendian,
        memoryview(rows.tobytes()),
    )


def decoded(data, dtype):
    with Image.open(io.BytesIO(data)) as file:
        return np.asarray(file).astype(dtype).reshape(file.height, file.width, -1)


@pytest.mark.parametrize('encoding', PIXEL_FORMATS)
@pytest.mark.parametrize('is_bigendian', [False, True], ids=['little', 'big'])
@pytest.mark.parametrize('padding', [0, 1, 6])
def test_a_chip_is_the_part_of_the_picture(encoding, is_bigendian, padding) -> None:
    seen = picture(encoding)
    view = view_of(image_of(seen, encoding, is_bigendian, padding))
    for region in ((0, 0, WIDTH, HEIGHT), (3, 5, 4, 6), (30, 20, WIDTH, HEIGHT)):
        x0, y0, x1, y1 = region
        chip = cut(view, region, PIXEL_FORMATS[encoding])
        np.testing.assert_array_equal(chip, seen[y0:y1, x0:x1])
        assert chip.flags.c_contiguous
        assert chip.dtype.isnative


@pytest.mark.parametrize('encoding', PIXEL_FORMATS)
def test_looking_at_an_image_copies_nothing(encoding) -> None:
    image = image_of(picture(encoding), encoding, padding=3)
    view = view_of(image)
    assert np.shares_memory(view, np.frombuffer(image.data, np.uint8))
    assert not view.flags.owndata


@pytest.mark.parametrize(
    ('encoding', 'settings'),
    [
        pytest.param(encoding, settings, id=f'{encoding} {settings.codec}')
        for encoding, layout in PIXEL_FORMATS.items()
        for settings in EXACT
        if layout.depth in CODECS[settings.codec].depths
    ],
)
@pytest.mark.parametrize('region', [(0, 0, WIDTH, HEIGHT), (4, 6, 5, 7), (2, 4, 22, 10)], ids=str)
def test_lossless_is_exact_to_the_bit(encoding, settings, region) -> None:
    layout = PIXEL_FORMATS[encoding]
    seen = picture(encoding)
    if seen.shape[2] == 4:
        seen[:10, :, 3] = 0
    chip = cut(view_of(image_of(seen, encoding)), region, layout)
    got = decoded(encode(chip, settings), chip.dtype)
    # A codec without grey holds it as equal channels.
    assert got.shape[2] in {1, 3} if chip.shape[2] == 1 else got.shape == chip.shape
    np.testing.assert_array_equal(got, np.broadcast_to(chip, got.shape))


@pytest.mark.parametrize('encoding', ['mono8', 'rgb8', 'bgra8', 'bayer_grbg8'])
@pytest.mark.parametrize('codec', ['jpeg', 'webp', 'jpeg2000'])
def test_lossy_gets_smaller_with_quality_and_stays_close(encoding, codec) -> None:
    layout = PIXEL_FORMATS[encoding]
    x, y, c = np.meshgrid(np.arange(64), np.arange(64), np.arange(len(layout.channels)))
    texture = np.random.default_rng(0).integers(0, 4, x.shape)
    chip = (100 + x + 0.5 * y + 5 * c + texture).astype(np.uint8)
    sizes = [len(encode(chip, CodecSettings(codec, quality))) for quality in (5, 95)]
    assert sizes[0] < sizes[1]
    got = decoded(encode(chip, CodecSettings(codec, 95)), np.int64)
    assert np.abs(got[..., 0] - chip[..., 0]).mean() < 4


@pytest.mark.parametrize(('side', 'is_smaller'), [(64, True), (1000, True), (1001, False)])
def test_a_jpeg_up_to_a_million_pixels_is_smaller_with_the_same_pixels(side, is_smaller) -> None:
    chip = np.random.default_rng(0).integers(90, 110, (side, side, 3), np.uint8)
    plain = io.BytesIO()
    Image.fromarray(chip).save(plain, 'jpeg', quality=85)
    data = encode(chip, CodecSettings('jpeg', 85))
    assert (len(data) < len(plain.getvalue())) is is_smaller
    np.testing.assert_array_equal(
        decoded(data, np.uint8), decoded(plain.getvalue(), np.uint8), strict=True
    )


def test_a_picture_that_pillow_cannot_make_smaller_is_a_jpeg_all_the_same() -> None:
    hard = np.random.default_rng(0).integers(0, 2, (300, 300, 3), np.uint8) * np.uint8(255)
    with pytest.raises(OSError, match='broken data stream'):
        Image.fromarray(hard).save(io.BytesIO(), 'jpeg', quality=94, optimize=True)
    assert decoded(encode(hard, CodecSettings('jpeg', 94)), np.uint8).shape == hard.shape


@pytest.mark.parametrize('encoding', PIXEL_FORMATS)
@pytest.mark.parametrize('codec', CODECS)
def test_a_codec_that_cannot_hold_the_depth_is_refused_with_those_that_can(encoding, codec) -> None:
    if PIXEL_FORMATS[encoding].depth == 16 and codec in {'jpeg', 'webp'}:
        with pytest.raises(ChipError, match=f'{codec} .* 16 bits .* {encoding}; use png, jpeg2000'):
            pixel_format(encoding, codec)
    else:
        assert pixel_format(encoding, codec) is PIXEL_FORMATS[encoding]


@pytest.mark.parametrize('encoding', ['', 'yuv420', '32FC1', 'RGB8'])
def test_an_unknown_encoding_is_refused_with_those_known(encoding) -> None:
    with pytest.raises(ChipError, match=f"encoding '{encoding}' .* mono8, mono16, rgb8"):
        pixel_format(encoding, 'png')


@pytest.mark.parametrize('encoding', ['rgb16', 'bgr16', 'rgba16', 'bgra16', '16UC3', '16UC4'])
def test_colours_of_16_bits_are_refused_with_the_reason(encoding) -> None:
    with pytest.raises(ChipError, match=f'{encoding} has several channels of 16 bits'):
        pixel_format(encoding, 'png')


def test_a_mosaic_of_16_bits_is_not_developed() -> None:
    with pytest.raises(ChipError, match='bayer_rggb16, developed, has several channels of 16 bits'):
        pixel_format('bayer_rggb16', 'png', develop=True)
    assert pixel_format('bayer_rggb16', 'png').bayer


@pytest.mark.parametrize(
    ('wrong', 'message'),
    [
        ({'width': 0}, '0 x 29'),
        ({'height': 0}, '37 x 0'),
        ({'step': 110}, 'step is 110.*111'),
        ({'height': 30}, r'3219 bytes, but the image needs 3330'),
        ({'data': memoryview(b'')}, '0 b'),
    ],
)
def test_an_image_that_contradicts_itself_is_refused_with_the_numbers(wrong, message) -> None:
    image = image_of(picture('rgb8'), 'rgb8')
    with pytest.raises(ChipError, match=message):
        view_of(WireImage(**{**vars(image), **wrong}))


def test_the_padding_of_the_last_row_may_be_missing() -> None:
    seen = picture('mono8')
    image = image_of(seen, 'mono8', padding=3)
    view = view_of(WireImage(**{**vars(image), 'data': image.data[:-3]}))
    np.testing.assert_array_equal(view, seen)


SIDE = st.integers(-50, 100)


@given(st.sampled_from(['mono8', 'bayer_rggb16']), SIDE, SIDE, SIDE, SIDE)
def test_a_region_is_placed_inside_the_image(encoding, x0, y0, x1, y1) -> None:
    layout = PIXEL_FORMATS[encoding]
    place = placed((x0, y0, x1, y1), (WIDTH, HEIGHT), layout)
    overlap = range(max(x0, 0), min(x1, WIDTH)), range(max(y0, 0), min(y1, HEIGHT))
    if not all(overlap):
        # Growing to whole cells may reach into the image, but never where nothing was asked for.
        assert place is None or layout.bayer
        return
    left, top, right, bottom = place
    assert left in {overlap[0].start, overlap[0].start - 1}
    assert top in {overlap[1].start, overlap[1].start - 1}
    assert right in {overlap[0].stop, overlap[0].stop + 1}
    assert bottom in {overlap[1].stop, overlap[1].stop + 1}
    assert 0 <= left < right <= WIDTH
    assert 0 <= top < bottom <= HEIGHT
    if layout.bayer:
        assert left % 2 == top % 2 == 0
    else:
        assert (left, top) == (overlap[0].start, overlap[1].start)


@pytest.mark.parametrize(
    ('encoding', 'codec', 'text'),
    [
        ('rgb8', 'jpeg', 'rgb8; jpeg compressed bgr8'),
        ('bgr8', 'png', 'bgr8; png compressed bgr8'),
        ('rgba8', 'jpeg', 'rgba8; jpeg compressed bgr8'),
        ('rgba8', 'png', 'rgba8; png compressed bgra8'),
        ('mono16', 'png', 'mono16; png compressed '),
        ('mono8', 'webp', 'mono8; webp compressed bgr8'),
        ('bayer_rggb8', 'jpeg2000', 'bayer_rggb8; jpeg2000 compressed '),
    ],
)
def test_the_format_text_is_that_of_image_transport(encoding, codec, text) -> None:
    assert format_text(encoding, codec) == text


@pytest.mark.parametrize(
    ('wrong', 'message'),
    [
        ({'codec': 'gif'}, '^codec must be one of jpeg'),
        ({'quality': 0}, '^quality must be 1'),
        ({'quality': 101}, '^quality'),
        ({'codec': 'jpeg', 'lossless': True}, '^lossless: jpeg'),
    ],
)
def test_settings_that_cannot_be_are_an_error_that_names_them(wrong, message) -> None:
    with pytest.raises(ValueError, match=message):
        CodecSettings(**wrong)


def chips_and_failures(view, regions, codec):
    """Cut regions; return index and place of each chip, or why there is none, and the failures."""
    failures = []
    cutter = ChipCutter(
        view, PIXEL_FORMATS['mono8'], codec, lambda *failure: failures.append(failure)
    )
    chips = [cutter.cut(index, region) for index, region in enumerate(regions)]
    return [
        chip if isinstance(chip, Dropped) else (chip.index, chip.region) for chip in chips
    ], failures


def test_a_region_outside_the_image_gives_no_chip() -> None:
    outside, empty = (500, 0, 510, 10), (9, 9, 9, 9)
    chips, failures = chips_and_failures(
        np.zeros((40, 40, 1), np.uint8), [outside, (0, 0, 4, 4), empty], CodecSettings('png')
    )
    assert chips == [Dropped.OUTSIDE, (1, (0, 0, 4, 4)), Dropped.OUTSIDE]
    assert failures == []


def test_a_chip_that_the_format_cannot_hold_is_reported() -> None:
    wide = np.zeros((1, 20_000, 1), np.uint8)
    regions = [(0, 0, 20_000, 1), (-9, 0, 4, 1)]
    chips, failures = chips_and_failures(wide, regions, CodecSettings('webp'))
    assert chips == [Dropped.ENCODER, (1, (0, 0, 4, 1))]
    ((region, error),) = failures
    assert region == (0, 0, 20_000, 1)
    assert isinstance(error, (ValueError, OSError))
