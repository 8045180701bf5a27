# SPDX-License-Identifier: Apache-2.0
"""What the node reports on /diagnostics."""

from __future__ import annotations

import time
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray
from diagnostic_msgs.msg import DiagnosticStatus
from harness import Converter
from harness import Counts
from harness import time_of
from harness import values_of
from lifecycle_msgs.msg import Transition
from rclpy.qos import QoSProfile
from rclpy.qos import ReliabilityPolicy
from rclpy.serialization import serialize_message
from ships import detections
from ships import fleet
from vision_msgs.msg import Detection2DArray

from obbhbb_ros.settings.obb_to_hbb import OBB_TO_HBB

# These tests depend on rclpy alone, which is the same in all environments.
pytestmark = pytest.mark.once


def test_a_report_on_the_node_comes_once_a_second(node: Converter) -> None:
    # The next one may still report the trouble of another test.
    node.next_report()
    node.wait(lambda: len(node.reports()) >= 4, 'four reports')
    times = [time_of(report) for report in node.reports()]
    # After a delayed report, the next one comes sooner.
    assert np.median(np.diff(times)) == pytest.approx(1.0, abs=0.25)
    assert abs(times[-1] - time.time()) < 10.0
    status = node.reports()[-1].status[0]
    assert status.name == f'{node.namespace}/obb_to_hbb'.lstrip('/')
    assert (status.level, status.message) == (DiagnosticStatus.OK, 'active')
    assert values_of(status)['state'] == 'active'


def test_messages_and_detections_are_counted_from_the_start(node: Converter) -> None:
    before = node.counts()
    for total in (26, 52):
        for count in (0, 1, 5, 20):
            node.convert(detections(fleet(count)))
        changed = node.counts().since(before)
        assert changed['messages_received'] == total / 26 * 4
        assert changed['messages_converted'] == total / 26 * 4
        assert changed['detections_received'] == total


def test_rates_are_those_since_the_report_before(node: Converter) -> None:
    node.next_report()

    def with_messages() -> list[tuple[DiagnosticArray, DiagnosticArray]]:
        # On a busy machine, some periods may have no messages.
        return [
            (one, other)
            for one, other in pairwise(node.reports())
            if 'messages_received' in Counts(other.status[0]).since(Counts(one.status[0]))
        ]

    while len(with_messages()) < 2:
        node.convert(detections(fleet(4)))
    for one, other in with_messages():
        counts = Counts(other.status[0])
        changed = counts.since(Counts(one.status[0]))
        assert changed['detections_received'] == 4 * changed['messages_received']
        for name in ('messages_received', 'detections_received'):
            expected = changed[name] / (time_of(other) - time_of(one))
            assert counts[f'{name}_per_second'] == pytest.approx(expected, rel=0.2)
    node.next_report()
    assert Counts(node.next_report())['messages_received_per_second'] == 0.0


def test_latency_percentiles_are_in_order(node: Converter) -> None:
    for _ in range(50):
        node.convert(detections(fleet(20)))
    counts = node.counts()
    names = ('latency_p50_ms', 'latency_p99_ms', 'latency_max_ms')
    p50, p99, worst = (counts[name] for name in names)
    assert 0.0 < p50 <= p99 <= worst
    # Neither the time between messages, nor seconds instead of milliseconds.
    assert 0.01 < p50 < 100.0


def test_all_parameters_in_force_are_reported(node: Converter) -> None:
    node.set({'q': float('inf'), 'method': 'shape_aware', 'class_ids': ['tug']})
    node.set({'classes.tug.f': 0.5})
    values = values_of(node.next_report())
    assert values['parameter.q'] == '.inf'
    assert values['parameter.method'] == 'shape_aware'
    assert values['parameter.class_ids'] == '["tug"]'
    assert values['parameter.classes.tug.f'] == '0.5'
    assert values['parameter.clip_boxes'] == 'false'
    assert {f'parameter.{spec.name}' for spec in OBB_TO_HBB.rows} <= set(values)
    assert not node.set_atomically({'q': 4.0, 's': 9.0}).successful
    assert values_of(node.next_report())['parameter.q'] == '.inf'


def test_trouble_is_a_warning_in_the_next_report_alone(node: Converter) -> None:
    before = node.counts()
    node.convert(detections([(1.0, 2.0, -3.0, 4.0, 0.0)]))

    def reports_of_it() -> list[DiagnosticStatus]:
        return [
            report.status[0]
            for report in node.reports()
            if Counts(report.status[0]).since(before, 'detections_dropped')
        ]

    node.wait(lambda: len(reports_of_it()) >= 2, 'two reports')
    report, later, *_ = reports_of_it()
    assert report.level == DiagnosticStatus.WARN
    assert 'negative_size' in report.message
    assert f'{node.namespace}/detections' in report.message
    assert values_of(report)['state'] == 'active'
    assert later.level == DiagnosticStatus.OK


def test_silence_is_an_error_and_then_stale_until_input_comes(
    start: Callable[..., Converter],
) -> None:
    node = start()
    node.connect()
    # Only now, because connecting may take a while.
    node.set({'input_timeout': 1.5})
    node.wait(lambda: node.next_report().level == DiagnosticStatus.ERROR, 'an error')
    assert node.next_report().message.startswith('no input for ')
    node.wait(lambda: node.next_report().level == DiagnosticStatus.STALE, 'stale')
    assert node.process.log.count('no input for') == 1
    node.convert(detections(fleet(1)))
    node.wait(
        lambda: any(report.status[0].level == DiagnosticStatus.OK for report in node.reports()),
        'the end of the silence',
    )
    assert 'input is back' in node.process.log


def test_no_input_is_expected_while_inactive_or_without_a_timeout(
    start: Callable[..., Converter],
) -> None:
    node = start(parameters={'input_timeout': 0.1, 'autostart': False})
    node.change_state(Transition.TRANSITION_CONFIGURE)
    for _ in range(3):
        assert node.next_report().level == DiagnosticStatus.WARN
    node.set({'input_timeout': 0.0})
    node.change_state(Transition.TRANSITION_ACTIVATE)
    for _ in range(3):
        assert node.next_report().level == DiagnosticStatus.OK


def test_a_silent_node_that_is_deactivated_does_not_log_that_input_is_back(
    start: Callable[..., Converter],
) -> None:
    node = start()
    node.connect()
    node.set({'input_timeout': 0.5})
    node.wait(lambda: node.next_report().level == DiagnosticStatus.ERROR, 'an error')
    assert node.change_state(Transition.TRANSITION_DEACTIVATE)
    node.wait(lambda: node.next_report().level == DiagnosticStatus.WARN, 'no more of it')
    assert 'input is back' not in node.process.log


def test_diagnostics_come_while_a_simulated_clock_stands_still(
    start: Callable[..., Converter], tmp_path: Path
) -> None:
    state = tmp_path / 'state.json'
    node = start(parameters={'use_sim_time': True, 'state.path': str(state)})
    node.wait(lambda: len(node.reports()) >= 2, 'diagnostics')
    first = state.read_bytes()
    node.wait(lambda: state.read_bytes() != first, 'the next state file')


def test_the_hardware_is_the_node_unless_it_has_another_name(node: Converter) -> None:
    assert node.next_report().hardware_id == f'{node.namespace}/obb_to_hbb'
    node.set({'hardware_id': 'payload 2'})
    node.wait(lambda: node.next_report().hardware_id == 'payload 2', 'the other name')


def test_lost_large_messages_are_counted_and_reported(start: Callable[..., Converter]) -> None:
    node = start()
    node.connect()
    best_effort = QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT)
    publisher = node.peer.node.create_publisher(Detection2DArray, 'detections', best_effort)
    node.wait(publisher.get_subscription_count, 'the node')
    large = detections(fleet(2000))
    data = serialize_message(large)
    # A loss is noticed when the next message arrives, and the size when one has arrived.
    profile = 'config/fastdds_large.xml'
    node.wait(lambda: publisher.publish(data) or profile in node.process.log, 'the warning')
    line = node.wait_for_log('the middleware lost', f'{node.namespace}/detections', profile)
    assert 'a publisher on it is best effort' in line
    assert node.counts()['messages_lost'] > 0
