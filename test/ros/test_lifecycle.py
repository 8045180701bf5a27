# SPDX-License-Identifier: Apache-2.0
"""Every transition of a managed node, by the services that lifecycle managers use."""

from __future__ import annotations

import signal
import time
from collections.abc import Callable

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from harness import Converter
from harness import Counts
from harness import values_of
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import GetAvailableTransitions
from ships import axis_aligned
from ships import detections
from ships import fleet
from ships import rows_of
from vision_msgs.msg import Detection2DArray

# These tests depend on rclpy alone, which is the same in all environments.
pytestmark = pytest.mark.once

Start = Callable[..., Converter]

CONFIGURE = Transition.TRANSITION_CONFIGURE
ACTIVATE = Transition.TRANSITION_ACTIVATE
DEACTIVATE = Transition.TRANSITION_DEACTIVATE
CLEANUP = Transition.TRANSITION_CLEANUP
SHUTDOWN = {
    'unconfigured': Transition.TRANSITION_UNCONFIGURED_SHUTDOWN,
    'inactive': Transition.TRANSITION_INACTIVE_SHUTDOWN,
    'active': Transition.TRANSITION_ACTIVE_SHUTDOWN,
}
WAY = {'unconfigured': (), 'inactive': (CONFIGURE,), 'active': (CONFIGURE, ACTIVATE)}
TOPICS = ('boxes', 'crop_regions')


@pytest.fixture
def managed(start: Start) -> Converter:
    """A node that waits for a lifecycle manager."""
    node = start(parameters={'autostart': False, 'image_width': 640, 'image_height': 480})
    assert node.state() == 'unconfigured'
    return node


def go(node: Converter, *transitions: int) -> None:
    assert all(node.change_state(transition) for transition in transitions)


def outputs(node: Converter) -> list[str]:
    """List the output topics of the node that exist."""
    return [topic for topic in TOPICS if node.peer.node.count_publishers(topic)]


def inputs(node: Converter) -> int:
    """Count the input topics of the node that exist."""
    topics = ('detections', 'camera_info')
    return sum(node.peer.node.count_subscribers(topic) for topic in topics)


def assert_it_converts(node: Converter) -> None:
    node.connect()
    answer = node.convert(detections(fleet(3)))
    np.testing.assert_array_equal(rows_of(answer), axis_aligned(fleet(3)))


def send_while_inactive(node: Converter, count: int) -> None:
    """Send messages until the node has counted this many while inactive."""
    counts = Counts(DiagnosticStatus())
    while counts['messages_while_inactive'] < count:
        for _ in range(count):
            node.send(detections(fleet(1)))
        counts = node.counts()


def test_with_autostart_the_node_is_active_by_itself(start: Start) -> None:
    node = start()
    node.wait(lambda: node.state() == 'active', 'the active state')
    assert_it_converts(node)


def test_without_autostart_it_has_no_topics_but_diagnostics(managed: Converter) -> None:
    # Enough time to discover topics.
    managed.peer.spin_to(time.monotonic() + 1.5)
    assert outputs(managed) == []
    assert inputs(managed) == 0
    assert managed.reports()


WAITING = {
    'unconfigured': 'unconfigured, waits for a lifecycle manager to configure it',
    'inactive': 'inactive, waits for a lifecycle manager to activate it',
    'finalized': 'finalized, restart its process',
}


def test_every_state_in_which_it_does_not_work_is_reported_and_logged(managed: Converter) -> None:
    way = [
        ('unconfigured', ()),
        ('inactive', (CONFIGURE,)),
        ('inactive', (ACTIVATE, DEACTIVATE)),
        ('unconfigured', (CLEANUP,)),
        ('finalized', (SHUTDOWN['unconfigured'],)),
    ]
    for state, transitions in way:
        go(managed, *transitions)
        status = managed.next_report()
        assert (status.level, status.message) == (DiagnosticStatus.WARN, WAITING[state])
        assert values_of(status)['state'] == state
    lines = [line.rpartition(': ')[2] for line in managed.process.log.splitlines()]
    expected = [WAITING[state] for state, _ in way]
    assert [line for line in lines if line in WAITING.values()] == expected
    # It goes on reporting.
    managed.next_report()
    assert managed.next_report().message == WAITING['finalized']


def test_an_active_node_logs_once_what_it_listens_to_and_publishes(start: Start) -> None:
    node = start(arguments=['-r', 'detections:=/yolo/detections'], namespace='/said')
    line = node.wait_for_log('active, listens to')
    assert line.endswith(
        'active, listens to /said/camera_info (CameraInfo), /yolo/detections (Detection2DArray); '
        'publishes /said/boxes, /said/crop_regions, /said/crop_sources, /diagnostics'
    )
    assert len(node.process.log.splitlines()) == 1


def test_inactive_it_publishes_nothing_but_diagnostics(managed: Converter) -> None:
    crops = managed.peer.collect(Detection2DArray, 'crop_regions')
    go(managed, CONFIGURE)
    assert managed.state() == 'inactive'
    managed.wait(lambda: outputs(managed) == list(TOPICS) and inputs(managed) == 2, 'the topics')
    send_while_inactive(managed, 3)
    assert values_of(managed.next_report())['state'] == 'inactive'
    # Anything published before would arrive before the answer to this message.
    go(managed, ACTIVATE)
    stamp = managed.send(detections(fleet(1)))
    for answers in (managed.boxes, crops):
        managed.answer_to(stamp, answers)
        assert [answer.header.stamp.sec for answer in answers] == [stamp]


def test_it_can_be_deactivated_and_activated_again(managed: Converter) -> None:
    go(managed, CONFIGURE, ACTIVATE)
    assert_it_converts(managed)
    go(managed, DEACTIVATE)
    assert managed.state() == 'inactive'
    managed.boxes.clear()
    send_while_inactive(managed, 3)
    assert managed.boxes == []
    go(managed, ACTIVATE)
    assert managed.state() == 'active'
    assert_it_converts(managed)


def test_cleanup_removes_every_topic_and_the_node_can_be_configured_again(
    managed: Converter,
) -> None:
    for _ in range(3):
        go(managed, CONFIGURE, ACTIVATE)
        assert_it_converts(managed)
        go(managed, DEACTIVATE, CLEANUP)
        assert managed.state() == 'unconfigured'
        managed.wait(lambda: not outputs(managed) and not inputs(managed), 'the topics to go')
    managed.publisher.publish(detections(fleet(1)))
    assert managed.set_atomically({'q': 2.0}).successful


def test_parameters_set_while_it_is_unconfigured_hold(managed: Converter) -> None:
    managed.set({'image_width': 1000})
    go(managed, CONFIGURE)
    managed.set({'q': float('inf')})
    go(managed, ACTIVATE)
    managed.connect()
    answer = managed.convert(detections([(0.0, 0.0, 60.0, 20.0, np.pi / 4)]))
    assert rows_of(answer)[0, 2] == pytest.approx(80.0 / np.sqrt(2.0))
    assert managed.get('image_width') == [1000]


def test_it_can_be_cleaned_up_while_messages_flow(managed: Converter) -> None:
    go(managed, CONFIGURE, ACTIVATE)
    assert_it_converts(managed)
    for transition in (DEACTIVATE, CLEANUP, CONFIGURE, ACTIVATE) * 5:
        for _ in range(20):
            managed.send(detections(fleet(5)))
            managed.peer.spin(0.001)
        go(managed, transition)
    assert_it_converts(managed)
    assert 'Traceback' not in managed.process.log
    assert 'in a callback' not in managed.process.log


@pytest.mark.parametrize('state', SHUTDOWN)
def test_it_can_be_shut_down_from_any_state(managed: Converter, state: str) -> None:
    go(managed, *WAY[state])
    assert managed.state() == state
    go(managed, SHUTDOWN[state])
    assert managed.state() == 'finalized'
    managed.wait(lambda: not outputs(managed) and not inputs(managed), 'the topics to go')
    managed.process.send_signal(signal.SIGINT)
    assert managed.process.wait() == 0
    assert 'Traceback' not in managed.process.log


def test_an_impossible_transition_is_refused(managed: Converter) -> None:
    for transition in (ACTIVATE, DEACTIVATE, CLEANUP, SHUTDOWN['active'], 99):
        assert not managed.change_state(transition)
        assert managed.state() == 'unconfigured'
    go(managed, CONFIGURE)
    for transition in (CONFIGURE, DEACTIVATE, SHUTDOWN['unconfigured']):
        assert not managed.change_state(transition)
        assert managed.state() == 'inactive'
    go(managed, ACTIVATE)
    for transition in (CONFIGURE, ACTIVATE, CLEANUP):
        assert not managed.change_state(transition)
        assert managed.state() == 'active'
    assert_it_converts(managed)


def test_a_node_that_cannot_be_configured_logs_why_and_stays_unconfigured(start: Start) -> None:
    override = 'qos_overrides./detections.subscription.reliability'
    arguments = ['-r', 'detections:=/detections']
    node = start(parameters={'autostart': False, override: 'perhaps'}, arguments=arguments)
    assert not node.change_state(CONFIGURE)
    assert node.state() == 'unconfigured'
    node.wait_for_log('cannot configure', 'reliability', 'perhaps')
    node.wait(lambda: not outputs(node) and not inputs(node), 'the topics to go')


def test_lifecycle_tools_can_ask_for_the_available_transitions(managed: Converter) -> None:
    request = GetAvailableTransitions.Request()
    response = managed.call('get_available_transitions', request)
    labels = [available.transition.label for available in response.available_transitions]
    assert sorted(labels) == ['configure', 'shutdown']
