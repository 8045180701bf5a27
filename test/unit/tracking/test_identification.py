# SPDX-License-Identifier: Apache-2.0
"""Messages get ids and nothing else changes; what gets none is counted and reported."""

from dataclasses import replace

import numpy as np
import pytest
from cdr import MESSAGES
from cdr import Detection
from cdr import Message
from cdr import encode
from hypothesis import given

from obbhbb_ros.geometry.input_frame import InputFrame
from obbhbb_ros.identification import ShipIdentifier
from obbhbb_ros.identification import TrackerOutputs
from obbhbb_ros.pipeline import NOBODY
from obbhbb_ros.pipeline import Output
from obbhbb_ros.settings.ship_tracker import SHIP_TRACKER
from obbhbb_ros.tracking.matcher import MAX_BOXES
from obbhbb_ros.tracking.track_ids import is_tracker_id
from obbhbb_ros.wire.detections import Detections
from obbhbb_ros.wire.layouts import INPUT_TYPES

TYPE = INPUT_TYPES['Detection2DArray']
SIZED = {'image_width': 2000, 'image_height': 1000}
NAN = float('nan')


class Identified:
    """An identifier, and what it publishes."""

    def __init__(self, **values) -> None:
        self.identifier = ShipIdentifier()
        self.sent = []
        self.settings = SHIP_TRACKER.settings(SIZED | values)

    def give(self, message):
        """Give a message; return the outcome, and the ids that were published."""
        outputs = TrackerOutputs(Output(self.sent.append))
        data = encode(message)
        outcome = self.identifier.answer(data, TYPE, self.settings, None, outputs)
        return outcome, Detections(self.sent[-1]).ids()


def boxes_of(*rows):
    """Make detections without id from x, y, and length."""
    return tuple(Detection(bbox=(x, y, 0.4, size, size / 5), id='') for x, y, size in rows)


def frame(number, *detections):
    """Make the message of an image every tenth of a second."""
    return Message(stamp=(number // 10, number % 10 * 100_000_000), detections=detections)


FLEET = [(500.0, 400.0, 50.0), (900.0, 700.0, 80.0), (1300.0, 300.0, 30.0)]


def test_ships_keep_their_ids_while_the_image_moves() -> None:
    tracker = Identified()
    seen = []
    for number in range(4):
        moved = [(x - 60.0 * number, y, size) for x, y, size in FLEET]
        outcome, ids = tracker.give(frame(number, *boxes_of(*moved)))
        seen.append(ids)
        assert outcome.counts['ids_assigned'] == 3
        assert outcome.complaints == {}
    assert seen[0] == seen[1] == seen[2] == seen[3]
    assert all(map(is_tracker_id, seen[0]))
    assert len(set(seen[0])) == 3
    assert tracker.identifier.ships_remembered == 3


@given(MESSAGES)
def test_only_ids_change(message) -> None:
    tracker = Identified(ids='assign')
    _, ids = tracker.give(message)
    changed = tuple(
        replace(one, id=text) for one, text in zip(message.detections, ids, strict=True)
    )
    assert tracker.sent == [encode(replace(message, detections=changed))]


@given(MESSAGES)
def test_own_ids_are_kept_to_the_last_byte(message) -> None:
    own = tuple(replace(one, id=one.id or 'own') for one in message.detections)
    message = replace(message, detections=own)
    tracker = Identified()
    tracker.give(message)
    assert tracker.sent == [encode(message)]


def test_detections_without_an_id_get_one_beside_those_that_have_one() -> None:
    first, second, third = boxes_of(*FLEET)
    message = frame(0, first, replace(second, id='12'), third)
    outcome, ids = Identified().give(message)
    assert ids[1] == '12'
    assert is_tracker_id(ids[0])
    assert is_tracker_id(ids[2])
    assert (outcome.counts['ids_kept'], outcome.counts['ids_assigned']) == (1, 2)


def test_ids_of_the_input_can_be_replaced() -> None:
    message = frame(0, *(replace(one, id='ship') for one in boxes_of(*FLEET)))
    outcome, ids = Identified(ids='assign').give(message)
    assert len(set(ids)) == 3
    assert outcome.complaints == {}
    outcome, ids = Identified().give(message)
    assert ids == ['ship'] * 3
    assert outcome.counts['ids_doubtful.repeated'] == 3
    assert 'ids: assign' in outcome.complaints['ids_doubtful.repeated']


def test_invalid_detections_are_passed_on_without_id_and_counted() -> None:
    message = frame(0, *boxes_of(FLEET[0], (NAN, 5.0, 40.0), (500.0, 5.0, -4.0), (3e7, 5.0, 40.0)))
    outcome, ids = Identified().give(message)
    assert [bool(text) for text in ids] == [True, False, False, False]
    assert outcome.counts['detections_untracked.invalid'] == 2
    assert outcome.counts['detections_untracked.not_followed'] == 1
    assert 'index 1 is invalid' in outcome.complaints['untracked']


def test_of_too_many_detections_some_get_no_id() -> None:
    rows = [(10.0 + i % 190 * 10, 10.0 + i // 190 * 10, 20.0) for i in range(MAX_BOXES + 7)]
    outcome, ids = Identified().give(frame(0, *boxes_of(*rows)))
    assert outcome.counts['detections_untracked.not_followed'] == ids.count('') == 7


def test_without_the_size_of_the_image_no_ship_gets_an_id() -> None:
    tracker = Identified(image_width=0)
    message = frame(0, *boxes_of(*FLEET))
    outcome, ids = tracker.give(message)
    assert ids == ['', '', '']
    assert outcome.counts['messages_without_image_size'] == 1
    assert 'camera_info' in outcome.complaints['no image size']
    assert tracker.sent == [encode(message)]


def test_stamps_that_do_not_grow_are_reported() -> None:
    tracker = Identified()
    tracker.give(frame(1, *boxes_of(*FLEET)))
    for number in (1, 0):
        outcome, _ = tracker.give(frame(number, *boxes_of(*FLEET)))
        assert outcome.counts['stamps_not_later'] == 1
        assert 'which must increase' in outcome.complaints['stamps']
        assert outcome.counts['ids_assigned'] == 3
    outcome, _ = tracker.give(frame(2, *boxes_of(*FLEET)))
    assert 'stamps_not_later' not in outcome.counts


def test_nothing_is_read_that_nobody_wants() -> None:
    outcome = ShipIdentifier().answer(
        b'', TYPE, SHIP_TRACKER.settings(SIZED), None, TrackerOutputs(NOBODY)
    )
    assert outcome.counts == {'messages_without_subscriber': 1}


def test_ships_are_followed_in_pixels_of_the_image_whatever_the_input() -> None:
    values = {'angle_unit': 'deg', 'input_width': 640, 'input_height': 640}
    tracker = Identified(input_fit='letterbox', **values)
    seen = []
    for number in range(3):
        rows = [(x * 0.32 - 20.0 * number, 160 + y * 0.32, size * 0.32) for x, y, size in FLEET]
        message = frame(number, *boxes_of(*rows))
        _, ids = tracker.give(message)
        seen.append(ids)
        np.testing.assert_array_equal(
            Detections(tracker.sent[-1]).xywhr(), Detections(encode(message)).xywhr()
        )
    assert seen[0] == seen[1] == seen[2]


@pytest.mark.parametrize(
    'frame_of_input', [InputFrame((0, 0)), InputFrame((640, 640), 'letterbox', np.pi / 180)]
)
def test_a_session_has_ids_of_its_own(frame_of_input) -> None:
    sessions = []
    for _ in range(2):
        tracker = Identified()
        tracker.settings = replace(tracker.settings, input_frame=frame_of_input)
        _, ids = tracker.give(frame(0, *boxes_of(*FLEET)))
        sessions.append({text.partition('-')[0] for text in ids})
    assert sessions[0].isdisjoint(sessions[1])
