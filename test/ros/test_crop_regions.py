# SPDX-License-Identifier: Apache-2.0
"""Crop regions: whole pixels inside the image, most valuable first."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from harness import Converter
from numpy.typing import NDArray
from sensor_msgs.msg import CameraInfo
from ships import FloatArray
from ships import detection
from ships import detections
from ships import fleet
from ships import rows_of
from vision_msgs.msg import Detection2DArray

from obbhbb_ros import OrientedBoxes
from obbhbb_ros import convert

WIDTH, HEIGHT = 640, 480
SIZE = {'image_width': WIDTH, 'image_height': HEIGHT}
# Its box is [90.25, 110.25] x [45.5, 55.5].
SHIP = (100.25, 50.5, 20.0, 10.0, 0.0)


@pytest.fixture(scope='module')
def answers(shared_node: Converter) -> list[Any]:
    return shared_node.peer.collect(Detection2DArray, 'crop_regions')


@pytest.fixture
def crops(node: Converter, answers: list[Any]) -> Callable[..., Detection2DArray]:
    """Converts rows, or a whole message, into a message of crop regions."""
    # Regions of the boxes alone, unless a test is about the hull.
    node.set(SIZE | {'crop.q': 0.0})
    node.connect(answers)

    def _crops(given: Any, **parameters: Any) -> Detection2DArray:
        node.set({name.replace('__', '.'): value for name, value in parameters.items()})
        message = given if isinstance(given, Detection2DArray) else detections(given)
        return node.convert(message, answers)

    return _crops


Crops = Callable[..., Detection2DArray]


def corners(message: Detection2DArray) -> FloatArray:
    """Read regions as x0, y0, x1, y1."""
    rows = rows_of(message)
    assert not rows[:, 4].any()
    return np.hstack((rows[:, :2] - rows[:, 2:4] / 2.0, rows[:, :2] + rows[:, 2:4] / 2.0))


def scored(scores: list[float], **kwargs: Any) -> Detection2DArray:
    """Write detections side by side, each with its score and its place as id."""
    message = Detection2DArray()
    message.header.frame_id = 'camera'
    for i, score in enumerate(scores):
        row = (50.0 + 60.0 * i, 100.0, 20.0, 10.0, 0.3)
        message.detections.append(detection(row, f'class{i}', score, str(i), **kwargs))
    return message


def ids(message: Detection2DArray) -> list[str]:
    return [each.id for each in message.detections]


def test_a_region_is_the_box_rounded_outwards(crops: Crops) -> None:
    np.testing.assert_array_equal(corners(crops([SHIP])), [(90, 45, 111, 56)])


def test_a_box_on_whole_pixels_is_its_own_region(crops: Crops) -> None:
    ship = (100.0, 50.0, 20.0, 10.0, 0.0)
    np.testing.assert_array_equal(corners(crops([ship])), [(90, 45, 110, 55)])


def test_regions_are_whole_pixels_in_the_image_around_what_is_in_it_of_the_box(
    crops: Crops,
) -> None:
    ships = fleet(200)
    message = crops(ships)
    regions = corners(message)
    whole: NDArray[np.bool_] = regions == np.floor(regions)
    assert whole.all()
    assert (regions >= 0).all()
    assert (regions <= (WIDTH, HEIGHT, WIDTH, HEIGHT)).all()
    boxes = convert(OrientedBoxes.from_xywhr(ships))
    limits = np.array((WIDTH, HEIGHT, WIDTH, HEIGHT))
    clipped = np.clip(boxes, 0, limits)
    inside = (clipped[:, 2:] > clipped[:, :2]).all(axis=1)
    assert 0 < inside.sum() < 200
    # All scores are equal, so the regions come from left to right.
    expected = np.hstack((np.floor(clipped[:, :2]), np.ceil(clipped[:, 2:])))[inside]
    np.testing.assert_array_equal(regions, expected[np.lexsort(expected.T[::-1])])


@pytest.mark.parametrize('method', ['superellipse', 'shape_aware', 'outer'])
def test_regions_enclose_the_hull_of_crop_q_and_the_box(crops: Crops, method: str) -> None:
    ship = (300.0, 200.0, 120.0, 30.0, 0.7)
    got = corners(crops([ship], method=method, crop__q=5.0))
    boxes = OrientedBoxes.from_xywhr([ship])
    box, hull = convert(boxes, method=method), convert(boxes, q=5.0)
    low, high = np.minimum(box, hull)[:, :2], np.maximum(box, hull)[:, 2:]
    np.testing.assert_array_equal(got, np.hstack((np.floor(low), np.ceil(high))))


def test_a_class_has_its_own_hull_and_minimum_score(crops: Crops) -> None:
    message = scored([0.3, 0.3, 0.9])
    classes = {'class_ids': ['class1'], 'method': 'midpoint'}
    own = {'classes__class1__crop_q': float('inf'), 'classes__class1__min_score': 0.2}
    crops(message, **classes)
    got = crops(message, crop__min_score=0.5, **own)
    assert ids(got) == ['2', '1']
    boxes = OrientedBoxes.from_xywhr([(110.0, 100.0, 20.0, 10.0, 0.3)])
    outer = convert(boxes, method='outer')[0]
    np.testing.assert_array_equal(corners(got)[1], [*np.floor(outer[:2]), *np.ceil(outer[2:])])


def test_low_scores_and_classes_of_no_weight_are_left_out_and_counted(
    node: Converter, crops: Crops
) -> None:
    crops(scored([0.3]), class_ids=['class2'])
    before = node.counts()
    got = crops(scored([0.3, 0.6, 0.9]), crop__min_score=0.5, classes__class2__weight=0.0)
    assert ids(got) == ['1']
    assert node.counts().since(before, 'crops_left_out') == {
        'crops_left_out.min_score': 1,
        'crops_left_out.zero_weight': 1,
    }


def test_padding_is_a_fraction_of_the_box_and_then_pixels(crops: Crops) -> None:
    got = corners(crops([SHIP], crop__padding=0.5, crop__padding_px=3.0))
    np.testing.assert_array_equal(got, [(77, 37, 124, 64)])


def test_small_regions_are_grown_and_large_ones_cut(crops: Crops) -> None:
    large = (300.0, 200.0, 200.0, 100.0, 0.0)
    got = corners(crops([SHIP, large], crop__min_size=32, crop__max_size=64))
    sizes = got[:, 2:] - got[:, :2]
    np.testing.assert_array_equal(sizes, [(32, 32), (64, 64)])
    np.testing.assert_allclose(got[0, :2] + 16, SHIP[:2], atol=1.0)
    np.testing.assert_allclose(got[1, :2] + 32, large[:2], atol=1.0)


def test_a_grown_region_stays_in_the_image(crops: Crops) -> None:
    ships = [(2.0, 3.0, 4.0, 2.0, 0.0), (WIDTH - 1.0, HEIGHT - 1.0, 4.0, 2.0, 0.0)]
    got = corners(crops(ships, crop__min_size=100))
    np.testing.assert_array_equal(got, [(0, 0, 100, 100), (540, 380, 640, 480)])


def test_the_best_score_comes_first_and_equals_go_from_left_to_right(crops: Crops) -> None:
    message = scored([0.2, 0.9, float('nan'), 0.5, 0.9, -1.0])
    message.detections.append(detection(SHIP, None, name='6'))
    assert ids(crops(message)) == ['1', '4', '3', '0', '5', '6', '2']


@pytest.mark.parametrize(('count', 'kept'), [(0, '1203'), (1, '1'), (2, '12'), (9, '1203')])
def test_max_count_keeps_the_best(crops: Crops, count: int, kept: str) -> None:
    message = crops(scored([0.5, 0.9, 0.7, 0.1]), crop__max_count=count)
    assert ids(message) == list(kept)


def test_header_ids_and_hypotheses_are_kept(crops: Crops) -> None:
    given = scored([0.5, 0.9])
    for i, each in enumerate(given.detections):
        each.header.frame_id, each.header.stamp.sec = f'tile_{i}', 40 + i
        each.results = each.results * 2
        each.results[1].pose.covariance[35] = 0.5 + i
    got = crops(given)
    assert got.header == given.header
    for i, each in zip((1, 0), got.detections, strict=True):
        source = given.detections[i]
        assert (each.header, each.id, each.results) == (source.header, source.id, source.results)


def test_a_merged_region_has_the_ids_and_hypotheses_of_all_it_was_made_from(crops: Crops) -> None:
    rows = [
        (100.0, 100.0, 40.0, 20.0, 0.0),
        (300.0, 300.0, 40.0, 20.0, 0.0),
        (102.0, 100.0, 40.0, 20.0, 0.0),
    ]
    given = detections(rows)
    for each, name, score in zip(given.detections, 'abc', (0.5, 0.7, 0.6), strict=True):
        each.id, each.header.frame_id = name, f'tile_{name}'
        each.results[0].hypothesis.score = score
    got = crops(given, crop__merge_max_size=100)
    np.testing.assert_array_equal(corners(got), [(80, 90, 122, 110), (280, 290, 320, 310)])
    assert ids(got) == ['c|a', 'b']
    merged = got.detections[0]
    assert merged.header == given.detections[2].header
    assert merged.results == given.detections[2].results + given.detections[0].results


def test_sides_are_multiples_of_the_block_of_a_codec(crops: Crops) -> None:
    sizes = np.diff(corners(crops([SHIP], crop__multiple_of=16)).reshape(2, 2), axis=0)
    np.testing.assert_array_equal(sizes, [(32, 16)])


def test_pixels_are_bounded_and_what_is_left_out_is_counted(crops: Crops, node: Converter) -> None:
    before = node.counts()
    got = crops(scored([0.5, 0.9, 0.7, 0.1]), crop__max_pixels=700)
    area = np.prod(corners(got)[:, 2:] - corners(got)[:, :2], axis=1).sum()
    assert ids(got) == ['1', '2']
    assert area <= 700
    changed = node.counts().since(before, 'crop')
    assert changed['crops_left_out.max_pixels'] == 2
    assert changed['crop_pixels.planned'] == area


def test_the_weight_of_a_class_moves_its_regions_forward(start: Callable[..., Converter]) -> None:
    node = start(parameters={**SIZE, 'class_ids': ['class2'], 'classes.class2.weight': 3.0})
    answers = node.peer.collect(Detection2DArray, 'crop_regions')
    node.connect(answers)
    assert ids(node.convert(scored([0.5, 0.9, 0.4]), answers)) == ['2', '1', '0']


def test_the_plan_is_compared_with_that_of_the_outer_boxes(crops: Crops, node: Converter) -> None:
    before = node.counts()
    ship = (200.0, 200.0, 100.0, 20.0, np.pi / 4)
    tight = corners(crops([ship], crop__compare_outer=True))
    report = node.counts()
    changed = report.since(before, 'crop_pixels')
    assert changed['crop_pixels.compared'] == np.prod(tight[0, 2:] - tight[0, :2])
    assert changed['crop_pixels.outer_boxes'] == 86 * 86
    saved = 1.0 - report['crop_pixels.compared'] / report['crop_pixels.outer_boxes']
    assert report['crop_pixels.saved_percent'] == pytest.approx(100.0 * saved, abs=0.06)


def test_regions_follow_the_method(crops: Crops) -> None:
    ship = (200.0, 200.0, 100.0, 20.0, np.pi / 4)
    outer = corners(crops([ship], method='outer'))
    slim = corners(crops([ship], method='superellipse', q=1.0))
    np.testing.assert_array_equal(outer, [(157, 157, 243, 243)])
    np.testing.assert_array_equal(slim, [(164, 164, 236, 236)])


@pytest.mark.parametrize('policy', ['drop', 'keep'])
def test_invalid_detections_and_those_outside_have_no_region(
    crops: Crops, node: Converter, policy: str
) -> None:
    message = detections(
        [
            SHIP,
            (float('nan'), 50.0, 20.0, 10.0, 0.0),
            (100.0, 50.0, -20.0, 10.0, 0.0),
            (-500.0, 50.0, 20.0, 10.0, 0.0),
            (100.0, 5000.0, 20.0, 10.0, 0.0),
        ]
    )
    before = node.counts()
    got = crops(message, invalid_policy=policy)
    np.testing.assert_array_equal(corners(got), [(90, 45, 111, 56)])
    counts = node.counts().since(before, 'crops_')
    assert counts == {
        'crops_planned': 1,
        'crops_left_out.invalid': 2,
        'crops_left_out.outside_image': 2,
    }


def test_what_max_count_leaves_out_is_counted(crops: Crops, node: Converter) -> None:
    before = node.counts()
    crops(scored([0.5] * 5), crop__max_count=2)
    counts = node.counts().since(before, 'crops_')
    assert counts == {'crops_planned': 2, 'crops_left_out.max_count': 3}


def test_no_detections_give_no_regions_but_a_message(crops: Crops) -> None:
    assert crops([]).detections == []


def test_boxes_are_the_same_whether_or_not_crops_are_wanted(crops: Crops, node: Converter) -> None:
    got = crops(fleet(5), crop__padding=0.5, crop__max_count=1)
    boxes = rows_of(node.answer_to(got.header.stamp.sec))
    xyxy = convert(OrientedBoxes.from_xywhr(fleet(5)))
    np.testing.assert_allclose(boxes[:, 2:4], xyxy[:, 2:] - xyxy[:, :2], rtol=1e-12)


# The size of the image ------------------------------------------------------------------------


@pytest.fixture
def unsized(start: Callable[..., Converter]) -> Converter:
    """A node that does not know how large the image is."""
    node = start()
    node.connect()
    return node


def info(width: int, height: int) -> CameraInfo:
    return CameraInfo(width=width, height=height)


def seen(node: Converter, crops: list[Any], camera: Any, message: CameraInfo) -> FloatArray:
    """Publish a camera info, then a detection larger than any image, and give its region."""
    camera.publish(message)
    ship = (0.0, 0.0, 1e5, 1e5, 0.0)
    node.answer_to(node.send(detections([ship])))
    (region,) = corners(node.answer_to(node.send(detections([ship])), crops))
    return region


def test_without_the_size_of_the_image_there_are_no_regions_but_a_warning(
    unsized: Converter,
) -> None:
    crops = unsized.peer.collect(Detection2DArray, 'crop_regions')
    # Until the node knows of the subscriber it has no reason to warn.
    unsized.wait(
        lambda: (
            unsized.convert(detections([SHIP])) and 'publish camera_info' in unsized.process.log
        ),
        'the warning',
    )
    line = unsized.wait_for_log('publish camera_info')
    assert '[WARN]' in line
    assert 'image_width' in line
    assert 'image_height' in line
    assert unsized.counts()['messages_without_image_size'] >= 1
    # Once per message, whatever it goes without.
    unsized.set({'clip_boxes': True})
    before = unsized.counts()
    unsized.convert(detections([SHIP]))
    assert unsized.counts().since(before)['messages_without_image_size'] == 1
    unsized.reset()
    assert 'no crop regions' in unsized.process.log
    assert crops == []


def test_camera_info_gives_the_size_and_parameters_win(unsized: Converter) -> None:
    crops = unsized.peer.collect(Detection2DArray, 'crop_regions')
    camera = unsized.peer.publisher(CameraInfo, 'camera_info')

    def connected() -> Any:
        camera.publish(info(320, 240))
        unsized.convert(detections([SHIP]))
        return crops

    unsized.wait(connected, 'the first region')
    assert seen(unsized, crops, camera, info(800, 600)).tolist() == [0, 0, 800, 600]
    assert seen(unsized, crops, camera, info(1024, 768)).tolist() == [0, 0, 1024, 768]
    roi = info(1024, 768)
    roi.roi.width, roi.roi.height = 512, 256
    assert seen(unsized, crops, camera, roi).tolist() == [0, 0, 512, 256]
    binned = info(1024, 768)
    binned.binning_x, binned.binning_y = 2, 4
    assert seen(unsized, crops, camera, binned).tolist() == [0, 0, 512, 192]
    unsized.set({'image_width': 100})
    assert seen(unsized, crops, camera, info(800, 600)).tolist() == [0, 0, 100, 600]
    unsized.set({'image_height': 50})
    assert seen(unsized, crops, camera, info(800, 600)).tolist() == [0, 0, 100, 50]


def test_camera_info_counts_for_the_detections_that_follow_it(unsized: Converter) -> None:
    crops = unsized.peer.collect(Detection2DArray, 'crop_regions')
    camera = unsized.peer.publisher(CameraInfo, 'camera_info')

    def connected() -> Any:
        camera.publish(info(320, 240))
        unsized.convert(detections([SHIP]))
        return crops

    unsized.wait(connected, 'the first region')
    ship = detections([(0.0, 0.0, 1e5, 1e5, 0.0)])
    widths = []
    for width in range(100, 200):
        camera.publish(info(width, 50))
        widths.append(corners(unsized.convert(ship, crops))[0, 2])
        crops.clear()
    assert widths == list(range(100, 200))


def test_detections_have_the_size_of_their_image_though_they_come_late(
    start: Callable[..., Converter],
) -> None:
    node = start()
    crops = node.peer.collect(Detection2DArray, 'crop_regions')
    camera = node.heard_publisher(CameraInfo, 'camera_info')
    node.send_until(
        lambda: camera.publish(info(320, 240)) or node.send(detections([SHIP])),
        lambda: crops,
        'the first region',
    )
    before = node.counts()
    messages = [detections([(0.0, 0.0, 1e5, 1e5, 0.0)]) for _ in range(6)]
    for i, message in enumerate(messages):
        node.stamped(message)
        binned = info(1280, 960)
        binned.binning_x = binned.binning_y = 1 + i % 2
        binned.header = message.header
        camera.publish(binned)
    # All have arrived before the first detections.
    node.counts()
    crops.clear()
    for message in messages:
        node.publisher.publish(message)
    node.wait(lambda: len(crops) == 6, 'six plans')
    assert [corners(plan)[0, 2] for plan in crops] == [1280, 640] * 3
    assert node.counts().since(before, 'camera_info') == {'camera_info_by_stamp': 6}
    node.convert(detections([SHIP]), crops)
    assert node.counts()['camera_info_latest'] >= 1


def test_detections_outside_the_image_as_a_rule_and_of_another_camera_are_said(
    start: Callable[..., Converter],
) -> None:
    node = start()
    crops = node.peer.collect(Detection2DArray, 'crop_regions')
    camera = node.heard_publisher(CameraInfo, 'camera_info')
    small = info(640, 480)
    small.header.frame_id = 'small'
    node.send_until(
        lambda: camera.publish(small) or node.send(detections([SHIP])),
        lambda: crops,
        'the first region',
    )
    message = detections([(100.0, 100.0, 30.0, 10.0, 0.0), *[(900.0, 700.0, 30.0, 10.0, 0.0)] * 9])
    message.header.frame_id = 'large'
    before = node.counts()
    for _ in range(3):
        node.convert(message, crops)
    node.wait(lambda: node.warned('lie outside the image of 640 x 480 pixels'), 'a warning')
    assert node.counts().since(before)['frame_ids_differ.camera_info'] == 3
    said = "detections of frame 'large', but camera_info of frame 'small'"
    assert node.process.log.count(said) == 1
