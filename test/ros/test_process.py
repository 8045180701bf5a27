# SPDX-License-Identifier: Apache-2.0
"""The executable as users start and stop it: files, names, signals, quality of service."""

from __future__ import annotations

import contextlib
import os
import re
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable
from collections.abc import Iterator
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from diagnostic_msgs.msg import DiagnosticStatus
from documentation import NODE_TABLES
from harness import ROSOUT
from harness import TIMEOUT
from harness import Converter
from harness import NodeProcess
from harness import Peer
from harness import Site
from lifecycle_msgs.msg import Transition
from rcl_interfaces.msg import Log
from rclpy.qos import DurabilityPolicy
from rclpy.qos import QoSProfile
from rclpy.qos import ReliabilityPolicy
from sensor_msgs.msg import CameraInfo
from ships import axis_aligned
from ships import detections
from ships import fleet
from ships import rows_of
from vision_msgs.msg import Detection2DArray

from obbhbb_ros import __version__
from obbhbb_ros.geometry.converter import Caps
from obbhbb_ros.geometry.converter import HullRule
from obbhbb_ros.settings.obb_to_hbb import OBB_TO_HBB

# These tests depend on rclpy alone, which is the same in all environments.
pytestmark = pytest.mark.once

Start = Callable[..., Converter]

CONFIG = Path(__file__).parents[2] / 'config'
PAPER = {'method': 'shape_aware', 'q': 2.2, 'f': 0.9, 's': 1.0}


# Parameter files ------------------------------------------------------------------------------


def flat(tree: Mapping[str, Any], prefix: str = '') -> Iterator[tuple[str, Any]]:
    for name, value in tree.items():
        if isinstance(value, dict):
            yield from flat(value, f'{prefix}{name}.')
        else:
            yield prefix + name, value


@pytest.mark.parametrize(
    ('file', 'rule'), [('obb_to_hbb.yaml', HullRule()), ('paper.yaml', HullRule(**PAPER))]
)
def test_a_shipped_parameter_file_gives_what_it_states(
    start: Start, file: str, rule: HullRule
) -> None:
    path = CONFIG / file
    stated = dict(flat(yaml.safe_load(path.read_text(encoding='utf-8'))['/**']['ros__parameters']))
    assert list(stated) == [spec.name for spec in OBB_TO_HBB.rows]
    node = start(arguments=['--params-file', str(path)])
    node.connect()
    assert dict(zip(stated, node.get(*stated), strict=True)) == stated
    answer = rows_of(node.convert(detections(fleet(5))))
    np.testing.assert_array_equal(answer, axis_aligned(fleet(5), rule))
    assert 'WARN' not in node.process.log


MISSION_YAML = """
/**/payload/ships:
  ros__parameters:
    method: shape_aware
    q: 2.5
    s: 0.9
    max_length: 100.0
    fulness: 0.9
    crop: {max_counts: 3}
/**/obb_to_hbb:
  ros__parameters: {method: outer}
"""


def test_a_parameter_file_is_used_by_the_name_of_the_node(start: Start, tmp_path: Path) -> None:
    file = tmp_path / 'mission.yaml'
    file.write_text(MISSION_YAML)
    arguments = ['--params-file', str(file), '-p', 's:=0.95', '-r', '__node:=ships']
    node = start(arguments=arguments, namespace='/sat/payload')
    node.connect()
    answer = rows_of(node.convert(detections(fleet(5))))
    rule = HullRule('shape_aware', q=2.5, s=0.95)
    np.testing.assert_array_equal(answer, axis_aligned(fleet(5), rule, Caps(100.0)))
    warning = node.wait_for_log('unknown parameters')
    assert 'fulness' in warning
    assert 'crop.max_counts' in warning
    assert 'q' not in warning.partition('unknown parameters')[2].split(', ')


@pytest.mark.parametrize(
    ('content', 'remap'),
    [
        ('obb_to_hbb: {ros__parameters: {q: 2.0}}', '__ns:=/a'),
        ('obb_to_hbb: {ros__parameters: {q: 2.0}}', '__node:=left_boxes'),
        ('/*/obb_to_hbb: {ros__parameters: {q: 2.0}}', '__ns:=/a/b'),
        ('chip_extractor: {ros__parameters: {quality: 90}}', '__ns:=/'),
        ('', '__ns:=/'),
    ],
)
def test_a_parameter_file_without_parameters_for_the_node_is_named(
    site: Site, tmp_path: Path, content: str, remap: str
) -> None:
    file = tmp_path / 'flight.yaml'
    file.write_text(content + '\n')
    arguments = ['-r', remap, '--params-file', str(file)]
    with site.start('obb_to_hbb', arguments=arguments) as process:
        wait_until(lambda: 'no parameters for' in process.log)
        (line,) = (text for text in process.log.splitlines() if 'no parameters for' in text)
    assert 'WARN' in line
    assert f'{file}: no parameters for /' in line


SHARED_YAML = """
/**:
  ros__parameters: {q: 2.0, codec: png, image_widht: 5, classes: {tug: {weight: 2.0}}}
chip_extractor:
  ros__parameters: {quality: 90, layers: [boxes]}
"""


def test_of_a_file_for_several_nodes_only_names_that_no_node_has_are_warned_of(
    site: Site, tmp_path: Path
) -> None:
    file = tmp_path / 'shared.yaml'
    file.write_text(SHARED_YAML)
    with site.start('chip_extractor', arguments=['--params-file', str(file)]) as process:
        wait_until(lambda: 'of other nodes' in process.log)
        warning, info, *_ = process.log.splitlines()
    assert warning.endswith('unknown parameters, ignored: image_widht, layers')
    assert info.endswith('parameters of other nodes, ignored: classes.tug.weight, q')


def wait_until(condition: Callable[[], bool]) -> None:
    deadline = time.monotonic() + TIMEOUT
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.05)


def test_topics_can_be_remapped(start: Start) -> None:
    arguments = []
    for topic in ('detections', 'boxes', 'crop_regions', 'camera_info'):
        arguments += ['-r', f'{topic}:=elsewhere/{topic}']
    node = start(arguments=arguments, listen=False)
    boxes = node.peer.collect(Detection2DArray, 'elsewhere/boxes')
    publisher = node.peer.publisher(Detection2DArray, 'elsewhere/detections')
    node.wait(lambda: publisher.publish(detections(fleet(3))) or boxes, 'boxes')
    np.testing.assert_array_equal(rows_of(boxes[0]), axis_aligned(fleet(3)))
    names = dict(node.peer.node.get_topic_names_and_types())
    for topic in ('detections', 'boxes', 'crop_regions', 'camera_info'):
        assert f'{node.namespace}/{topic}' not in names
        assert f'{node.namespace}/elsewhere/{topic}' in names


def test_every_topic_but_diagnostics_is_in_the_namespace(start: Start) -> None:
    node = start()
    node.connect()
    arguments = ('obb_to_hbb', node.namespace)
    graph = node.peer.node
    # Topics and nodes are discovered separately.
    node.wait(lambda: arguments in graph.get_node_names_and_namespaces(), 'the node in the graph')
    inside = {f'{node.namespace}/{topic}' for topic in ('boxes', 'crop_regions')}
    node.wait(
        lambda: (
            {*inside, '/diagnostics'}
            <= set(dict(graph.get_publisher_names_and_types_by_node(*arguments)))
        ),
        'what it publishes',
    )
    inside = {f'{node.namespace}/{topic}' for topic in ('detections', 'camera_info')}
    subscribed: set[str] = set()

    def has_subscribed() -> bool:
        subscribed.update(dict(graph.get_subscriber_names_and_types_by_node(*arguments)))
        return inside <= subscribed

    node.wait(has_subscribed, 'what it subscribes to')
    assert f'{node.namespace}/polygons' not in subscribed


def test_two_nodes_in_two_namespaces_do_not_hear_each_other(start: Start) -> None:
    one, other = start(), start(parameters={'method': 'outer'})
    one.connect()
    other.connect()
    np.testing.assert_array_equal(
        rows_of(one.convert(detections(fleet(3)))), axis_aligned(fleet(3))
    )
    np.testing.assert_array_equal(
        rows_of(other.convert(detections(fleet(3)))), axis_aligned(fleet(3), HullRule('outer'))
    )
    for node in (one, other):
        node.peer.spin_to(time.monotonic() + 0.5)
        assert len(node.boxes) == 1


# The end --------------------------------------------------------------------------------------

SIGNALS = pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGTERM], ids=lambda s: s.name)
SOON = 10.0


def assert_clean_end(node: Converter) -> None:
    assert node.process.wait(SOON) == 0
    assert 'Traceback' not in node.process.log
    assert 'rror' not in node.process.log


@SIGNALS
def test_a_signal_ends_an_idle_node_cleanly(start: Start, number: int) -> None:
    node = start()
    node.connect()
    node.process.send_signal(number)
    assert_clean_end(node)


@SIGNALS
def test_a_signal_ends_a_busy_node_cleanly(start: Start, number: int) -> None:
    node = start()
    node.connect()
    for sent in range(10_000):
        if sent == 50:
            node.process.send_signal(number)
        node.publisher.publish(detections(fleet(20)))
        node.peer.spin(0.002)
        if not node.process.running:
            break
    assert_clean_end(node)


@SIGNALS
def test_a_signal_ends_a_node_that_is_not_configured_cleanly(start: Start, number: int) -> None:
    node = start(parameters={'autostart': False})
    assert node.state() == 'unconfigured'
    node.process.send_signal(number)
    assert_clean_end(node)


EXECUTABLES = ['obb_to_hbb', 'chip_extractor', 'overlay', 'play_detections', 'ship_tracker']
# From the first line, through imports and the start of the node, to a running node.
MOMENTS = [0.0, 0.1, 0.5, 1.0]
# Ctrl-C in a terminal reaches a launched node twice; later signals arrive while it ends.
BURSTS = {
    'twice at once': [(0.0, signal.SIGINT), (0.0, signal.SIGINT)],
    'twice': [(0.0, signal.SIGINT), (0.02, signal.SIGINT)],
    'both': [(0.0, signal.SIGINT), (0.05, signal.SIGTERM), (0.0, signal.SIGINT)],
    'at the end': [(0.0, signal.SIGTERM), *[(0.01, signal.SIGINT)] * 30],
}


@pytest.mark.skipif(not Path('/proc/self/status').exists(), reason='needs Linux')
@pytest.mark.parametrize('burst', BURSTS.values(), ids=BURSTS)
@pytest.mark.parametrize('executable', EXECUTABLES)
def test_the_end_is_clean_however_many_signals_arrive_and_when(
    site: Site, executable: str, burst: list[tuple[float, int]]
) -> None:
    for moment in MOMENTS:
        with site.start(executable) as process:
            while not process.has_signals_in_hand:
                time.sleep(0.001)
            time.sleep(moment)
            for pause, number in burst:
                time.sleep(pause)
                process.send_signal(number)
            assert process.wait(SOON) == 0, (moment, process.log)
        assert not re.search('Traceback|rror|KeyboardInterrupt', process.log)


STUCK = """
import time; from obbhbb_ros.nodes.running.stop import Stop; stop = Stop(); stop.patience = 1.5
print('stuck', flush=True); time.sleep(60)
"""


@pytest.mark.parametrize('closed', ['', '2>&-'], ids=['with a log', 'without'])
def test_a_node_that_hangs_at_its_end_exits_and_logs_where(tmp_path: Path, closed: str) -> None:
    shell = f'exec {sys.executable} -c "{STUCK}" {closed}'
    with NodeProcess(['sh', '-c', shell], tmp_path / 'log') as process:
        while 'stuck' not in process.log:
            assert process.running
            time.sleep(0.01)
        process.send_signal(signal.SIGTERM)
        assert process.wait(SOON) == 1
        if not closed:
            assert 'not ended 1.5 s after a signal' in process.log
            assert 'File "<string>", line 3' in process.log


@pytest.mark.skipif(not Path('/proc/self/stat').exists(), reason='needs Linux')
def test_a_node_with_nothing_to_do_does_next_to_nothing(start: Start) -> None:
    node = start()
    node.connect()
    node.next_report()
    started, before = time.monotonic(), node.process.cpu_seconds()
    node.wait(lambda: len(node.reports()) >= 4, 'three seconds')
    # On a busy machine it may take longer.
    assert (node.process.cpu_seconds() - before) / (time.monotonic() - started) < 0.1


# What cannot start ----------------------------------------------------------------------------

BAD_PARAMETERS = [
    ({'q': 0.5}, ('q', '0.5', '1 to inf')),
    ({'q': 3}, ('q', '3', 'DOUBLE', 'INTEGER')),
    ({'f': 0.0}, ('f', '0.0', 'above 0 and at most 2')),
    ({'s': float('nan')}, ('s', 'nan')),
    ({'method': 'elipse'}, ('method', 'elipse', 'superellipse')),
    ({'input_type': 'Image'}, ('input_type', 'Image', 'Detection2DArray')),
    ({'crop.min_size': 9, 'crop.max_size': 5}, ('crop.max_size', '5', 'min_size', '9')),
    ({'class_ids': ['tug'], 'classes.tug.q': 0.5}, ('classes.tug.q', '0.5')),
    ({'image_width': -3}, ('image_width', '-3')),
]


@pytest.fixture(scope='module')
def failures(site: Site) -> Iterator[list[NodeProcess]]:
    """Nodes that cannot start, all at the same time."""
    with contextlib.ExitStack() as stack:
        yield [
            stack.enter_context(site.start('obb_to_hbb', parameters=parameters))
            for parameters, _ in BAD_PARAMETERS
        ]


@pytest.mark.parametrize('case', range(len(BAD_PARAMETERS)))
def test_bad_parameters_end_the_start_with_one_line(failures: list[NodeProcess], case: int) -> None:
    assert failures[case].wait() == 1
    (line,) = failures[case].log.splitlines()
    assert line.startswith('cannot start: ')
    assert all(text in line for text in BAD_PARAMETERS[case][1])


def assert_refused(process: NodeProcess, *texts: str) -> None:
    assert process.wait() == 1
    # A library of ROS may log something before it.
    line = process.log.splitlines()[-1]
    assert line.startswith('cannot start: ')
    assert all(text in line for text in texts)
    assert 'Traceback' not in process.log


@pytest.mark.parametrize(
    ('arguments', 'text'),
    [
        (['--params-file', '/nowhere/ships.yaml'], '/nowhere/ships.yaml'),
        (['-p', 'q'], "'-p q'"),
        (['-r', '__ns:=not-a-name'], 'not-a-name'),
        (['--log-level', 'loud'], 'loud'),
    ],
)
def test_a_bad_command_line_ends_the_start_without_traceback(
    site: Site, arguments: list[str], text: str
) -> None:
    with site.start('obb_to_hbb', arguments=arguments) as process:
        assert_refused(process, text)


def test_security_that_is_asked_for_and_cannot_be_had_ends_the_start(
    site: Site, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Without keys, and on PyPI without the middleware for them.
    (tmp_path / 'enclaves' / 'ships').mkdir(parents=True)
    for name, value in (('KEYSTORE', str(tmp_path)), ('ENABLE', 'true'), ('STRATEGY', 'Enforce')):
        monkeypatch.setenv(f'ROS_SECURITY_{name}', value)
    with site.start('obb_to_hbb', arguments=['--enclave', '/ships']) as process:
        assert_refused(process, 'error creating node')


def test_an_argument_that_the_locale_cannot_read_ends_the_start(
    site: Site, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name, value in (('LC_ALL', 'C'), ('PYTHONCOERCECLOCALE', '0'), ('PYTHONUTF8', '0')):
        monkeypatch.setenv(name, value)
    with site.start('obb_to_hbb', arguments=['-p', 'hardware_id:=Käfer']) as process:
        assert_refused(process, 'hardware_id:=K', 'LANG=C.UTF-8')


FAILING = """
import sys
from obbhbb_ros.nodes.running.process import run
from obbhbb_ros.nodes.running.stop import Stop

def make_node():
    raise {error}

sys.exit(run({{'node': make_node}}, Stop()))
"""


@pytest.mark.parametrize(
    ('error', 'text'),
    [
        ('MemoryError()', 'too little memory'),
        ("RuntimeError('no thread\\nleft')", 'no thread left'),
        ('OSError()', 'OSError'),
        ("ImportError('no Pillow')", 'no Pillow'),
    ],
)
def test_what_the_machine_lacks_ends_the_start_with_one_line(
    tmp_path: Path, error: str, text: str
) -> None:
    command = [sys.executable, '-c', FAILING.format(error=error)]
    with NodeProcess(command, tmp_path / 'log') as process:
        assert_refused(process, text)


# What is not for ROS --------------------------------------------------------------------------


def asked(*arguments: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, '-m', 'obbhbb_ros.nodes', *arguments]
    return subprocess.run(command, check=False, capture_output=True, text=True, timeout=TIMEOUT)


@pytest.mark.parametrize('node', NODE_TABLES)
def test_help_lists_the_parameters(node: str) -> None:
    answer = asked(node, '--help')
    assert answer.returncode == 0
    assert answer.stdout.startswith(f'usage: {node} ')
    assert all(f'\n  {row.name} (' in answer.stdout for row in NODE_TABLES[node].rows)


def test_version_is_that_of_the_package() -> None:
    answer = asked('obb_to_hbb', '--version', '--ros-args', '-p', 'q:=2.0')
    assert (answer.returncode, answer.stdout) == (0, f'obb_to_hbb {__version__}\n')


@pytest.mark.parametrize(
    ('arguments', 'unknown'),
    [(['-p', 'q:=2.0'], '-p q:=2.0'), (['--ros-args', '-p', 'q:=2.0', '--', 'ships'], 'ships')],
)
def test_an_argument_that_is_not_for_ros_ends_the_start(arguments: list[str], unknown: str) -> None:
    answer = asked('obb_to_hbb', *arguments)
    assert (answer.returncode, answer.stdout) == (1, '')
    (line,) = answer.stderr.splitlines()
    assert line.startswith(f'cannot start: unknown arguments: {unknown}; ')


# Quality of service ---------------------------------------------------------------------------

BEST_EFFORT = QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT)


def profiles(node: Converter) -> dict[str, QoSProfile]:
    """Return the profiles that the node requests and offers, by topic."""
    graph = node.peer.node
    topics = {
        'detections': graph.get_subscriptions_info_by_topic,
        'camera_info': graph.get_subscriptions_info_by_topic,
        'boxes': graph.get_publishers_info_by_topic,
        'crop_regions': graph.get_publishers_info_by_topic,
    }

    def infos(topic: str) -> list[Any]:
        endpoints = topics[topic](f'{node.namespace}/{topic}')
        return [endpoint for endpoint in endpoints if endpoint.node_name == 'obb_to_hbb']

    return {
        topic: node.wait_for(lambda topic=topic: infos(topic), topic).qos_profile
        for topic in topics
    }


def test_without_publishers_all_topics_are_reliable(start: Start) -> None:
    got = profiles(start())
    assert {profile.reliability for profile in got.values()} == {ReliabilityPolicy.RELIABLE}
    assert {profile.durability for profile in got.values()} == {DurabilityPolicy.VOLATILE}


def test_the_overrides_of_an_input_say_that_it_follows_its_publishers(start: Start) -> None:
    node = start(namespace='/follows', listen=False)
    prefix = 'qos_overrides./follows/detections.subscription'
    assert node.get(f'{prefix}.reliability', f'{prefix}.durability') == ['best_available'] * 2


QOS_YAML = """
/**:
  ros__parameters:
    qos_overrides:
      /qos_test/detections: {subscription: {reliability: reliable, depth: 3}}
      /qos_test/camera_info: {subscription: {reliability: best_effort, durability: transient_local}}
      /qos_test/boxes: {publisher: {reliability: best_effort, history: keep_all}}
      /qos_test/crop_regions: {publisher: {durability: transient_local}}
"""


def test_a_parameter_file_can_override_the_profiles(start: Start, tmp_path: Path) -> None:
    file = tmp_path / 'qos.yaml'
    file.write_text(QOS_YAML)
    node = start(arguments=['--params-file', str(file)], namespace='/qos_test', listen=False)
    got = profiles(node)
    assert {topic: profile.reliability for topic, profile in got.items()} == {
        'detections': ReliabilityPolicy.RELIABLE,
        'camera_info': ReliabilityPolicy.BEST_EFFORT,
        'boxes': ReliabilityPolicy.BEST_EFFORT,
        'crop_regions': ReliabilityPolicy.RELIABLE,
    }
    assert {topic: profile.durability for topic, profile in got.items()} == {
        'detections': DurabilityPolicy.VOLATILE,
        'camera_info': DurabilityPolicy.TRANSIENT_LOCAL,
        'boxes': DurabilityPolicy.VOLATILE,
        'crop_regions': DurabilityPolicy.TRANSIENT_LOCAL,
    }
    # DDS does not announce history and depth.
    prefix = 'qos_overrides./qos_test'
    names = f'{prefix}/detections.subscription.depth', f'{prefix}/boxes.publisher.history'
    assert node.get(*names) == [3, 'keep_all']
    assert 'WARN' not in node.process.log


def test_an_override_that_matches_no_topic_or_policy_is_reported(start: Start) -> None:
    unused = [
        'qos_overrides./detections.subscription.depth',
        'qos_overrides./odd/detections.subscription.lifespan',
    ]
    used = 'qos_overrides./odd/detections.subscription.depth'
    node = start(parameters=dict.fromkeys([*unused, used], 3), namespace='/odd')
    line = node.wait_for_log('ignored, no such topic')
    assert line.endswith(': ' + ', '.join(unused))


def test_messages_of_best_effort_detectors_are_received(start: Start) -> None:
    node = start()
    publisher = node.peer.publisher(Detection2DArray, 'detections', BEST_EFFORT)
    node.wait(lambda: publisher.publish(detections(fleet(2))) or node.boxes, 'boxes')


def test_a_subscriber_whose_profile_does_not_fit_is_logged(start: Start) -> None:
    node = start()
    node.connect()
    latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    unheard = node.peer.collect(Detection2DArray, 'boxes', latched)
    line = node.wait_for_log('incompatible QoS', "'boxes'")
    assert 'DURABILITY' in line
    node.convert(detections(fleet(1)))
    assert unheard == []


def test_a_publisher_that_an_override_excludes_is_reported(start: Start) -> None:
    override = 'qos_overrides./picky/detections.subscription.reliability'
    node = start(parameters={override: 'reliable'}, namespace='/picky')
    node.peer.node.create_publisher(Detection2DArray, 'detections', BEST_EFFORT)
    line = node.wait_for_log('no messages from /picky/peer on /picky/detections')
    assert 'incompatible QoS' in line
    assert 'qos_overrides./picky/detections.subscription' in line
    node.wait(lambda: node.warned('no messages from /picky/peer'), 'the level')
    # A matching one is received all the same.
    node.connect()


LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)


def test_a_latched_camera_info_that_came_before_the_node_is_heard(site: Site) -> None:
    with Converter(site, parameters={'autostart': False}) as node:
        node.peer.node.create_publisher(CameraInfo, 'camera_info', LATCHED).publish(
            CameraInfo(width=640, height=480)
        )
        crops = node.peer.collect(Detection2DArray, 'crop_regions')
        for transition in (Transition.TRANSITION_CONFIGURE, Transition.TRANSITION_ACTIVATE):
            assert node.change_state(transition)
        node.send_until(lambda: node.send(detections(fleet(3))), lambda: crops, 'crop regions')
        assert not node.counts()['messages_unreadable']


# A log that nobody reads -----------------------------------------------------------------------


@pytest.mark.parametrize('kind', ['pipe', 'socket'])
def test_the_node_keeps_running_if_nobody_reads_its_log(
    start: Callable[..., Converter], monkeypatch: pytest.MonkeyPatch, kind: str
) -> None:
    ends = os.pipe() if kind == 'pipe' else [end.detach() for end in socket.socketpair()][::-1]
    unread, full = ends
    os.set_blocking(full, False)
    with contextlib.suppress(BlockingIOError):
        while True:
            os.write(full, b'.' * 512)
    os.set_blocking(full, True)
    popen = subprocess.Popen

    def with_full_log(*args: Any, **kwargs: Any) -> Any:
        return popen(*args, **{**kwargs, 'stdout': full, 'stderr': full})

    monkeypatch.setattr(subprocess, 'Popen', with_full_log)
    node = start()
    node.connect()
    log = node.peer.collect(Log, '/rosout', ROSOUT)
    for _ in range(3):
        node.publisher.publish(b'\x00\x01\x00\x00 no message at all')
        node.convert(detections(fleet(3)))
    # The warning may be in a later report than the next.
    node.wait(
        lambda: any(report.status[0].level == DiagnosticStatus.WARN for report in node.reports()),
        'the level',
    )
    node.wait(lambda: any('cannot be read' in line.msg for line in log), 'the warning on /rosout')
    node.process.send_signal(signal.SIGTERM)
    assert node.process.wait(SOON) == 0
    os.close(full)
    os.close(unread)


def test_a_node_without_output_at_all_works(site: Site) -> None:
    command = 'exec "$0" -m obbhbb_ros.nodes chip_extractor "$@" >&- 2>&-'
    mute = ['sh', '-c', command, sys.executable]
    with NodeProcess(mute, namespace='/mute') as process, Peer(site.context, '/mute') as peer:
        assert peer.publisher(Detection2DArray, 'crop_regions')
        process.send_signal(signal.SIGINT)
        assert process.wait(SOON) == 0


def test_a_log_file_is_shared_with_other_writers(site: Site, tmp_path: Path) -> None:
    node = f'{sys.executable} -m obbhbb_ros.nodes obb_to_hbb --ros-args -p q'
    command = f'(echo before; {node}; echo after) > {tmp_path}/log 2>&1'
    subprocess.run(['sh', '-c', command], check=True)
    first, *_, said, last = (tmp_path / 'log').read_text().splitlines()
    assert (first, last) == ('before', 'after')
    assert said.startswith('cannot start: ')
