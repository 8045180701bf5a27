# SPDX-License-Identifier: Apache-2.0
"""Images and layers that wait for each other: any order, bounded, all accounted for."""

from __future__ import annotations

import itertools

import pytest

from obbhbb_ros.downlink.joiner import Lateness
from obbhbb_ros.overlay.collector import CollectorLimits
from obbhbb_ros.overlay.collector import LayerCollector
from obbhbb_ros.overlay.collector import NotDrawn

LIMITS = CollectorLimits(max_wait=0.5, max_age=5.0, max_images=3)
AWAITED = {'boxes', 'detections'}
IMAGE = 'image'
PARTS = (IMAGE, *sorted(AWAITED))


@pytest.fixture
def dropped() -> list[NotDrawn]:
    return []


class Collector(LayerCollector):
    """Takes images and layers by one method."""

    def add(self, kind, stamp, item, now):
        if kind == IMAGE:
            return self.add_image(stamp, item, now)
        return self.add_layer(kind, stamp, item, now)


@pytest.fixture
def frames(dropped: list[NotDrawn]) -> Collector:
    return Collector(dropped.append)


@pytest.mark.parametrize('order', itertools.permutations(PARTS))
def test_a_frame_is_ready_with_its_last_part_whatever_the_order(frames, order) -> None:
    for kind in order[:-1]:
        assert frames.add(kind, (1, 0), f'some {kind}', 0.0)
        assert not frames.ready(AWAITED, 0.0, LIMITS)
    assert frames.add(order[-1], (1, 0), f'some {order[-1]}', 0.1)
    assert frames.ready(AWAITED, 0.1, LIMITS) == [
        ('some image', {kind: f'some {kind}' for kind in AWAITED})
    ]
    assert not len(frames)


def test_parts_of_different_stamps_are_not_mixed(frames) -> None:
    for nanoseconds in (0, 1):
        frames.add(IMAGE, (1, nanoseconds), nanoseconds, 0.0)
    for nanoseconds in (1, 0):
        frames.add('boxes', (1, nanoseconds), nanoseconds, 0.0)
    ready = frames.ready({'boxes'}, 0.0, LIMITS)
    assert ready == [(number, {'boxes': number}) for number in (0, 1)]


def test_only_what_is_awaited_is_waited_for(frames) -> None:
    frames.add('boxes', (1, 0), 'boxes', 0.0)
    frames.add(IMAGE, (1, 0), 'pixels', 0.0)
    assert frames.ready(set(), 0.0, LIMITS) == [('pixels', {'boxes': 'boxes'})]


def test_an_image_waits_for_a_while_from_its_own_arrival(frames, dropped) -> None:
    frames.add('boxes', (1, 0), 'boxes', 0.0)
    frames.add(IMAGE, (1, 0), 'pixels', 4.0)
    assert not frames.ready(AWAITED, 4.4, LIMITS)
    assert frames.ready(AWAITED, 4.5, LIMITS) == [('pixels', {'boxes': 'boxes'})]
    assert not dropped


def test_parts_without_an_image_are_dropped_in_the_end(frames, dropped) -> None:
    frames.add('boxes', (1, 0), 'boxes', 0.0)
    assert not frames.ready(AWAITED, 4.9, LIMITS)
    assert not dropped
    assert not frames.ready(AWAITED, 5.0, LIMITS)
    assert dropped == [NotDrawn.NO_IMAGE]


def test_an_incomplete_frame_is_not_drawn_after_a_later_one(frames, dropped) -> None:
    frames.add(IMAGE, (1, 0), 'earlier', 0.0)
    frames.add(IMAGE, (2, 0), 'later', 0.1)
    frames.add('boxes', (2, 0), 'boxes', 0.1)
    assert len(frames.ready({'boxes'}, 0.1, LIMITS)) == 1
    assert not frames.ready({'boxes'}, 1.0, LIMITS)
    assert dropped == [NotDrawn.OVERTAKEN]


def test_a_complete_frame_is_drawn_even_after_a_later_one(frames, dropped) -> None:
    frames.add(IMAGE, (1, 0), 'earlier', 0.0)
    for stamp in ((2, 0), (1, 0)):
        frames.add(IMAGE, stamp, 'pixels', 0.1)
        frames.add('boxes', stamp, 'boxes', 0.1)
        assert len(frames.ready({'boxes'}, 0.1, LIMITS)) == 1
    assert not dropped


def test_stamps_may_begin_again(frames, dropped) -> None:
    for moment, second in enumerate((1, 2, 1, 2)):
        frames.add(IMAGE, (second, 0), 'pixels', moment)
        assert len(frames.ready({'boxes'}, moment + 0.5, LIMITS)) == 1
    assert not dropped


def test_the_later_of_two_of_a_kind_counts(frames) -> None:
    assert frames.add('boxes', (1, 0), 'first', 0.0)
    assert not frames.add('boxes', (1, 0), 'second', 0.0)
    frames.add(IMAGE, (1, 0), 'pixels', 0.0)
    assert frames.ready({'boxes'}, 0.0, LIMITS) == [('pixels', {'boxes': 'second'})]


def test_the_oldest_images_are_dropped_where_there_are_too_many(frames, dropped) -> None:
    frames.add('boxes', (9, 0), 'boxes', 0.0)
    for second in range(5):
        frames.add(IMAGE, (second, 0), second, 0.0)
        assert not frames.ready(AWAITED, 0.0, LIMITS)
    assert dropped == [NotDrawn.CROWDED_OUT] * 2
    assert [image for image, _ in frames.ready(set(), 0.0, LIMITS)] == [2, 3, 4]


def test_images_are_bounded_by_their_bytes_and_the_latest_stays(dropped) -> None:
    frames, limits = Collector(dropped.append, size_of=len), CollectorLimits(max_bytes=100.0)
    for second, size in enumerate((40, 40, 40, 500)):
        frames.add(IMAGE, (second, 0), '.' * size, 0.0)
        frames.ready(AWAITED, 0.0, limits)
        assert len(frames) == (1, 2, 2, 1)[second]
    assert dropped == [NotDrawn.CROWDED_OUT] * 3


def test_an_incomplete_frame_is_never_drawn_if_only_complete_ones_are_wanted(
    frames, dropped
) -> None:
    limits = CollectorLimits(max_wait=0.5, max_age=5.0, complete_only=True)
    for second in (1, 2, 3):
        frames.add(IMAGE, (second, 0), f'image {second}', 0.0)
    frames.add('boxes', (2, 0), 'late boxes', 4.9)
    assert frames.ready({'boxes'}, 4.9, limits) == [('image 2', {'boxes': 'late boxes'})]
    assert not frames.ready({'boxes'}, 5.0, limits)
    assert dropped == [NotDrawn.INCOMPLETE] * 2


@pytest.mark.parametrize(
    ('limits', 'said'),
    [
        (CollectorLimits(max_wait=0.5), 'it waited longer than max_wait'),
        (CollectorLimits(complete_only=True, max_age=0.5), 'it waited longer than max_age'),
        (
            CollectorLimits(max_wait=2.0, max_bytes=50.0),
            'more than max_bytes waited; 80 bytes are needed',
        ),
        (
            CollectorLimits(max_wait=2.0, max_images=1),
            'more than max_images waited; 2 images are needed',
        ),
    ],
)
def test_what_would_have_kept_an_image_for_its_layer_is_known(dropped, limits, said) -> None:
    frames = Collector(dropped.append, size_of=len)
    for second in (1, 2):
        frames.add(IMAGE, (second, 0), '.' * 40, 0.0)
        frames.ready({'boxes'}, 0.0, limits)
    frames.ready({'boxes'}, 1.0, limits)
    lateness = frames.lateness((1, 0), 1.2)
    assert lateness == Lateness(age=1.2, items=2, bytes=80)
    assert limits.shortage(lateness) == said


def test_an_image_that_was_drawn_complete_has_no_late_layer(frames) -> None:
    frames.add(IMAGE, (1, 0), 'image', 0.0)
    frames.add('boxes', (1, 0), 'boxes', 0.0)
    assert frames.ready({'boxes'}, 0.0, LIMITS)
    assert frames.lateness((1, 0), 1.0) is None


def test_memory_is_bounded_without_images_too(frames, dropped) -> None:
    for second in range(1, 3001):
        frames.add('boxes', (second, 0), 'boxes', 0.0)
        frames.ready(AWAITED, 0.0, LIMITS)
    assert len(frames) == 1000
    assert dropped == [NotDrawn.CROWDED_OUT] * 2000


def test_clearing_discards_everything(frames, dropped) -> None:
    frames.add('boxes', (1, 0), 'boxes', 0.0)
    frames.add(IMAGE, (2, 0), 'pixels', 0.0)
    frames.clear()
    assert dropped == [NotDrawn.CLEARED] * 2
    assert not len(frames)
