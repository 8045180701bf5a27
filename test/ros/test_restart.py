# SPDX-License-Identifier: Apache-2.0
"""Crashes and stuck callbacks: the node exits, is restarted, and reports what happened."""

from __future__ import annotations

import json
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from collections.abc import Iterator
from contextlib import ExitStack
from contextlib import suppress
from dataclasses import asdict
from dataclasses import replace
from pathlib import Path

import pytest
from crashes import CRASHES
from crashes import WATCHDOG
from crashes import Crashing
from diagnostic_msgs.msg import DiagnosticStatus
from harness import Converter
from harness import Node
from harness import NodeProcess
from harness import Site
from harness import unexplained
from harness import values_of
from ships import detections
from ships import fleet

from obbhbb_ros.nodes.running.last_run import LastRun
from obbhbb_ros.nodes.running.last_run import Run
from obbhbb_ros.nodes.running.last_run import last_run
from obbhbb_ros.nodes.running.last_run import read_run
from obbhbb_ros.nodes.running.state_file import open_state_file

# These tests depend on rclpy alone, which is the same in all environments.
pytestmark = pytest.mark.once

Start = Callable[..., Converter]


@pytest.fixture(scope='module')
def crashed(site: Site, tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, Crashing]]:
    """Nodes that have crashed, each in its way, and were restarted."""
    with ExitStack() as stack:
        nodes = {
            name: stack.enter_context(Crashing(site, tmp_path_factory.mktemp('crashing'), way))
            for name, (way, _, _) in CRASHES.items()
        }
        for node in nodes.values():
            node.work()
        for node in nodes.values():
            node.crash()
        for node in nodes.values():
            node.start_again()
        for node in nodes.values():
            node.come_back()
        yield nodes


# What happened ----------------------------------------------------------------------------------


@pytest.mark.parametrize('name', CRASHES)
def test_after_a_crash_the_node_answers_and_reports_why_the_last_run_ended(
    crashed: dict[str, Crashing], name: str
) -> None:
    node = crashed[name]
    _, code, why = CRASHES[name]
    assert node.ended == code
    assert node.values['last_run.ended'] == why
    assert node.values['last_run.detections_received'] == '6'
    assert (node.values['restarts'], node.values['last_run.state']) == ('1', 'active')
    assert node.report.level == DiagnosticStatus.WARN
    said = f'restart 1 in a row; end of the last run: {why}'
    assert node.report.message == said
    node.wait_for_log('[WARN]', said)
    assert not unexplained(node.values, 'obb_to_hbb.md')
    assert node.convert(detections(fleet(2))).detections


def test_the_log_says_where_a_node_crashed_or_was_stuck(crashed: dict[str, Crashing]) -> None:
    where = re.compile(r'stacks of the last run:\n.*line \d+ in (spin|stuck_answer)', re.DOTALL)
    assert where.search(crashed['crashed'].process.log)
    assert where.search(crashed['stuck in C'].process.log)
    # This node logged it at once.
    assert 'line 14 in stuck_answer' in crashed['stuck in Python'].log_of_last
    assert re.search(rf'\[FATAL\].*: {WATCHDOG}', crashed['stuck in Python'].log_of_last)


def test_restarts_are_counted_until_the_node_is_asked_to_end(crashed: dict[str, Crashing]) -> None:
    node = crashed['killed']
    node.crash()
    node.start_again()
    node.come_back()
    assert node.values['restarts'] == '2'
    node.process.send_signal(signal.SIGTERM)
    node.start_again()
    node.come_back()
    assert node.ended == 0
    assert (node.values['restarts'], node.values['last_run.ended']) == ('0', 'SIGTERM')
    assert node.report.level == DiagnosticStatus.OK
    assert 'WARN' not in node.process.log


def test_the_watchdog_spares_idle_nodes_and_nodes_stopped_from_outside(start: Start) -> None:
    parameters = {'watchdog_timeout': 2.0}
    idle = start(parameters=parameters | {'autostart': False})
    stopped = start(parameters=parameters)
    stopped.connect()
    assert idle.state() == 'unconfigured'
    stopped.process.send_signal(signal.SIGSTOP)
    # Longer than it takes the last resort.
    time.sleep(5.0)
    stopped.process.send_signal(signal.SIGCONT)
    stopped.connect()
    assert idle.state() == 'unconfigured'
    for node in (idle, stopped):
        assert node.process.running
        # A stopped node may lose messages, and then warns of that.
        assert not re.search('watchdog|Thread 0x', node.process.log)


def test_a_run_that_cannot_start_leaves_the_state_file_as_it_is(site: Site, tmp_path: Path) -> None:
    file = tmp_path / 'state.json'
    before = asdict(replace(RUN, counters={'chips_stored': 7}))
    file.write_text(json.dumps(before))
    parameters = {'state.path': file, 'qos_overrides./boxes.publisher.reliability': 'perhaps'}
    with site.start('obb_to_hbb', parameters=parameters) as process:
        assert process.wait() == 1
        assert 'cannot start' in process.log
    assert json.loads(file.read_text()) == before


@pytest.mark.parametrize('executable', ['chip_extractor', 'downlink', 'overlay', 'ship_tracker'])
def test_every_managed_node_reports_its_last_run(
    site: Site, tmp_path: Path, executable: str
) -> None:
    with Node(site, executable) as node:
        file = tmp_path / 'state.json'
        run = replace(RUN, node=f'{node.namespace}/{executable}')
        file.write_text(json.dumps(asdict(run)))
        parameters = {'state.path': file, 'watchdog_timeout': 5.0}
        folders = {'spool.path': tmp_path / 'spool', 'outbox.path': tmp_path / 'outbox'}
        node.start(parameters=parameters | (folders if executable == 'downlink' else {}))
        report = node.next_report()
        assert report.message.startswith('restart 3 in a row; end of the last run: the machine was')
        values = values_of(report)
        assert (values['restarts'], values['last_run.messages']) == ('3', '3')
        assert not unexplained(values, f'{executable}.md')
        assert node.process.close() == 0
        assert read_run(file.read_bytes()).ended == 'SIGINT'


STUCK_AT_THE_END = """
import sys, time
from obbhbb_ros.nodes.running import stop
# Before libraries start threads, as the executables do.
halt = stop.Stop()
stop.RUNNING = 1.5
from obbhbb_ros.nodes.running import process
from obbhbb_ros.nodes.obb_to_hbb import ObbToHbb
ObbToHbb.destroy_node = lambda self: time.sleep(1_000_000)
sys.exit(process.run({'obb_to_hbb': ObbToHbb}, halt))
"""


def test_a_node_that_hangs_at_its_end_leaves_that_in_the_state_file(tmp_path: Path) -> None:
    file = tmp_path / 'state.json'
    command = [sys.executable, '-c', STUCK_AT_THE_END]
    with NodeProcess(command, tmp_path / 'log', parameters={'state.path': file}) as process:
        # A second time, so that the node is running: one that is starting exits at once.
        moments: set[str] = set()
        while len(moments) < 2:
            assert process.running
            if file.exists():
                moments.add(read_run(file.read_bytes()).written)
            time.sleep(0.01)
        process.send_signal(signal.SIGTERM)
        assert process.wait() == 1
    run = read_run(file.read_bytes())
    assert (run.ended, run.asked) == ('not ended 1.5 s after a signal', False)


TWO_NODES = """
import sys, time
import rclpy
from rclpy.parameter import Parameter
from obbhbb_ros.nodes.downlink import Downlink
from obbhbb_ros.nodes.obb_to_hbb import ObbToHbb
from obbhbb_ros.nodes.running.supervision import Supervision

def parameters(name, timeout):
    values = {'state.path': f'{sys.argv[1]}/{name}.json', 'watchdog_timeout': timeout,
              'spool.path': f'{sys.argv[1]}/spool', 'outbox.path': f'{sys.argv[1]}/outbox'}
    return [Parameter(name, value=value) for name, value in values.items()]

rclpy.init()
supervision = Supervision([
    ObbToHbb(parameter_overrides=parameters('obb_to_hbb', 60.0)),
    Downlink(parameter_overrides=parameters('downlink', 2.0)),
])
supervision.start_nodes()
time.sleep(1_000_000)
"""


def test_one_watchdog_watches_over_all_nodes_of_a_process(site: Site, tmp_path: Path) -> None:
    command = [sys.executable, '-c', TWO_NODES, str(tmp_path)]
    ended = subprocess.run(command, check=False, capture_output=True, text=True)
    assert ended.returncode == 70
    assert ended.stderr.count('leaving from:') == 1
    for name in ('obb_to_hbb', 'downlink'):
        run = read_run((tmp_path / f'{name}.json').read_bytes())
        assert (run.node, run.state, run.asked) == (f'/{name}', 'active', False)
        assert run.ended.startswith(
            'watchdog: no turn of the executor of obb_to_hbb for 2 s, in <module>'
        )


HUNG_THREAD = """
import sys, time
from pathlib import Path
import rclpy
from rclpy.parameter import Parameter
from obbhbb_ros.nodes.downlink import Downlink
from obbhbb_ros.nodes.running.supervision import Supervision
from obbhbb_ros.spool.chip_rows import NewChip
from obbhbb_ros.spool.outbox import Outbox
from obbhbb_ros.spool.writer import SpoolWriter

folder = Path(sys.argv[1])
writer = SpoolWriter(folder / 'spool', print)
writer.store(writer.plan(1), [NewChip(0.9, 'ship', (5, 0), {'codec': 'jpeg'}, b'...')], {})
# As a frozen disk does it.
Outbox.add = lambda *_: time.sleep(1_000_000)
values = {'state.path': f'{folder}/state.json', 'watchdog_timeout': 2.0,
          'spool.path': f'{folder}/spool', 'outbox.path': f'{folder}/outbox'}
rclpy.init()
node = Downlink(parameter_overrides=[Parameter(name, value=values[name]) for name in values])
supervision = Supervision([node])
supervision.start_nodes()
while True:
    supervision.turns[0].count += 1
    rclpy.spin_once(node, timeout_sec=0.1)
"""


def test_a_release_thread_that_hangs_is_reported_and_ended(site: Site, tmp_path: Path) -> None:
    command = [sys.executable, '-c', HUNG_THREAD, str(tmp_path)]
    ended = subprocess.run(command, check=False, capture_output=True, text=True)
    assert ended.returncode == 70, ended.stderr
    assert 'no answer from the disk of spool or outbox for ' in ended.stderr
    run = read_run((tmp_path / 'state.json').read_bytes())
    assert run.ended == 'watchdog: no sign of a thread of the node for 12 s'


# Without ---------------------------------------------------------------------------------------


def test_by_default_there_is_no_state_file_and_no_report_of_it(node: Converter) -> None:
    keys = values_of(node.next_report())
    assert not [key for key in keys if key.startswith(('restarts', 'last_run'))]


def test_a_timeout_that_an_idle_node_would_exceed_is_refused(site: Site) -> None:
    with site.start('obb_to_hbb', parameters={'watchdog_timeout': 0.5}) as process:
        assert process.wait() == 1
        assert process.log == ('cannot start: watchdog_timeout must be 0, or 2 or more, not 0.5\n')


# State files that cannot be used ---------------------------------------------------------------


def test_two_nodes_do_not_share_a_file(crashed: dict[str, Crashing], start: Start) -> None:
    one = crashed['crashed']
    other = start(parameters={'state.path': one.state_file})
    other.connect()
    other.wait_for_log(f'state.path: {one.state_file}: in use by another node')
    assert 'restarts' not in values_of(other.next_report())
    assert read_run(one.state_file.read_bytes()).node == f'{one.namespace}/obb_to_hbb'


def test_a_damaged_or_unwritable_file_is_reported_once_and_the_node_carries_on(
    start: Start, tmp_path: Path
) -> None:
    file = tmp_path / 'state.json'
    file.write_bytes(b'{"node": ')
    node = start(parameters={'state.path': file})
    node.connect()
    report = node.next_report()
    assert report.level == DiagnosticStatus.WARN
    values = values_of(report)
    assert values['last_run.ended'] == f'not known, {file} cannot be read'
    in_the_way = tmp_path / '.state.json'

    def is_blocked() -> bool:
        # The node may be writing a file of that name.
        with suppress(FileExistsError):
            in_the_way.mkdir()
        return in_the_way.is_dir()

    node.wait(is_blocked, 'that nothing can be written any more')
    node.wait_for_log(f'state.path: {file}: ', 'directory')
    for _ in range(2):
        node.next_report()
    assert node.process.log.count('directory') == 1
    assert node.process.log.count('it is damaged') == 1
    assert node.convert(detections(fleet(2))).detections


RUN = Run('/n', 7, 'b', '2030-01-01', '2030-01-02', 2, 'active', '', False, {'messages': 3})
DAMAGED = {
    'empty': b'',
    'cut': json.dumps(asdict(RUN)).encode()[:-9],
    'a list': b'[]',
    'nul': bytes(99),
    'nested': b'[' * 100_000,
    'not text': b'\xff\xfe',
    'a number': b'9' * 5000,
    'half a character': json.dumps(asdict(replace(RUN, state='\ud800'))).encode(),
    'no field': b'{}',
    'another type': json.dumps(asdict(RUN) | {'pid': '7'}).encode(),
    'no counter': json.dumps(asdict(RUN) | {'counters': {'messages': 'many'}}).encode(),
}


@pytest.mark.parametrize('data', DAMAGED.values(), ids=DAMAGED)
def test_a_damaged_file_is_not_taken_for_a_good_one(data: bytes) -> None:
    with pytest.raises(ValueError, match='not the state of a run'):
        read_run(data)
    assert read_run(json.dumps(asdict(RUN)).encode()) == RUN


@pytest.mark.parametrize(
    ('run', 'stacks', 'boot', 'ended', 'restarts'),
    [
        (RUN, '', 'b', 'killed: SIGKILL, or out of memory', 3),
        (RUN, '', 'c', 'the machine was restarted: a power cut or a reset', 3),
        (RUN, 'Fatal Python error: Aborted\n\n', 'b', 'crashed: Aborted (SIGABRT)', 3),
        (RUN, 'Thread 0x00007f (most recent …\n', 'b', 'watchdog: stuck outside Python', 3),
        (replace(RUN, ended='SIGINT', asked=True), '', 'c', 'SIGINT', 0),
        (replace(RUN, ended='OSError: x'), '', 'b', 'OSError: x', 3),
        (
            replace(RUN, ended='SIGINT', asked=True),
            'Fatal Python error: Bus error\n',
            'b',
            'crashed: Bus error (SIGBUS)',
            3,
        ),
    ],
)
def test_the_next_run_finds_out_how_the_last_one_ended(
    run: Run, stacks: str, boot: str, ended: str, restarts: int
) -> None:
    assert last_run(run, stacks, boot) == LastRun(ended, restarts, stacks, run)


def test_the_last_run_is_reported_in_plain_words() -> None:
    killed = last_run(RUN, '', 'b')
    assert killed.warning == (
        'restart 3 in a row; end of the last run: killed: SIGKILL, or out of memory'
    )
    assert killed.facts() == {
        'restarts': '3',
        'last_run.messages': '3',
        'last_run.pid': '7',
        'last_run.started': '2030-01-01',
        'last_run.written': '2030-01-02',
        'last_run.state': 'active',
        'last_run.ended': 'killed: SIGKILL, or out of memory',
    }
    assert last_run(replace(RUN, ended='SIGINT', asked=True), '', 'b').warning == ''
    assert (LastRun().warning, LastRun().facts()) == ('', {'restarts': '0'})


@pytest.mark.parametrize(
    'path',
    ['/', '.', 'n.json', '/dev/null', '/dev/null/x', '/a\0b', '/proc/x', '~nobody_of_that_name/n'],
)
def test_a_path_that_cannot_be_a_file_is_reported(path: str) -> None:
    warnings: list[str] = []
    assert open_state_file(path, '/n', {}, warnings.append) is None
    (text,) = warnings
    assert text.startswith(f'state.path: {path}: ')


def test_a_file_of_another_kind_is_not_replaced(tmp_path: Path) -> None:
    file = tmp_path / 'flight.yaml'
    file.write_text('overlay: {ros__parameters: {}}')
    warnings: list[str] = []
    assert open_state_file(str(file), '/n', {}, warnings.append) is None
    assert file.read_text() == 'overlay: {ros__parameters: {}}'
    assert warnings == [f'state.path: {file}: not a state file; this run keeps no state file']


DYING = """
import os, sys
from obbhbb_ros.nodes.running.state_file import open_state_file
state_file = open_state_file(sys.argv[1], '/n', {}, print)
last = state_file.explain(state_file.last_stacks)
if 'start' in sys.argv:
    state_file.begin('active')
if 'crash' in sys.argv:
    os.kill(os.getpid(), 11)
print(last.warning)
"""


def test_a_run_that_cannot_start_keeps_the_stacks_of_the_crash_before_it(tmp_path: Path) -> None:
    def run(*words: str) -> str:
        command = [sys.executable, '-c', DYING, str(tmp_path / 'n.json'), *words]
        return subprocess.run(command, check=False, capture_output=True, text=True).stdout

    run('start', 'crash')
    assert 'crashed: Segmentation fault (SIGSEGV)' in run()
    assert 'restart 1 in a row' in (told := run('start'))
    assert 'crashed: Segmentation fault (SIGSEGV)' in told
    # The last run was killed, and the older stacks are gone.
    assert 'killed: SIGKILL' in run('start')


def test_a_link_stays_a_link(tmp_path: Path) -> None:
    link, file = tmp_path / 'link.json', tmp_path / 'run' / 'state.json'
    link.symlink_to(file)
    subprocess.run([sys.executable, '-c', DYING, str(link), 'start'], check=True)
    assert link.is_symlink()
    assert read_run(file.read_bytes()).state == 'active'
