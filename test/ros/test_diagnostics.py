"""What the node tells of itself on /diagnostics."""

from __future__ import annotations

import time

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from harness import Converter
from harness import Counts
from harness import values_of
from ships import detections
from ships import fleet

from obbhbb_ros.nodes.settings import TABLE


def test_a_report_comes_once_a_second(node: Converter) -> None:
    node.next_report()
    node.wait(lambda: len(node.reports()) >= 4, 'four reports')
    stamps = [report.header.stamp for report in node.reports()]
    times = np.array([stamp.sec + stamp.nanosec * 1e-9 for stamp in stamps])
    assert np.diff(times).mean() == pytest.approx(1.0, abs=0.25)
    assert abs(times[-1] - time.time()) < 10.0


def test_the_report_is_the_nodes_own_and_says_its_state(node: Converter) -> None:
    node.next_report()
    report = node.next_report()
    assert report.name == f'{node.namespace}/obb_to_hbb'.lstrip('/')
    assert report.level == DiagnosticStatus.OK
    assert report.message == 'active'
    assert values_of(report)['state'] == 'active'


def test_messages_and_detections_are_counted(node: Converter) -> None:
    before = node.counts()
    for count in (0, 1, 5, 20):
        node.convert(detections(fleet(count)))
    changed = node.counts().since(before)
    assert changed['messages_received'] == 4
    assert changed['messages_converted'] == 4
    assert changed['detections_received'] == 26


def test_counters_never_start_again(node: Converter) -> None:
    node.convert(detections(fleet(3)))
    one = node.counts()
    node.convert(detections(fleet(3)))
    other = node.counts()
    assert other['messages_received'] == one['messages_received'] + 1
    assert other['detections_received'] == one['detections_received'] + 3


def test_rates_are_those_of_the_last_second(node: Converter) -> None:
    before = node.counts()
    sent = 0
    # From one report to the next.
    seen = len(node.reports())
    while len(node.reports()) == seen:
        node.convert(detections(fleet(4)))
        sent += 1
    report = Counts(node.reports()[seen].status[0])
    counted = report.since(before)['messages_received']
    assert sent - 1 <= counted <= sent
    assert report['messages_received_per_second'] == pytest.approx(counted, rel=0.3)
    assert report['detections_received_per_second'] == pytest.approx(4 * counted, rel=0.3)
    node.next_report()
    assert node.counts()['messages_received_per_second'] == 0.0


def test_latency_percentiles_are_in_order(node: Converter) -> None:
    for _ in range(50):
        node.convert(detections(fleet(20)))
    counts = node.counts()
    names = ('latency_p50_ms', 'latency_p99_ms', 'latency_max_ms')
    p50, p99, worst = (counts[name] for name in names)
    assert 0.0 < p50 <= p99 <= worst
    # Not the time between messages, nor seconds instead of milliseconds.
    assert 0.01 < p50 < 100.0


def test_parameters_in_force_are_all_there(node: Converter) -> None:
    node.set({'q': float('inf'), 'method': 'shape_aware', 'class_ids': ['tug']})
    node.set({'classes.tug.f': 0.5})
    values = values_of(node.next_report())
    assert values['parameter.q'] == 'inf'
    assert values['parameter.method'] == 'shape_aware'
    assert values['parameter.class_ids'] == "['tug']"
    assert values['parameter.classes.tug.f'] == '0.5'
    assert {f'parameter.{spec.name}' for spec in TABLE} <= set(values)
    assert not node.set_atomically({'q': 4.0, 's': 9.0}).successful
    assert values_of(node.next_report())['parameter.q'] == 'inf'


def test_trouble_is_a_warning_in_the_next_report_and_no_longer(node: Converter) -> None:
    node.next_report()
    node.convert(detections([(1.0, 2.0, -3.0, 4.0, 0.0)]))
    report = node.next_report()
    assert report.level == DiagnosticStatus.WARN
    assert 'negative_size' in report.message
    assert f'{node.namespace}/detections' in report.message
    assert values_of(report)['state'] == 'active'
    assert node.next_report().level == DiagnosticStatus.OK
