# SPDX-License-Identifier: Apache-2.0
"""Pictures with boxes and labels over them: pixels, sizes, labels, and whatever may go wrong."""

from __future__ import annotations

import io
from itertools import combinations
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from obbhbb_ros.colors import LAYER_COLORS
from obbhbb_ros.colors import ORIENTED_COLOR
from obbhbb_ros.downlink.chips import PIXEL_FORMATS
from obbhbb_ros.geometry.boxes import OrientedBoxes
from obbhbb_ros.overlay.drawing import Layer
from obbhbb_ros.overlay.drawing import OverlayError
from obbhbb_ros.overlay.drawing import Style
from obbhbb_ros.overlay.drawing import draw
from obbhbb_ros.overlay.drawing import lines
from obbhbb_ros.overlay.drawing import picture_of
from obbhbb_ros.overlay.lettering import Labels
from obbhbb_ros.overlay.lettering import label_text
from obbhbb_ros.overlay.outlines import Color
from obbhbb_ros.overlay.outlines import clipped
from obbhbb_ros.overlay.outlines import dashes
from obbhbb_ros.overlay.outlines import ink_on
from obbhbb_ros.overlay.outlines import rgb
from obbhbb_ros.study.chip_costs import render
from obbhbb_ros.study.harbour import harbour
from obbhbb_ros.wire.image import WireImage

PIL = pytest.importorskip('PIL.Image')

RED, WHITE = (255, 0, 0), (255, 255, 255)
SHARP = Style(quality=100, labels=False)
NOTHING = np.empty((0, 4, 2))


def image_of(
    pixels: NDArray[Any], encoding: str = 'rgb8', padding: int = 0, big: bool = False
) -> WireImage:
    height, width = pixels.shape[:2]
    stored = pixels.astype(pixels.dtype.newbyteorder('>')) if big else pixels
    rows = stored.reshape(height, -1).view(np.uint8)
    padded = np.hstack((rows, np.full((height, padding), 77, np.uint8)))
    # The last row need not be padded.
    data = padded.tobytes()[: padded.size - padding]
    return WireImage(
        (1, 2), 'camera', encoding, width, height, padded.shape[1], big, memoryview(data)
    )


def grey(width: int, height: int, value: int = 128) -> WireImage:
    return image_of(np.full((height, width, 3), value, np.uint8))


def corners(*rows: tuple[float, float, float, float, float]) -> NDArray[np.float64]:
    return OrientedBoxes.from_xywhr(rows).corners


def drawn(image: WireImage, *layers: Layer, style: Style = SHARP) -> NDArray[np.int64]:
    with PIL.open(io.BytesIO(draw(image, layers, None, style).data)) as file:
        return np.asarray(file).astype(int)


def is_like(pixel: NDArray[np.int64], color: tuple[int, int, int]) -> bool:
    return bool(np.abs(pixel - color).max() < 50)


def test_the_lines_of_a_box_lie_on_its_edges_with_a_rim_outside() -> None:
    pixels = drawn(grey(200, 100), Layer('#ff0000', corners((100, 50, 80, 40, 0))))
    for x, y in ((60, 50), (140, 50), (100, 30), (100, 70), (60, 30), (140, 70)):
        assert is_like(pixels[y, x], RED), (x, y)
    for x, y in ((59, 50), (141, 50), (100, 29), (100, 71)):
        assert is_like(pixels[y, x], WHITE), (x, y)
    for x, y in ((62, 50), (100, 50), (57, 50), (100, 74)):
        assert is_like(pixels[y, x], (128, 128, 128)), (x, y)


def test_an_oriented_box_is_drawn_as_it_lies() -> None:
    pixels = drawn(grey(200, 200), Layer('#ff0000', corners((100, 100, 100, 40, np.pi / 4))))
    # The middle of each edge, and the corners of the box around it.
    for along, across in ((50, 0), (-50, 0), (0, 20), (0, -20)):
        x, y = 100 + (along - across) / np.sqrt(2), 100 + (along + across) / np.sqrt(2)
        around = pixels[int(y) - 1 : int(y) + 2, int(x) - 1 : int(x) + 2].reshape(-1, 3)
        assert any(is_like(pixel, RED) for pixel in around), (along, across)
    assert is_like(pixels[60, 140], (128, 128, 128))


def test_a_later_layer_lies_above_an_earlier_one() -> None:
    same = corners((100, 50, 80, 40, 0))
    pixels = drawn(grey(200, 100), Layer('#0000ff', same), Layer('#ff0000', same))
    assert is_like(pixels[50, 60], RED)


@pytest.mark.parametrize(('side', 'width'), [(256, 1), (1024, 2), (4096, 7)])
def test_lines_grow_with_the_picture(side: int, width: int) -> None:
    middle, size = side / 2, side / 4
    pixels = drawn(grey(side, side), Layer('#ff0000', corners((middle, middle, size, size, 0))))
    row = pixels[side // 2, : side // 2]
    assert sum(is_like(pixel, RED) for pixel in row) == width


@pytest.mark.parametrize('scale', [1.0, 0.5, 0.1])
def test_the_picture_shrinks_with_everything_in_it(scale: float) -> None:
    image = grey(400, 300)
    pixels = drawn(
        image,
        Layer('#ff0000', corners((200, 150, 200, 100, 0))),
        style=Style(scale=scale, quality=100),
    )
    assert pixels.shape == (round(300 * scale), round(400 * scale), 3)
    x, y = int(100 * scale), int(150 * scale)
    assert is_like(pixels[y, x], RED)


def test_what_is_outside_far_away_or_not_finite_harms_nothing() -> None:
    far = corners((100, 50, 1e6, 40, 0), (1e9, 1e9, 50, 50, 1), (-500, 50, 80, 40, 0.5))
    bad = np.full((3, 4, 2), np.nan)
    bad[0] = np.inf
    bad[1, :3] = 5.0
    boxes = np.concatenate((far, bad, np.full((1, 4, 2), 50.0)))
    labels = Labels('#000000', boxes, ['ship'] * 7, np.full(7, np.nan))
    draw(grey(200, 100), [Layer('#ff0000', boxes)], labels, Style())
    pixels = drawn(grey(200, 100), Layer('#ff0000', boxes[:6]))
    # A box that is wider than the picture: its long edges cross it.
    assert all(is_like(pixels[30, x], RED) and is_like(pixels[70, x], RED) for x in (0, 100, 199))
    assert is_like(pixels[50, 100], (128, 128, 128))


def test_a_picture_without_boxes_is_the_image() -> None:
    assert (drawn(grey(64, 48), Layer('#ff0000', NOTHING)) == 128).all()
    pixels = np.random.default_rng(1).integers(0, 255, (48, 64, 3)).astype(np.uint8)
    assert (np.asarray(picture_of(image_of(pixels))) == pixels).all()


# Encodings ------------------------------------------------------------------------------------


@pytest.mark.parametrize('padding', [0, 6])
@pytest.mark.parametrize('encoding', PIXEL_FORMATS)
def test_every_encoding_is_shown_with_padded_rows_or_without(encoding: str, padding: int) -> None:
    layout = PIXEL_FORMATS[encoding]
    ramp = np.linspace(0, 2**layout.depth - 1, 40).astype(f'u{layout.depth // 8}')
    seen = np.zeros((30, 40, len(layout.channels)), ramp.dtype)
    seen[..., 0] = ramp
    stored = np.empty_like(seen)
    stored[..., layout.channels] = seen
    shown = np.asarray(picture_of(image_of(stored, encoding, padding))).astype(int)
    assert np.abs(shown[:, 1:-1, 0] - np.linspace(0, 255, 40)[1:-1]).max() < 6
    others = ramp if len(layout.channels) == 1 else np.zeros(40)
    expected = others.astype(float) / 2 ** (layout.depth - 8)
    assert np.abs(shown[:, 1:-1, 1:] - expected[1:-1, None]).max() < 6


@pytest.mark.parametrize('encoding', ['yuv422', 'uyvy'])
def test_yuv_is_shown_in_its_colours(encoding: str) -> None:
    red = np.tile(np.array([[90, 81], [240, 81]], np.uint8), (30, 20, 1))
    shown = np.asarray(picture_of(image_of(red, encoding))).astype(int)
    assert shown.shape == (30, 40, 3)
    assert np.abs(shown - (255, 0, 0)).max() <= 1


@pytest.mark.parametrize('big', [False, True])
def test_sixteen_bits_are_stretched_to_what_the_picture_has(big: bool) -> None:
    twelve_bits = np.tile(np.linspace(1000, 3000, 100).astype(np.uint16), (50, 1))
    shown = np.asarray(picture_of(image_of(twelve_bits, 'mono16', big=big)))
    assert shown.min() < 5
    assert shown.max() > 250
    flat = np.full((5, 5), 1234, np.uint16)
    assert np.ptp(np.asarray(picture_of(image_of(flat, 'mono16')))) == 0


@pytest.mark.parametrize(
    ('change', 'reason'),
    [
        ({'encoding': '32FC1'}, "encoding '32FC1' cannot be shown, only mono8"),
        ({'height': 1000}, 'data has'),
        ({'step': 10}, 'step is 10'),
        ({'width': 0}, 'the image is empty'),
    ],
)
def test_an_image_that_cannot_be_shown_is_refused_with_a_reason(change, reason: str) -> None:
    given = vars(grey(20, 10)) | change
    with pytest.raises(OverlayError, match=reason):
        draw(WireImage(**given), [], None, Style())


def test_a_picture_that_jpeg_cannot_hold_is_refused() -> None:
    with pytest.raises(OverlayError, match='jpeg cannot hold a picture of 65501 x 1 pixels'):
        draw(image_of(np.zeros((1, 65_501), np.uint8), 'mono8'), [], None, Style())


@pytest.mark.parametrize('values', [{'scale': 0.0}, {'scale': 1.5}, {'quality': 0}])
def test_a_style_out_of_range_is_refused(values: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=next(iter(values))):
        Style(**values)


# Labels ---------------------------------------------------------------------------------------


def labelled(
    image: WireImage, *rows: Any, scores: Any = None, labels: bool = True
) -> tuple[NDArray[np.int64], int]:
    boxes = corners(*rows)
    given = np.linspace(0.9, 0.1, len(rows)) if scores is None else np.array(scores)
    texts = [label_text('ship', score) for score in given.tolist()]
    style = Style(quality=100, labels=labels)
    picture = draw(image, [], Labels('#ff0000', boxes, texts, given), style)
    with PIL.open(io.BytesIO(picture.data)) as file:
        return np.asarray(file).astype(int), picture.labels_left_out


def red_rows(pixels: NDArray[np.int64]) -> NDArray[np.intp]:
    return np.flatnonzero((np.abs(pixels - RED).max(axis=2) < 50).any(axis=1))


def test_a_label_stands_above_its_box_and_below_it_at_the_upper_border() -> None:
    pixels, left_out = labelled(grey(200, 100), (100, 60, 80, 20, 0))
    assert left_out == 0
    assert 25 < red_rows(pixels).min() < red_rows(pixels).max() < 50
    # White on red.
    assert any(is_like(pixel, WHITE) for pixel in pixels[25:50].reshape(-1, 3))
    pixels, _ = labelled(grey(200, 100), (100, 50, 80, 98, 0))
    assert red_rows(pixels).size


@pytest.mark.parametrize(('side', 'height'), [(256, 10), (1024, 16), (4096, 64)])
def test_texts_grow_with_the_picture_and_never_below_ten_pixels(side: int, height: int) -> None:
    pixels, _ = labelled(grey(side, side), (side / 2, side / 2, side / 8, side / 8, 0))
    rows = red_rows(pixels)
    assert height <= rows.max() - rows.min() + 1 <= 1.7 * height


def test_where_two_labels_have_no_room_the_better_score_is_written() -> None:
    # The middle of each box must stay visible as well.
    rows = [(50.0 + 4 * i, 50.0, 6.0, 6.0, 0.0) for i in range(10)]
    pixels, left_out = labelled(grey(200, 100), *rows)
    assert 5 < left_out < 10
    for x, y, *_ in rows:
        assert is_like(pixels[int(y), int(x)], (128, 128, 128))
    alone, none_left_out = labelled(grey(200, 100), rows[0])
    assert none_left_out == 0
    reverse, _ = labelled(grey(200, 100), *rows[::-1], scores=np.linspace(0.1, 0.9, 10))
    assert (pixels == reverse).all()
    first = red_rows(alone)
    assert (pixels[first[0] + 2, 48:52] == alone[first[0] + 2, 48:52]).all()


@pytest.mark.parametrize('side', [256, 1024, 4096])
def test_the_legend_names_the_layers_in_a_corner_that_no_label_enters(side: int) -> None:
    layers = [Layer('#0000ff', NOTHING, 'boxes'), Layer('#00ff00', NOTHING, 'detections')]
    image = grey(side, side)

    def pixels_with(style: Style, labels: Labels | None = None) -> NDArray[np.int64]:
        with PIL.open(io.BytesIO(draw(image, layers, labels, style).data)) as file:
            return np.asarray(file).astype(int)

    alone = pixels_with(Style(quality=100))
    changed = np.abs(alone - 128).max(axis=2) > 20
    y, x = np.nonzero(changed)
    assert (x.min(), y.max()) == (0, side - 1)
    assert side / 40 < np.ptp(x) < side / 3
    assert side / 40 < np.ptp(y) < side / 3
    # The upper layer comes first.
    assert red_rows(alone[..., [1, 0, 2]]).min() < red_rows(alone[..., [2, 1, 0]]).min()
    # Boxes whose labels would lie in the legend.
    step = side / 30
    rows = [(i * step, side - j * step, 3.0, 3.0, 0.0) for i in range(1, 12) for j in range(12)]
    labels = Labels('#ff0000', corners(*rows), ['ship'] * len(rows), np.ones(len(rows)))
    full = pixels_with(Style(quality=100), labels)
    assert (full != alone).any()
    inside = np.s_[y.min() + 8 : side, 0 : x.max() - 8]
    assert np.abs(full[inside] - alone[inside]).max() < 30
    assert (pixels_with(Style(quality=100, legend=False)) == 128).all()


def test_a_small_picture_and_layers_without_a_name_have_no_legend() -> None:
    for image, title in ((grey(100, 60), 'boxes'), (grey(512, 512), '')):
        picture = draw(image, [Layer('#ff0000', NOTHING, title)], None, Style())
        with PIL.open(io.BytesIO(picture.data)) as file:
            assert (np.asarray(file) == 128).all()


def test_labels_can_be_switched_off() -> None:
    pixels, left_out = labelled(grey(200, 100), (100, 60, 80, 20, 0), labels=False)
    assert left_out == red_rows(pixels).size == 0


def test_a_box_outside_has_no_label() -> None:
    pixels, left_out = labelled(grey(200, 100), (300, 60, 80, 20, 0))
    assert left_out == red_rows(pixels).size == 0


@pytest.mark.parametrize(
    ('class_id', 'score', 'text'),
    [
        ('ship', 1.0, 'ship 1.00'),
        ('', 0.5, '0.50'),
        ('', np.nan, ''),
        ('a\nb\0', 0.5, 'a?b? 0.50'),
        ('x' * 100, 0.5, 'x' * 23 + '… 0.50'),
        ('x' * 24, np.nan, 'x' * 24),
        ('ship', np.inf, 'ship inf'),
    ],
)
def test_a_label_is_one_short_line(class_id: str, score: float, text: str) -> None:
    assert label_text(class_id, score) == text


# Colours and edges ----------------------------------------------------------------------------


def luminance(color: Color) -> float:
    """Return the relative luminance of WCAG."""
    values = np.array(color) / 255.0
    linear = np.where(values <= 0.04045, values / 12.92, ((values + 0.055) / 1.055) ** 2.4)
    return float(linear @ (0.2126, 0.7152, 0.0722))


def contrast(one: Color, other: Color) -> float:
    darker, lighter = sorted((luminance(one), luminance(other)))
    return (lighter + 0.05) / (darker + 0.05)


def test_layers_have_a_contrast_of_three_to_each_other_and_to_their_rim() -> None:
    colors = [rgb(color) for color in LAYER_COLORS.values()]
    assert all(contrast(*pair) >= 3.0 for pair in combinations(colors, 2))
    assert all(contrast(color, ink_on(color)) >= 3.0 for color in colors)


@pytest.mark.parametrize('layer', LAYER_COLORS)
def test_a_layer_or_its_rim_has_a_contrast_of_three_on_the_sea_and_on_white_decks(
    layer: str,
) -> None:
    sea: Color = tuple(np.median(render(harbour()), axis=(0, 1)))
    color = rgb(LAYER_COLORS[layer])
    for background in (sea, WHITE):
        assert max(contrast(ink, background) for ink in (color, ink_on(color))) >= 3.0
    # Nothing that is dark enough for white decks and for the brightest layer is so for the sea.
    assert contrast(color, sea) >= 3.0 or color == rgb(ORIENTED_COLOR)


def test_a_light_line_has_a_dark_rim() -> None:
    pixels = drawn(grey(200, 100), Layer('#ffff00', corners((100, 50, 80, 40, 0))))
    assert is_like(pixels[50, 60], (255, 255, 0))
    assert is_like(pixels[50, 59], (0, 0, 0))


def test_dashes_are_half_of_a_line_and_hold_its_corners() -> None:
    box = corners((100, 50, 84, 42, 0))
    solid, dashed = (
        (np.abs(drawn(grey(200, 100), layer) - RED).max(axis=2) < 50)
        for layer in (Layer('#ff0000', box), Layer('#ff0000', box, dashed=True))
    )
    assert 0.4 < dashed.sum() / solid.sum() < 0.7
    assert all(dashed[y, x] for x in (58, 142) for y in (29, 71))


def test_dashes_of_a_box_beyond_the_picture_are_as_long_as_those_inside() -> None:
    huge = dashes(clipped(lines(corners((0, 50, 1e7, 40, 0))), np.zeros(2), np.full(2, 200.0)), 4.0)
    assert huge.shape[0] == 2 * 25
    assert np.hypot(*(huge[:, 1] - huge[:, 0]).T) == pytest.approx(200 / 49)
    assert dashes(NOTHING.reshape(-1, 2, 2), 4.0).shape == (0, 2, 2)
    assert (dashes(np.full((1, 2, 2), 5.0), 4.0) == 5.0).all()


def test_edges_go_around_each_finite_box() -> None:
    boxes = np.concatenate((np.full((1, 4, 2), np.nan), corners((10, 20, 8, 4, 0))))
    edges = lines(boxes)
    assert edges.shape == (4, 2, 2)
    assert (edges[:, 1] == np.roll(edges[:, 0], -1, axis=0)).all()
    assert {tuple(corner) for corner in edges[:, 0].tolist()} == {
        (6, 18),
        (14, 18),
        (14, 22),
        (6, 22),
    }
