# SPDX-License-Identifier: Apache-2.0
"""Detections in their bytes: every message is read, only boxes change, nothing else is touched."""

import struct
import tracemalloc
from dataclasses import replace
from itertools import pairwise
from unittest import mock

import numpy as np
import pytest
from cdr import DETECTIONS
from cdr import MESSAGES
from cdr import Detection
from cdr import Hypothesis
from cdr import Message
from cdr import encode
from cdr import with_box
from hypothesis import given
from hypothesis import settings
from hypothesis import strategies as st

from obbhbb_ros.wire import elements
from obbhbb_ros.wire.buffer import WireError
from obbhbb_ros.wire.detections import Detections

ORDERS = pytest.mark.parametrize('order', '<>')
PADDING = st.sampled_from([0x00, 0xA5])


def boxes(count):
    """Make boxes that differ: centre x and y, size x and y."""
    return np.arange(4.0 * count).reshape(-1, 4) + 0.25


def unchanged(data):
    """Read a message and write it again."""
    detections = Detections(data)
    rows = np.zeros(len(detections), bool)
    return detections.rewrite(boxes(len(detections)), rows)


def encoded_boxes(detections):
    """List the boxes of detections as `xywhr` does."""
    return [[x, y, w, h, theta] for x, y, theta, w, h in (d.bbox for d in detections)]


@ORDERS
@given(message=MESSAGES, padding=PADDING, trailing=st.integers(0, 6))
def test_boxes_are_read(order, message, padding, trailing) -> None:
    detections = Detections(encode(message, order, padding) + bytes(trailing))
    expected = encoded_boxes(message.detections)
    np.testing.assert_array_equal(detections.xywhr(), np.array(expected).reshape(-1, 5))
    assert detections.stamp == message.stamp


@ORDERS
@given(message=MESSAGES, padding=PADDING)
def test_rewriting_changes_the_boxes_and_nothing_else(order, message, padding) -> None:
    rows = boxes(len(message.detections))
    rewritten = Detections(encode(message, order, padding)).rewrite(rows)
    changed = tuple(map(with_box, message.detections, rows))
    assert rewritten == encode(replace(message, detections=changed))


@ORDERS
@given(message=MESSAGES, padding=PADDING, data=st.data())
def test_new_ids_change_nothing_else(order, message, padding, data) -> None:
    count = len(message.detections)
    ids = data.draw(st.lists(st.text('ab-é', max_size=9), min_size=count, max_size=count))
    detections = Detections(encode(message, order, padding))
    changed = tuple(map(lambda one, text: replace(one, id=text), message.detections, ids))
    assert detections.with_ids(ids) == encode(replace(message, detections=changed))


@ORDERS
@given(message=MESSAGES, padding=PADDING)
def test_boxes_can_be_written_with_the_ids(order, message, padding) -> None:
    detections = Detections(encode(message, order, padding))
    rows = np.arange(5.0 * len(message.detections)).reshape(-1, 5)
    again = Detections(detections.with_ids(['x'] * len(rows), rows))
    np.testing.assert_array_equal(again.xywhr(), rows)
    assert again.ids() == ['x'] * len(rows)


@ORDERS
@given(message=MESSAGES, padding=PADDING, data=st.data())
def test_detections_that_are_not_named_keep_their_box(order, message, padding, data) -> None:
    count = len(message.detections)
    named = np.array(data.draw(st.lists(st.booleans(), min_size=count, max_size=count)), bool)
    rows = boxes(count)
    rewritten = Detections(encode(message, order, padding)).rewrite(rows, named)
    changed = tuple(
        with_box(detection, row) if is_named else detection
        for detection, row, is_named in zip(message.detections, rows, named, strict=True)
    )
    assert rewritten == encode(replace(message, detections=changed))


@ORDERS
@given(message=MESSAGES, padding=PADDING, data=st.data())
def test_selecting_shortens_and_reorders(order, message, padding, data) -> None:
    order_wanted = data.draw(st.permutations(range(len(message.detections))))
    chosen = order_wanted[: data.draw(st.integers(0, len(order_wanted)))]
    rows = boxes(len(chosen))
    selected = Detections(encode(message, order, padding)).selected(
        np.array(chosen, np.int64), rows
    )
    kept = tuple(with_box(message.detections[i], row) for i, row in zip(chosen, rows, strict=True))
    assert selected == encode(replace(message, detections=kept))


@ORDERS
@given(message=MESSAGES, padding=PADDING, data=st.data())
def test_joining_keeps_the_hypotheses_and_ids_of_all(order, message, padding, data) -> None:
    detections = message.detections
    shuffled = data.draw(st.permutations(range(len(detections))))
    sizes = data.draw(st.lists(st.integers(1, 4), max_size=6))
    bounds = [0, *np.cumsum(sizes).tolist()]
    groups = [group for i, j in pairwise(bounds) if (group := shuffled[i:j])]
    rows = boxes(len(groups))
    joined = Detections(encode(message, order, padding)).joined(groups, rows)
    expected = tuple(
        with_box(
            replace(
                detections[members[0]],
                results=tuple(result for i in members for result in detections[i].results),
                id='|'.join(detections[i].id for i in members),
            ),
            box,
        )
        for members, box in zip(groups, rows, strict=True)
    )
    assert joined == encode(replace(message, detections=expected))


@ORDERS
@given(message=MESSAGES, padding=PADDING)
def test_what_is_written_is_little_endian_with_zeros_between_fields(
    order, message, padding
) -> None:
    assert unchanged(encode(message, order, padding) + b'\xa5') == encode(message)


@ORDERS
@given(message=MESSAGES, padding=PADDING)
def test_the_best_hypothesis_is_the_first_of_the_highest_score(order, message, padding) -> None:
    detections = Detections(encode(message, order, padding))
    class_ids, scores = detections.class_ids(), detections.scores()
    for detection, class_id, score in zip(message.detections, class_ids, scores, strict=True):
        best = None
        for result in detection.results:
            value = -np.inf if np.isnan(result.score) else result.score
            if best is None or value > best[0]:
                best = value, result
        if best is None:
            assert class_id == ''
            assert np.isnan(score)
        else:
            assert class_id == best[1].class_id
            np.testing.assert_equal(score, best[1].score)


@pytest.mark.parametrize('count', [1, 15, 16, 17, 18, 100, 2000])
@pytest.mark.parametrize('kinds', [1, 2, 3])
def test_long_messages_of_few_kinds_are_read_whole(count, kinds) -> None:
    ids = [str(10**k) for k in range(kinds)]
    detections = tuple(
        Detection(bbox=(float(i), 1.0, 2.0, 3.0, 4.0), id=ids[i * i % 7 % kinds])
        for i in range(count)
    )
    message = Message(detections=detections)
    read = Detections(encode(message))
    np.testing.assert_array_equal(read.xywhr()[:, 0], np.arange(count))
    rows = boxes(count)
    assert read.rewrite(rows) == encode(
        replace(message, detections=tuple(map(with_box, detections, rows)))
    )


@ORDERS
@given(
    kinds=st.lists(DETECTIONS, min_size=1, max_size=3),
    picks=st.lists(st.integers(0, 2), min_size=1, max_size=200),
    padding=PADDING,
    trailing=st.integers(0, 6),
)
def test_long_mixed_messages_are_read_whole(order, kinds, picks, padding, trailing) -> None:
    detections = tuple(kinds[pick % len(kinds)] for pick in picks)
    message = Message(detections=detections)
    data = encode(message, order, padding) + bytes(trailing)
    rows = boxes(len(detections))
    expected = encode(replace(message, detections=tuple(map(with_box, detections, rows))))
    for _ in range(3):
        assert Detections(data).rewrite(rows) == expected


@pytest.mark.parametrize('frame_id', ['', 'abc', 'camera', 'x' * 99])
@pytest.mark.parametrize('results', [0, 1, 2])
@pytest.mark.parametrize('class_ids', [('ship', 'tug', 'tanker'), ('', '1')])
def test_many_detections_of_one_frame_take_no_step_for_each(
    monkeypatch, frame_id, results, class_ids
) -> None:
    detections = tuple(
        Detection(
            stamp=(1_800_000_000, i),
            frame_id=frame_id,
            id=str(i * i % 50),
            bbox=(float(i), 1.0, 2.0, 3.0, 4.0),
            results=tuple(Hypothesis(class_ids[i % len(class_ids)], 0.5) for _ in range(results)),
        )
        for i in range(300)
    )
    data = encode(Message(detections=detections), padding=0xA5)
    expected = np.array(encoded_boxes(detections))
    steps = mock.Mock(wraps=elements.walk)
    monkeypatch.setattr(elements, 'walk', steps)
    np.testing.assert_array_equal(Detections(data).xywhr(), expected)
    # One for the header, one for what follows the detections.
    assert steps.call_count == 2


def test_many_detections_of_two_frames_take_a_step_for_each_length(monkeypatch) -> None:
    frames, class_ids = ('port', 'starboard'), ('ship', 'container ship')
    detections = tuple(
        Detection(frame_id=frames[i % 2], results=(Hypothesis(class_ids[i // 2 % 2], 0.5),))
        for i in range(300)
    )
    data = encode(Message(detections=detections), padding=0xA5)
    steps = mock.Mock(wraps=elements.walk)
    monkeypatch.setattr(elements, 'walk', steps)
    assert Detections(data).class_ids() == [d.results[0].class_id for d in detections]
    # Eight to learn which lengths differ, four for the lengths at even and at odd words.
    assert steps.call_count <= 2 + 8 + 2 * 4


def test_detections_of_which_some_have_no_hypothesis_are_walked_over_once(monkeypatch) -> None:
    detections = tuple(
        Detection(frame_id=f'{i}', results=(Hypothesis(),) * (i % 2)) for i in range(300)
    )
    steps = mock.Mock(wraps=elements.walk)
    monkeypatch.setattr(elements, 'walk', steps)
    assert len(Detections(encode(Message(detections=detections)))) == 300
    assert steps.call_count == 2 + 8 + 300


@pytest.mark.parametrize(
    'odd_one',
    [
        Detection(frame_id='other'),
        Detection(results=(Hypothesis(),) * 2),
        Detection(id='y' * 130),
        Detection(results=(Hypothesis('z' * 130),)),
        Detection(id='new'),
    ],
)
def test_one_detection_unlike_the_others_is_found_among_many(odd_one) -> None:
    alike = (Detection(results=(Hypothesis(),)),) * 100
    for detections in (alike, (*alike, odd_one, *alike)) * 3:
        message = Message(detections=detections)
        rows = boxes(len(detections))
        assert Detections(encode(message)).rewrite(rows) == encode(
            replace(message, detections=tuple(map(with_box, detections, rows)))
        )


def test_what_looks_like_a_detection_within_another_does_not_mislead() -> None:
    # The numbers of a hypothesis hold what the first words of a detection hold.
    inner = struct.unpack('<2d', struct.pack('<4I', 0, 0, 2, 0x61))
    alike = Detection(frame_id='a', results=(Hypothesis(),))
    bait = Detection(frame_id='a', results=(Hypothesis(pose=(*inner, 5e-324, *[0.0] * 40)),))
    for detections in ((alike,) * 100, (bait,) * 100, (alike, bait) * 50, (bait, alike) * 50):
        message = Message(detections=detections)
        rows = boxes(len(detections))
        for _ in range(2):
            assert Detections(encode(message)).rewrite(rows) == encode(
                replace(message, detections=tuple(map(with_box, detections, rows)))
            )


@given(message=MESSAGES, data=st.data())
def test_a_message_cut_anywhere_is_refused(message, data) -> None:
    whole = encode(message)
    cut = data.draw(st.integers(0, len(whole) - 1))
    with pytest.raises(WireError):
        Detections(whole[:cut])


@settings(max_examples=150)
@given(message=MESSAGES, data=st.data())
def test_damaged_bytes_raise_the_documented_error_or_are_read(message, data) -> None:
    damaged = bytearray(encode(message))
    for _ in range(data.draw(st.integers(1, 4))):
        place = data.draw(st.integers(0, len(damaged) - 1))
        damaged[place] = data.draw(st.sampled_from([0, 1, 2, 0x7F, 0x80, 0xFF]))
    try:
        detections = Detections(bytes(damaged))
    except WireError:
        return
    # What can be read can be written, and is read again with the boxes that were written.
    rows = boxes(len(detections))
    again = Detections(detections.rewrite(rows)).xywhr()
    np.testing.assert_array_equal(again[:, :4], rows)
    np.testing.assert_array_equal(again[:, 4], 0.0)


@ORDERS
@pytest.mark.parametrize('count', [2**31, 2**32 - 1, 10**6])
def test_a_count_that_cannot_be_is_refused_without_making_room_for_it(order, count) -> None:
    header = encode(Message(), order)[:-4]
    data = header + struct.pack(order + 'I', count) + bytes(1000)
    tracemalloc.start()
    with pytest.raises(WireError, match='cannot hold'):
        Detections(data)
    assert tracemalloc.get_traced_memory()[1] < 100_000
    tracemalloc.stop()


def test_a_count_of_hypotheses_that_the_message_cannot_hold_is_refused() -> None:
    data = bytearray(encode(Message(detections=(Detection(results=()),))))
    at = data.index(b'camera\0', 20) + 8
    data[at : at + 4] = struct.pack('<I', 2**31)
    with pytest.raises(WireError, match='results: 44 bytes cannot hold 2147483648 elements'):
        Detections(bytes(data))


@pytest.mark.parametrize(
    'data',
    [
        b'',
        b'\0',
        b'\0\1\0',
        b'\0\2\0\0' + bytes(40),
        b'\0\3\0\0' + bytes(40),
        b'\1\1\0\0' + bytes(40),
    ],
)
def test_an_encapsulation_that_is_not_plain_cdr_is_refused(data) -> None:
    with pytest.raises(WireError, match='encapsulation'):
        Detections(data)


def test_options_of_the_encapsulation_are_ignored() -> None:
    # Cyclone DDS tells in them how many bytes of padding follow.
    message = Message(detections=(Detection(),))
    data = encode(message)
    assert unchanged(b'\0\1\0\3' + data[4:] + bytes(3)) == data


def test_a_string_without_its_closing_zero_is_refused() -> None:
    data = b'\0\1\0\0' + struct.pack('<iII', 1, 2, 0) + struct.pack('<I', 0)
    with pytest.raises(WireError, match='frame_id'):
        Detections(data)


def test_more_behind_the_message_than_padding_is_refused() -> None:
    with pytest.raises(WireError, match='7 bytes behind'):
        Detections(encode(Message()) + bytes(7))


def test_the_bytes_given_are_never_changed() -> None:
    data = bytearray(encode(Message(detections=(Detection(),)), padding=0xA5))
    before = bytes(data)
    detections = Detections(bytes(data))
    detections.rewrite(boxes(1))
    assert bytes(data) == before


def test_a_class_id_that_is_no_utf_8_is_escaped() -> None:
    message = Message(detections=(Detection(results=(Hypothesis(class_id='zzzz'),)),))
    data = encode(message).replace(b'zzzz', b'\xff\xfe\xfdz')
    detections = Detections(data)
    assert detections.class_ids() == ['\\xff\\xfe\\xfdz']


@pytest.mark.parametrize(
    'class_id',
    [
        b'ship',
        'vaisseau à vapeur ✓'.encode(),
        bytes(range(1, 256)),
        b'\\udc80 \xff',
        b'\xed\xb2\x80',
    ],
)
def test_class_ids_are_escaped_as_python_does(class_id) -> None:
    text = 'z' * len(class_id)
    detection = Detection(results=(Hypothesis(class_id=text),))
    data = encode(Message(detections=(detection, Detection(results=()), detection)))
    detections = Detections(data.replace(text.encode(), class_id))
    expected = class_id.decode(errors='backslashreplace')
    assert detections.class_ids() == [expected, '', expected]
