# SPDX-License-Identifier: Apache-2.0
"""CVAT XML 1.1 of images."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest

from obbhbb_ros.labels import LabelError
from obbhbb_ros.labels import read_labels

if TYPE_CHECKING:
    from conftest import Put

BOX = '<box label="ship" occluded="0" xtl="300.00" ytl="280.00" xbr="500.00" ybr="320.00"{}></box>'
TURNED = BOX.format(' rotation="30.00" z_order="0"')
POLYGON = (
    '<polygon label="tug" points="323.40,232.68;496.60,332.68;476.60,367.32;303.40,267.32">'
    '</polygon>'
)
MASK = '<mask label="ship" rle="1, 3, 1, 5" left="100" top="200" width="5" height="2"></mask>'


def _image(*shapes: str, name: str = 'a.jpg') -> str:
    body = '\n'.join(shapes)
    return f'<image id="0" name="{name}" width="1000" height="800">\n{body}\n</image>'


def _cvat(*images: str) -> str:
    return (
        '<?xml version="1.0" encoding="utf-8"?>\n<annotations>\n<version>1.1</version>'
        '<meta><task><labels><label><name>ship</name></label></labels></task></meta>\n'
        + '\n'.join(images)
        + '\n</annotations>'
    )


def test_the_rotation_that_datumaro_writes_is_used(put: Put) -> None:
    attribute = '<attribute name="rotation">30.0</attribute></box>'
    written = BOX.format(' outside="0" keyframe="0"').replace('</box>', attribute)
    (labels,) = read_labels(put('a.xml', _cvat(_image(TURNED, written))))
    np.testing.assert_allclose(labels.corners[0], labels.corners[1])
    assert np.isnan(labels.reference).all()
    assert not labels.extras.properties


def test_two_rotations_that_differ_are_refused(put: Put) -> None:
    both = TURNED.replace('</box>', '<attribute name="rotation">31</attribute></box>')
    with pytest.raises(LabelError, match='and an attribute rotation 31: which one'):
        list(read_labels(put('a.xml', _cvat(_image(both)))))


def test_boxes_polygons_and_masks_are_read(put: Put) -> None:
    path = put('a.xml', _cvat(_image(TURNED, POLYGON, MASK), _image(BOX.format(''), name='b')))
    first, second = read_labels(path)
    assert (first.image, first.size) == ('a.jpg', (1000, 800))
    assert first.extras.image_id == 0
    assert first.class_ids == ('ship', 'tug', 'ship')
    boxes = first.boxes()
    np.testing.assert_allclose(boxes.center[:2], [[400, 300]] * 2, atol=0.01)
    np.testing.assert_allclose(boxes.length[:2], 200, atol=0.01)
    np.testing.assert_allclose(boxes.width[:2], 40, atol=0.01)
    np.testing.assert_allclose(boxes.theta[:2] % np.pi, np.radians(30), atol=1e-4)
    assert np.isnan(first.reference[:2]).all()
    hull = first.hulls[2]
    assert hull is not None
    assert hull.min(axis=0).tolist() == [100, 200]
    assert hull.max(axis=0).tolist() == [105, 202]
    assert second.image == 'b'
    assert second.reference.tolist() == [[300, 280, 500, 320]]
    assert second.corners[0].tolist() == [[300, 280], [500, 280], [500, 320], [300, 320]]


def test_images_of_one_name_and_without_shapes_stay_apart(put: Put) -> None:
    path = put('a.xml', _cvat(_image(TURNED), _image(), _image(TURNED, TURNED)))
    images = list(read_labels(path))
    assert [len(image.class_ids) for image in images] == [1, 0, 2]


def test_attributes_are_properties(put: Put) -> None:
    heading = '<attribute name="heading">30</attribute></box>'
    path = put('a.xml', _cvat(_image(TURNED.replace('</box>', heading), MASK)))
    (labels,) = read_labels(path)
    assert labels.extras.properties == {'heading': ('30', None)}


def test_a_tag_of_an_image_is_no_box(put: Put) -> None:
    (labels,) = read_labels(put('a.xml', _cvat(_image('<tag label="night"></tag>', TURNED))))
    assert labels.class_ids == ('ship',)


@pytest.mark.parametrize(
    ('shape', 'message'),
    [
        ('<cuboid label="ship" xtl1="4"/>', 'a shape <cuboid> is not read, only box, ellipse, pol'),
        ('<ellipse label="ship" cx="4" cy="4" rx="-2" ry="1"/>', 'the box has a negative size'),
        ('<ellipse label="ship" cx="4" cy="4" rx="2"/>', '<ellipse> has no attribute ry'),
        ('<polyline label="ship" points="1,2;3,4"/>', 'a shape <polyline> is not read'),
        (BOX.format('').replace('label="ship"', ''), '<box> has no attribute label'),
        (BOX.format('').replace('xtl="300.00"', ''), '<box> has no attribute xtl'),
        (BOX.format('').replace('500.00', '5'), 'below its minimum'),
        (BOX.format('').replace('500.00', '1e999'), 'not a finite number'),
        (BOX.format(' rotation="left"'), "'left' is not a number"),
        (BOX.format(' rotation="nan"'), 'not a finite number'),
        ('<polygon label="ship" points="1,2;3,4"/>', 'a polygon has 4 numbers'),
        ('<polygon label="ship" points="1,2;3;4,5"/>', 'a polygon has 5 numbers'),
        ('<polygon label="ship" points="1,2;3,4;5,6"/>', 'no area'),
        ('<polygon label="ship"/>', '<polygon> has no attribute points'),
        (MASK.replace('1, 3', '1, 4'), 'do not fill 5 x 2'),
        (MASK.replace('1, 3', 'one'), 'not whole numbers'),
        (MASK.replace('"5"', '"5.5"'), 'not whole numbers'),
        (MASK.replace('"5"', '"99999999999"'), 'cannot have 99999999999'),
    ],
)
def test_a_shape_that_is_not_understood_is_reported(put: Put, shape: str, message: str) -> None:
    errors: list[LabelError] = []
    path = put('a.xml', _cvat(_image(TURNED, shape, TURNED)))
    (labels,) = read_labels(path, on_error=errors.append)
    assert len(labels.class_ids) == 2
    (error,) = errors
    assert (error.path, error.line) == (path, 6)
    assert error.message.startswith("image 'a.jpg': shape 2: ")
    assert message in error.message


@pytest.mark.parametrize('rotation', [0.0, 30.0])
def test_an_ellipse_is_the_box_around_it(put: Put, rotation: float) -> None:
    turn = f' rotation="{rotation}"' if rotation else ''
    ellipse = f'<ellipse label="ship" cx="400.00" cy="300.00" rx="100.00" ry="20.00"{turn}/>'
    box = TURNED if rotation else BOX.format('')
    (labels,) = read_labels(put('a.xml', _cvat(_image(ellipse, box))))
    np.testing.assert_allclose(labels.corners[0], labels.corners[1])
    np.testing.assert_array_equal(labels.reference[0], labels.reference[1])


def _track(*frames: int, step: int = 1, outside: int = -1) -> str:
    """Write a track as CVAT exports it for video."""
    shapes = [
        BOX.replace('<box ', f'<box frame="{frame}" outside="{int(frame == outside)}" ').format('')
        for frame in frames
    ]
    meta = (
        f'<meta><task><frame_filter>step={step}</frame_filter><original_size><width>1000</width>'
        '<height>800</height></original_size></task></meta>'
    )
    track = '<track id="7" label="ship" source="manual">\n{}\n</track>'
    return _cvat(meta, track.format('\n'.join(shapes).replace(' label="ship"', '')))


def test_the_shapes_of_a_track_are_in_their_frames(put: Put) -> None:
    images = list(read_labels(put('a.xml', _track(10, 11, 12, 20, outside=12))))
    assert [image.image for image in images] == ['frame_000010', 'frame_000011', 'frame_000020']
    assert {(image.ids, image.class_ids, image.size) for image in images} == {
        (('7',), ('ship',), (1000, 800))
    }
    assert images[0].reference.tolist() == [[300, 280, 500, 320]]


@pytest.mark.parametrize(('step', 'missing'), [(1, 2), (5, 1), (10, 0)])
def test_a_track_of_key_frames_alone_is_reported(put: Put, step: int, missing: int) -> None:
    errors: list[LabelError] = []
    path = put('a.xml', _track(0, 5, 15, step=step))
    assert len(list(read_labels(path, on_error=errors.append))) == 3
    assert len(errors) == missing
    if missing:
        assert errors[-1].message == 'track 7: frame 15: the shapes since frame 5 are not there'


@pytest.mark.parametrize('frame', ['', '-1', 'x', '9' * 40])
def test_a_shape_without_a_frame_is_reported(put: Put, frame: str) -> None:
    text = _track(1).replace('frame="1"', f'frame="{frame}"')
    with pytest.raises(LabelError, match='the frame has no number'):
        list(read_labels(put('a.xml', text)))
