# SPDX-License-Identifier: Apache-2.0
"""Colours of regions: YUV by the formula of BT.601, Bayer mosaics by the mean of neighbours."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from obbhbb_ros.downlink.chips import ChipError
from obbhbb_ros.downlink.chips import cut
from obbhbb_ros.downlink.chips import format_text
from obbhbb_ros.downlink.chips import pixel_format
from obbhbb_ros.downlink.chips import placed
from obbhbb_ros.downlink.chips import view_of
from obbhbb_ros.downlink.pixel_views import YUV_LAYOUTS
from obbhbb_ros.wire.image import WireImage

WIDTH, HEIGHT = 22, 14
# Order of the samples of a cell, and its width and height; in two planes those of U and V.
PACKED = {'yuv422': 'uyvy', 'uyvy': 'uyvy', 'yuv422_yuy2': 'yuyv', 'yuyv': 'yuyv'}
PLANAR = {'nv12': ('uv', 2), 'nv21': ('vu', 2), 'nv24': ('uv', 1)}


def image_in(encoding, rows, step, height=HEIGHT):
    data = memoryview(np.ascontiguousarray(rows, np.uint8).tobytes())
    return WireImage((1, 2), 'camera', encoding, WIDTH, height, step, False, data)


def yuv_of(encoding, padding):
    """Make up an image; return it, and Y, U and V of its pixels."""
    random = np.random.default_rng(len(encoding) + padding)
    cell = (1, 2) if encoding in PACKED else (PLANAR[encoding][1],) * 2
    y = random.integers(0, 256, (HEIGHT, WIDTH))
    u, v = random.integers(0, 256, (2, HEIGHT // cell[0], WIDTH // cell[1]))
    step = WIDTH * (2 if encoding in PACKED else 1) + padding
    if encoding in PACKED:
        rows = np.full((HEIGHT, step), 0xA5)
        order = PACKED[encoding]
        cells = rows[:, : 2 * WIDTH].reshape(HEIGHT, WIDTH // 2, 4)
        cells[..., order.index('u')], cells[..., order.index('v')] = u, v
        cells[..., order.index('y')], cells[..., order.rindex('y')] = y[:, ::2], y[:, 1::2]
        rows[:, : 2 * WIDTH] = cells.reshape(HEIGHT, -1)
    else:
        chroma = np.stack([{'u': u, 'v': v}[name] for name in PLANAR[encoding][0]], axis=-1)
        chroma = chroma.reshape(len(chroma), -1)
        width = step * 2 // cell[1]
        chroma = np.pad(chroma, ((0, 0), (0, width - chroma.shape[1])))
        luma = np.pad(y, ((0, 0), (0, padding)), constant_values=0xA5)
        rows = np.concatenate((luma.ravel(), chroma.ravel()))
    whole = [plane.repeat(cell[0], 0).repeat(cell[1], 1) for plane in (u, v)]
    return image_in(encoding, rows, step), (y, *whole)


def converted(y, u, v):
    """Convert by BT.601, limited range."""
    luma, u, v = 1.164383 * np.maximum(y - 16.0, 0.0), u - 128.0, v - 128.0
    rgb = (luma + 1.596027 * v, luma - 0.391762 * u - 0.812968 * v, luma + 2.017232 * u)
    return np.clip(np.stack(rgb, axis=-1), 0.0, 255.0)


REGIONS = [(0, 0, WIDTH, HEIGHT), (3, 5, 4, 6), (7, 1, 20, 12), (20, 12, WIDTH, HEIGHT)]


@pytest.mark.parametrize('region', REGIONS, ids=str)
@pytest.mark.parametrize('padding', [0, 6])
@pytest.mark.parametrize('encoding', YUV_LAYOUTS)
def test_the_chip_of_a_yuv_image_has_its_colours_and_just_its_region(
    encoding, padding, region
) -> None:
    image, samples = yuv_of(encoding, padding)
    layout = pixel_format(encoding, 'jpeg')
    assert placed(region, (WIDTH, HEIGHT), layout) == region
    x0, y0, x1, y1 = region
    chip = cut(view_of(image), region, layout)
    expected = converted(*samples)[y0:y1, x0:x1]
    assert chip.dtype == np.uint8
    # OpenCV's factors have three decimals.
    assert np.abs(chip - expected).max() < 1.0


def test_reference_colours_of_bt_601() -> None:
    colors = {
        (16, 128, 128): (0, 0, 0),
        (235, 128, 128): (255, 255, 255),
        (81, 90, 240): (255, 0, 0),
        (145, 54, 34): (0, 255, 0),
        (41, 240, 110): (0, 0, 255),
    }
    for (y, u, v), color in colors.items():
        image = image_in('uyvy', np.tile([u, y, v, y], HEIGHT * WIDTH // 2), 2 * WIDTH)
        chip = view_of(image).rgb((2, 2, 4, 4))
        assert np.abs(chip.astype(int) - color).max() <= 1


@pytest.mark.parametrize('encoding', YUV_LAYOUTS)
def test_a_yuv_image_that_contradicts_itself_is_refused(encoding) -> None:
    image, _ = yuv_of(encoding, 0)
    view_of(image)
    with pytest.raises(ChipError, match='but the image needs'):
        view_of(WireImage(**{**vars(image), 'data': image.data[:-1]}))
    with pytest.raises(ChipError, match='step is'):
        view_of(WireImage(**{**vars(image), 'step': image.step - 1}))


def test_an_incomplete_cell_is_refused() -> None:
    image, _ = yuv_of('nv12', 0)
    with pytest.raises(ChipError, match='whole cells of 2 x 2 pixels, and the image has 21 x 14'):
        view_of(WireImage(**{**vars(image), 'width': 21}))


# Bayer ----------------------------------------------------------------------------------------

PATTERNS = ['rggb', 'bggr', 'gbrg', 'grbg']


def mosaic_of(pattern, rgb):
    """Take of every pixel the colour that the pattern has there."""
    rows, columns = np.indices(rgb.shape[:2])
    cell = np.array(['rgb'.index(color) for color in pattern]).reshape(2, 2)
    return np.take_along_axis(rgb, cell[rows % 2, columns % 2][..., None], 2)[..., 0]


def developed(pattern, rgb, region):
    image = image_in(f'bayer_{pattern}8', mosaic_of(pattern, rgb), WIDTH)
    return view_of(image, develop=True).rgb(region)


@pytest.mark.parametrize('pattern', PATTERNS)
def test_one_colour_is_developed_exactly_up_to_the_border(pattern) -> None:
    rgb = np.full((HEIGHT, WIDTH, 3), (250, 7, 93))
    np.testing.assert_array_equal(developed(pattern, rgb, (0, 0, WIDTH, HEIGHT)), rgb)


@pytest.mark.parametrize('pattern', PATTERNS)
def test_a_ramp_is_developed_exactly_inside(pattern) -> None:
    rows, columns = np.indices((HEIGHT, WIDTH))
    rgb = np.stack((4 * rows + 2 * columns, 100 + 2 * rows, 200 - 4 * columns), axis=-1)
    whole = developed(pattern, rgb, (0, 0, WIDTH, HEIGHT))
    np.testing.assert_array_equal(whole[1:-1, 1:-1], rgb[1:-1, 1:-1])


@pytest.mark.parametrize('pattern', PATTERNS)
@given(
    x=st.tuples(st.integers(0, WIDTH - 1), st.integers(1, WIDTH)),
    y=st.tuples(st.integers(0, HEIGHT - 1), st.integers(1, HEIGHT)),
)
def test_a_region_is_the_part_of_the_developed_image(pattern, x, y) -> None:
    (x0, width), (y0, height) = x, y
    x1, y1 = min(x0 + width, WIDTH), min(y0 + height, HEIGHT)
    rgb = np.random.default_rng(3).integers(0, 256, (HEIGHT, WIDTH, 3))
    whole = developed(pattern, rgb, (0, 0, WIDTH, HEIGHT))
    np.testing.assert_array_equal(developed(pattern, rgb, (x0, y0, x1, y1)), whole[y0:y1, x0:x1])


def test_a_developed_chip_may_begin_anywhere_and_says_that_it_has_colours() -> None:
    layout = pixel_format('bayer_rggb8', 'jpeg', develop=True)
    assert placed((3, 5, 8, 9), (WIDTH, HEIGHT), layout) == (3, 5, 8, 9)
    text = format_text('bayer_rggb8', 'jpeg', develop=True)
    assert text == 'bayer_rggb8; jpeg compressed bgr8'
