# SPDX-License-Identifier: Apache-2.0
"""The camera of an image: by its stamp, or the latest, and how long an image waits for it."""

import pytest

from obbhbb_ros.downlink.cameras import CameraChoice
from obbhbb_ros.downlink.cameras import CameraMemory
from obbhbb_ros.downlink.frame_queue import FrameQueue


@pytest.fixture
def cameras() -> CameraMemory[str]:
    memory = CameraMemory[str]()
    memory.add((5, 0), 'first', 0.0)
    memory.add((6, 0), 'second', 1.0)
    return memory


def test_an_equal_stamp_wins_and_else_the_latest(cameras) -> None:
    assert cameras.choice((5, 0)) == CameraChoice('first', has_stamp=True)
    assert cameras.choice((5, 1)) == CameraChoice('second', has_stamp=False)
    cameras.add((0, 0), 'without stamp', 2.0)
    assert cameras.choice((0, 0)) == CameraChoice('without stamp', has_stamp=False)


def test_without_a_camera_there_is_no_choice(cameras) -> None:
    cameras.clear()
    assert cameras.choice((5, 0)) is None
    assert not cameras.is_coming((5, 0))


def test_memory_is_bounded_by_number_and_age(cameras) -> None:
    for second in range(10, 1010):
        cameras.add((second, 0), 'later', 2.0)
    assert not cameras.choice((6, 0)).has_stamp
    assert cameras.choice((10, 0)).has_stamp
    cameras.add((2000, 0), 'much later', 3700.0)
    assert not cameras.choice((10, 0)).has_stamp


def test_a_camera_is_on_its_way_if_they_have_the_stamps_of_images_and_none_is_later(
    cameras,
) -> None:
    cameras.choice((6, 0))
    assert cameras.is_coming((7, 0))
    assert not cameras.is_coming((5, 5))
    # It was waited for in vain.
    cameras.choice((7, 0))
    assert not cameras.is_coming((8, 0))
    # But then it comes.
    cameras.add((7, 0), 'third', 2.0)
    assert cameras.is_coming((8, 0))


def test_a_single_camera_or_one_without_a_stamp_is_that_of_all_images() -> None:
    cameras = CameraMemory[str]()
    cameras.add((5, 0), 'latched', 0.0)
    assert not cameras.is_coming((7, 0))
    cameras.add((0, 0), 'without stamp', 0.1)
    assert not cameras.is_coming((7, 0))
    # Two may be the first of many.
    cameras.add((6, 0), 'second', 0.2)
    assert cameras.is_coming((7, 0))


def test_frames_wait_for_their_camera_in_order(cameras) -> None:
    queue, limits = FrameQueue[str](cameras.is_coming), (5.0, 100.0)
    cameras.choice((6, 0))
    for second in (7, 8):
        queue.add((second, 0), f'frame {second}', 10, 2.0)
    assert list(queue.ready(2.0, *limits)) == []
    assert list(queue) == ['frame 7', 'frame 8']
    cameras.add((7, 0), 'third', 2.1)
    assert list(queue.ready(2.1, *limits)) == ['frame 7']
    # None of the stamp 8 will come.
    cameras.add((9, 0), 'fifth', 2.2)
    assert list(queue.ready(2.2, *limits)) == ['frame 8']
    assert not len(queue)


@pytest.mark.parametrize(
    ('now', 'max_bytes', 'ready'), [(7.0, 20.0, 0), (7.1, 20.0, 2), (7.0, 15.0, 1)]
)
def test_the_wait_for_a_camera_is_bounded_by_age_and_bytes(cameras, now, max_bytes, ready) -> None:
    queue = FrameQueue[str](cameras.is_coming)
    cameras.choice((6, 0))
    for second in (7, 8):
        queue.add((second, 0), f'frame {second}', 10, 2.0)
    assert len(list(queue.ready(now, 5.0, max_bytes))) == ready
