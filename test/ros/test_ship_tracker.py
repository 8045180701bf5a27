# SPDX-License-Identifier: Apache-2.0
"""The node `ship_tracker` over DDS: any input, all that is not an id as it came."""

from __future__ import annotations

import copy
from collections.abc import Callable
from collections.abc import Iterator
from contextlib import ExitStack
from typing import Any

import numpy as np
import pytest
from harness import Converter
from harness import Site
from harness import unexplained
from harness import values_of
from lifecycle_msgs.msg import Transition
from seas import Sea
from seas import frames
from seas import quality
from seas_over_dds import numbers_of
from sensor_msgs.msg import CameraInfo
from ships import collection
from ships import detections
from ships import rows_of

from obbhbb_ros import OrientedBoxes
from obbhbb_ros.tracking.track_ids import is_tracker_id

FLEET = np.array(
    [
        [500.0, 400.0, 50.0, 10.0, 0.3],
        [900.0, 700.0, 80.0, 12.0, 1.2],
        [1300.0, 300.0, 30.0, 8.0, -0.4],
        [700.0, 820.0, 60.0, 12.0, 2.2],
    ]
)
SIZED = {'image_width': 2000, 'image_height': 1000}
Begin = Callable[..., Converter]


@pytest.fixture
def begin(site: Site) -> Iterator[Begin]:
    """Start trackers."""
    with ExitStack() as stack:

        def begun(**parameters: Any) -> Converter:
            node = Converter(
                site, parameters=parameters, executable='ship_tracker', topic='tracked_detections'
            )
            stack.enter_context(node)
            node.connect()
            return node

        yield begun


def ids_of(message: Any) -> list[str]:
    """List the ids of a message."""
    return [detection.id for detection in message.detections]


def moved(number: int) -> Any:
    """Write the fleet as it lies in an image."""
    return detections(FLEET + [-70.0 * number, 20.0 * number, 0.0, 0.0, 0.0])


def test_ships_keep_their_ids_and_all_else_is_as_it_came(begin: Begin) -> None:
    node = begin(**SIZED)
    seen = []
    for number in range(4):
        message = moved(number)
        answer = node.convert(message)
        seen.append(ids_of(answer))
        for detection in answer.detections:
            detection.id = ''
        assert answer == message
    assert seen[0] == seen[1] == seen[2] == seen[3]
    assert len(set(seen[0])) == len(FLEET)
    assert all(map(is_tracker_id, seen[0]))


@pytest.mark.once
@pytest.mark.parametrize('sea', [Sea(ships=300, strip=15e3), Sea(ships=100, strip=15e3, turn=5.0)])
def test_ships_of_a_strip_keep_their_ids(begin: Begin, sea: Sea) -> None:
    node = begin(image_width=int(sea.size.real), image_height=int(sea.size.imag))
    seen = [(frame.truth, numbers_of(node, frame)) for frame in frames(sea, seed=1)]
    result = quality(*zip(*seen, strict=True))
    assert result.ships > 90
    assert result.ids_per_ship <= 1.06
    assert result.merged <= 0.03


def test_the_size_of_the_image_may_come_from_the_camera(begin: Begin) -> None:
    node = begin()
    assert ids_of(node.convert(moved(0))) == [''] * len(FLEET)
    assert node.counts()['messages_without_image_size']
    publisher = node.peer.publisher(CameraInfo, 'camera_info')
    node.send_until(
        lambda: publisher.publish(CameraInfo(width=2000, height=1000)),
        lambda: all(ids_of(node.convert(moved(1)))),
        'ids',
    )


def test_own_ids_are_kept_until_a_parameter_says_otherwise(begin: Begin) -> None:
    node = begin(**SIZED)
    message = moved(0)
    for detection in message.detections:
        detection.id = 'ship'
    assert node.convert(copy.deepcopy(message)).detections[0].id == 'ship'
    node.wait(lambda: node.counts()['ids_doubtful.repeated'] == len(FLEET), 'a doubt')
    node.set({'ids': 'assign'})
    assert len({*ids_of(node.convert(message))}) == len(FLEET)


def test_boxes_of_polygons_are_published_with_their_ids(begin: Begin) -> None:
    node = begin(input_type='Polygon2DCollection', **SIZED)
    boxes = OrientedBoxes.from_xywhr(FLEET)
    answers = [node.convert(collection(boxes.corners + 40.0 * number)) for number in range(2)]
    assert ids_of(answers[0]) == ids_of(answers[1])
    assert all(map(is_tracker_id, ids_of(answers[0])))
    expected = OrientedBoxes.from_polygons([*boxes.corners])
    rows = rows_of(answers[0])
    np.testing.assert_allclose(rows[:, :4], expected.xywhr[:, :4])
    np.testing.assert_allclose(np.sin(rows[:, 4] - FLEET[:, 4]), 0.0, atol=1e-6)


def test_a_node_that_is_configured_again_begins_a_new_session(begin: Begin) -> None:
    node = begin(**SIZED)
    before = ids_of(node.convert(moved(0)))
    for transition in ('DEACTIVATE', 'CLEANUP', 'CONFIGURE', 'ACTIVATE'):
        assert node.change_state(getattr(Transition, f'TRANSITION_{transition}'))
    node.connect()
    after = ids_of(node.convert(moved(1)))
    assert {text.partition('-')[0] for text in before}.isdisjoint(
        text.partition('-')[0] for text in after
    )


@pytest.mark.once
def test_every_key_is_explained(begin: Begin) -> None:
    node = begin(**SIZED)
    message = detections([*FLEET, [np.nan, 0.0, 1.0, 1.0, 0.0]])
    node.convert(message)
    node.convert(detections(FLEET, name='ship'))
    node.send(message)
    keys = values_of(node.next_report())
    assert {'ids_assigned', 'ids_kept', 'detections_untracked.invalid', 'session'} <= set(keys)
    assert not unexplained(keys, 'ship_tracker.md')
