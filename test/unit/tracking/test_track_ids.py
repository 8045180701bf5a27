# SPDX-License-Identifier: Apache-2.0
"""Ids that are no tracks are noticed: shared within a message, or numbers of rows."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from obbhbb_ros.tracking.track_ids import IdWatch
from obbhbb_ros.tracking.track_ids import is_tracker_id
from obbhbb_ros.tracking.track_ids import new_session
from obbhbb_ros.tracking.track_ids import repeated_ids
from obbhbb_ros.tracking.track_ids import tracker_id

SIZES = [5, 3, 4, 7, 2, 6, 4] * 4


def rows(count, first=0):
    """Number the detections of a message."""
    return [str(number) for number in range(first, first + count)]


def doubts(messages):
    """Return the keys of what is doubtful in the last message."""
    watch = IdWatch()
    for ids in messages:
        found = [doubt.key for doubt in watch.note(ids)]
    return found


@given(st.lists(st.sampled_from(['', 'ship', 'tug', '1', '2', '10'])))
def test_a_repeated_id_is_one_that_several_detections_have(ids) -> None:
    assert repeated_ids(ids) == {text for text in ids if text and ids.count(text) > 1}


def test_detections_that_share_an_id_are_counted_and_the_parameter_that_helps_is_named() -> None:
    (doubt,) = IdWatch().note(['ship', 'tug', 'ship', '', '', 'ship'])
    assert (doubt.key, doubt.detections) == ('ids_doubtful.repeated', 3)
    assert "'ship'" in doubt.text
    assert 'ids: assign' in doubt.text


@pytest.mark.parametrize('first', [0, 1])
def test_numbers_of_rows_are_noticed(first) -> None:
    assert doubts(rows(size, first) for size in SIZES) == ['ids_doubtful.row_numbers']


def test_rows_are_noticed_in_any_order() -> None:
    assert doubts(rows(size)[::-1] for size in SIZES) == ['ids_doubtful.row_numbers']


def test_messages_without_detections_or_ids_do_not_matter() -> None:
    sizes = [size for pair in zip(SIZES, [0] * len(SIZES), strict=True) for size in pair]
    messages = [rows(size) or ['', ''] for size in sizes]
    assert doubts([*messages, rows(3)]) == ['ids_doubtful.row_numbers']


@pytest.mark.parametrize(
    'messages',
    [
        [rows(4)] * 100,
        [rows(size) for size in range(1, 100)],
        [rows(3, number) for number in range(100)],
        [[tracker_id('01234567', 5 - size), 'x'] for size in SIZES],
        [rows(size) for size in SIZES[:10]],
    ],
    ids=['still', 'growing', 'passing', 'ours', 'few'],
)
def test_ids_that_may_be_tracks_are_not_doubted(messages) -> None:
    assert doubts(messages) == []


def test_tracks_after_rows_are_not_doubted() -> None:
    messages = [rows(size) for size in SIZES]
    assert doubts([*messages, ['3', '9'], *messages[:10]]) == []


@given(st.integers(0, 10**9))
def test_ids_of_the_tracker_are_told_from_others(number) -> None:
    session = new_session()
    assert is_tracker_id(tracker_id(session, number))
    assert not is_tracker_id(str(number))
    assert not is_tracker_id(f'{tracker_id(session, number)}|{number}')


def test_no_two_sessions_are_alike() -> None:
    assert len({new_session() for _ in range(100)}) == 100
