# SPDX-License-Identifier: Apache-2.0
"""Crop plans and their sources, in their bytes."""

import struct
from dataclasses import replace

import numpy as np
import pytest
from cdr import MESSAGES
from cdr import STAMP
from cdr import TEXT
from cdr import Detection
from cdr import Hypothesis
from cdr import Message
from cdr import encode
from hypothesis import given
from hypothesis import strategies as st

from obbhbb_ros.downlink.crops import CropSettings
from obbhbb_ros.downlink.crops import plan_crops
from obbhbb_ros.pipeline.batch import Batch
from obbhbb_ros.settings.obb_to_hbb import OBB_TO_HBB
from obbhbb_ros.wire.buffer import WireError
from obbhbb_ros.wire.detections import Detections
from obbhbb_ros.wire.layouts import INPUT_TYPES
from obbhbb_ros.wire.plans import Source
from obbhbb_ros.wire.plans import WirePlan
from obbhbb_ros.wire.plans import read_sources

ORDERS = pytest.mark.parametrize('order', '<>')
NAN, INF = float('nan'), float('inf')


def plan_of(*detections, order='<'):
    return WirePlan(encode(Message(detections=detections), order))


def best_of(results):
    """The best hypothesis, the first of equals; NaN is less than any number."""
    best = None
    for hypothesis in results:
        if (
            best is None
            or hypothesis.score > best.score
            or (np.isnan(best.score) and not np.isnan(hypothesis.score))
        ):
            best = hypothesis
    return best


@pytest.mark.parametrize(
    ('box', 'region'),
    [
        ((10.0, 20.0, 0.0, 4.0, 6.0), (8, 17, 12, 23)),
        ((10.5, 20.0, 0.0, 5.0, 6.0), (8, 17, 13, 23)),
        ((10.2, 20.0, 0.0, 4.0, 6.0), (8, 17, 13, 23)),
        ((-3.0, -4.5, 0.0, 4.0, 6.0), (-5, -8, -1, -1)),
        ((NAN, 20.0, 0.0, 4.0, 6.0), (0, 0, 0, 0)),
        ((10.0, 20.0, 0.0, INF, 6.0), (0, 0, 0, 0)),
        ((1e300, 0.0, 0.0, 2.0, 2.0), (2**52, -1, 2**52, 1)),
    ],
)
def test_regions_are_whole_pixels(box, region) -> None:
    assert plan_of(Detection(bbox=box)).regions == [region]


@pytest.mark.filterwarnings('error')
@pytest.mark.parametrize('box', [(INF, 0, 0, INF, 1), (1e308, 0, 0, -1.7e308, 1), (7, 7, 7, 7, 7)])
def test_no_box_makes_numpy_warn(box) -> None:
    data = encode(Message(detections=(Detection(bbox=tuple(map(float, box))),)))
    # A signalling NaN in place of seven.
    signalling = data.replace(struct.pack('<d', 7.0), bytes.fromhex('010000000000f47f'))
    assert WirePlan(signalling).regions[0][:2] in [(0, 0), (2**52, -1)]
    boxes = Detections(signalling).xywhr()[:, :4]
    assert len(plan_crops(boxes, np.ones(1), (640, 480), CropSettings()).regions) in (0, 1)


@ORDERS
@given(message=MESSAGES)
def test_class_score_and_ids_are_those_of_the_message(order, message) -> None:
    plan = WirePlan(encode(message, order))
    assert plan.stamp == message.stamp
    assert len(plan) == len(message.detections)
    for row, detection in enumerate(message.detections):
        best = best_of(detection.results)
        has_score = best is not None and np.isfinite(best.score)
        assert plan.class_ids[row] == (best.class_id if best else '')
        assert plan.scores[row] == (best.score if has_score else None)
        assert '|'.join(plan.detection_ids()[row]) == detection.id


@pytest.mark.parametrize(
    ('text', 'ids'), [('', []), ('7', ['7']), ('7|8|größe', ['7', '8', 'größe'])]
)
def test_the_ids_of_merged_regions_are_several(text, ids) -> None:
    assert plan_of(Detection(id=text)).detection_ids() == [ids]


@ORDERS
@given(message=MESSAGES, stamp=STAMP, image_stamp=STAMP, frame_id=TEXT, data=st.data())
def test_a_region_stands_alone_with_the_headers_of_chip_and_image(
    order, message, stamp, image_stamp, frame_id, data
) -> None:
    plan = WirePlan(encode(message, order))
    for row in data.draw(st.sets(st.sampled_from(range(max(len(plan), 1))), max_size=4)):
        if row < len(plan):
            detection = replace(message.detections[row], stamp=image_stamp, frame_id=frame_id)
            assert plan.alone(row, stamp, image_stamp, frame_id) == encode(
                Message(stamp, frame_id, (detection,))
            )


@pytest.mark.parametrize('read', [WirePlan, read_sources])
@pytest.mark.parametrize('cut', [0, 3, 20, -1])
def test_what_is_no_message_is_refused(read, cut) -> None:
    data = encode(Message(detections=(Detection(),)))
    with pytest.raises(WireError):
        read(data[:cut])


# Sources


@ORDERS
@given(
    message=MESSAGES, values=st.lists(st.floats(-10, 10), min_size=60, max_size=60), data=st.data()
)
def test_ranked_detections_have_values_for_scores_and_other_boxes(
    order, message, values, data
) -> None:
    count = len(message.detections)
    rows = np.array(
        data.draw(
            st.permutations(range(count)).flatmap(
                lambda order: st.integers(0, count).map(lambda size: order[:size])
            )
        ),
        np.int64,
    )
    boxes = np.arange(5.0 * len(rows)).reshape(5, -1) + 0.5
    detections = Detections(encode(message, order))
    written = detections.ranked(rows, boxes, np.array(values[: len(rows)]))
    expected = []
    for i, row in enumerate(rows):
        detection = message.detections[row]
        best = best_of(detection.results)
        results = tuple(
            replace(hypothesis, score=values[i] if hypothesis is best else NAN)
            for hypothesis in detection.results
        )
        x, y, length, width, theta = boxes[:, i].tolist()
        expected.append(replace(detection, results=results, bbox=(x, y, theta, length, width)))
    again, same = (
        Detections(written),
        Detections(encode(replace(message, detections=tuple(expected)))),
    )
    np.testing.assert_array_equal(again.xywhr(), same.xywhr())
    assert again.ids() == same.ids()
    stamp, sources = read_sources(written)
    assert stamp == message.stamp
    assert sources == [
        Source(
            message.detections[row].id,
            values[i] if message.detections[row].results else 0.0,
            tuple(boxes[:, i]),
        )
        for i, row in enumerate(rows)
    ]
    # Other messages are written from the same bytes.
    plain = np.ones((count, 4))
    assert detections.rewrite(plain) == Detections(encode(message, order)).rewrite(plain)


@pytest.mark.parametrize(
    ('regions', 'sources', 'belong'),
    [
        (['a', 'b|c'], ['a', 'b'], True),
        ([], [], True),
        (['', ''], ['', ''], True),
        (['a', 'b|c'], ['a', 'c'], False),
        (['ab'], ['a'], False),
        (['a', 'b'], ['a'], False),
        (['a', 'b'], ['b', 'a'], False),
    ],
)
def test_sources_are_those_of_a_plan_if_their_ids_are(regions, sources, belong) -> None:
    plan = WirePlan(encode(Message(detections=tuple(Detection(id=name) for name in regions))))
    _, received = read_sources(
        encode(Message(detections=tuple(Detection(id=name) for name in sources)))
    )
    assert plan.has_sources(received) == belong


@pytest.mark.parametrize('score', [NAN, INF, -INF])
def test_a_source_without_value_has_none(score) -> None:
    data = encode(Message(detections=(Detection(results=(Hypothesis(score=score),)),)))
    assert read_sources(data)[1][0].value == 0.0


def scene(merge=0):
    """Three boxes: two on top of each other, one far off."""
    detections = tuple(
        Detection(results=(Hypothesis(class_id, score),), bbox=box, id=name)
        for class_id, score, box, name in (
            ('tug', 0.4, (100.0, 110.0, 0.0, 10.0, 40.0), 'a'),
            ('ship', 0.9, (400.0, 300.0, 0.7, 60.0, 20.0), 'b'),
            # The long side of these lies across theta.
            ('ship', 0.45, (100.0, 115.0, 0.0, 10.0, 40.0), 'c'),
        )
    )
    settings = OBB_TO_HBB.settings({'crop.merge_max_size': merge})
    return Batch(
        encode(Message(detections=detections)),
        INPUT_TYPES['Detection2DArray'],
        settings,
        (640, 480),
    )


@pytest.mark.parametrize('merge', [0, 200])
def test_each_region_has_its_source_at_its_place(merge) -> None:
    batch = scene(merge)
    plan = WirePlan(batch.crop_regions_message(batch.plan_crops()))
    stamp, sources = read_sources(batch.crop_sources_message(batch.plan_crops()))
    assert stamp == plan.stamp == (3, 4)
    assert len(sources) == len(plan) == (2 if merge else 3)
    for region, source in zip(plan.regions, sources, strict=True):
        x0, y0, x1, y1 = region
        x, y, length, width, _ = source.obb
        assert x0 <= x <= x1
        assert y0 <= y <= y1
        assert length >= width
    values = {
        tuple(ids): source.value for ids, source in zip(plan.detection_ids(), sources, strict=True)
    }
    assert values == pytest.approx(
        {('b',): 0.9, ('c', 'a'): 0.85} if merge else {('a',): 0.4, ('b',): 0.9, ('c',): 0.45}
    )
    assert sorted(values.values(), reverse=True) == [source.value for source in sources]


def test_the_source_of_a_region_is_its_most_valuable_detection() -> None:
    batch = scene(200)
    plan = WirePlan(batch.crop_regions_message(batch.plan_crops()))
    _, sources = read_sources(batch.crop_sources_message(batch.plan_crops()))
    (merged,) = (
        source for ids, source in zip(plan.detection_ids(), sources, strict=True) if len(ids) == 2
    )
    x, y, length, width, theta = merged.obb
    assert (x, y, length, width) == (100.0, 115.0, 40.0, 10.0)
    assert abs(np.cos(theta)) < 1e-9


def test_sources_leave_the_regions_as_they_are() -> None:
    first, second = scene(), scene()
    plans = first.plan_crops(), second.plan_crops()
    second.crop_sources_message(plans[1])
    for write in ('crop_regions_message', 'crop_sources_message'):
        assert getattr(first, write)(plans[0]) == getattr(second, write)(plans[1])
