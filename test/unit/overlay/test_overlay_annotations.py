# SPDX-License-Identifier: Apache-2.0
"""Lines and texts for viewers that draw them over an image themselves."""

from __future__ import annotations

import numpy as np
import pytest

from obbhbb_ros.geometry.boxes import OrientedBoxes
from obbhbb_ros.overlay.annotating import annotate
from obbhbb_ros.overlay.drawing import Layer
from obbhbb_ros.overlay.drawing import Style
from obbhbb_ros.overlay.lettering import Labels

pytest.importorskip('PIL')

SIZE = (1024, 768)
CORNERS = OrientedBoxes.from_xywhr([(300, 200, 80, 40, 0)]).corners
BLACK, WHITE = (0, 0, 0), (255, 255, 255)


def layer(dashed: bool = False, corners: object = CORNERS) -> Layer:
    return Layer('#000000', np.asarray(corners), 'detections', dashed)


def labels(texts: list[str], scores: list[float]) -> Labels:
    corners = np.concatenate([CORNERS] * len(texts))
    return Labels('#000000', corners, texts, np.array(scores))


def test_a_box_has_its_lines_over_a_rim_that_stands_out() -> None:
    rim, line = annotate(SIZE, [layer()], None, Style(line_width=3)).strokes
    assert (rim.color, rim.width, line.color, line.width) == (WHITE, 1, BLACK, 3)
    assert len(rim.segments) == len(line.segments) == 4
    # Half a line longer, so that corners have no notches.
    low, high = line.segments.reshape(-1, 2).min(axis=0), line.segments.reshape(-1, 2).max(axis=0)
    np.testing.assert_allclose((low, high), [(259, 179), (341, 221)])


def test_a_dashed_layer_has_dashes_within_the_image_alone() -> None:
    _, line = annotate(SIZE, [layer(dashed=True)], None, Style(line_width=3)).strokes
    assert len(line.segments) == 12
    lengths = np.hypot(*(line.segments[:, 1] - line.segments[:, 0]).T)
    assert lengths.max() < 18.0
    huge = OrientedBoxes.from_xywhr([(500, 400, 1e9, 100, 0)]).corners
    _, line = annotate(SIZE, [layer(dashed=True, corners=huge)], None, Style()).strokes
    assert 0 < len(line.segments) < 1000
    assert np.abs(line.segments).max() < 1100


def test_the_scale_of_the_picture_does_not_count() -> None:
    small, full = (annotate(SIZE, [layer()], None, Style(scale=scale)) for scale in (0.1, 1.0))
    for one, other in zip(small.strokes, full.strokes, strict=True):
        np.testing.assert_array_equal(one.segments, other.segments)


@pytest.mark.parametrize('corners', [np.empty((0, 4, 2)), np.full((1, 4, 2), np.nan)])
def test_a_layer_without_boxes_has_lines_without_points(corners: object) -> None:
    strokes = annotate(SIZE, [layer(corners=corners)], None, Style()).strokes
    assert [len(stroke.segments) for stroke in strokes] == [0, 0]


def test_labels_stand_above_their_boxes_as_far_as_there_is_room() -> None:
    three = labels(['worse', 'best', 'good'], [0.5, 0.9, 0.8])
    annotations = annotate(SIZE, [layer()], three, Style(legend=False))
    above, below = annotations.captions
    assert [caption.text for caption in annotations.captions] == ['best', 'good']
    assert (above.ink, above.ground) == (WHITE, BLACK)
    assert above.position[1] < 180
    assert below.position[1] > 220
    assert annotations.labels_left_out == 1
    assert not annotate(SIZE, [layer()], three, Style(legend=False, labels=False)).captions


def test_the_legend_names_the_layers_on_their_colours_from_the_bottom() -> None:
    layers = [Layer('#3c88dc', CORNERS, 'crop regions', True), layer()]
    legend = annotate(SIZE, layers, None, Style()).captions
    assert [caption.text for caption in legend] == ['crop regions', 'detections']
    assert [caption.ground for caption in legend] == [(0x3C, 0x88, 0xDC), BLACK]
    assert [caption.position[0] for caption in legend] == [0.0, 0.0]
    assert legend[0].position[1] == 768.0
    assert legend[0].position[1] - legend[1].position[1] > legend[0].size
    assert not annotate((60, 40), layers, None, Style()).captions
