# SPDX-License-Identifier: Apache-2.0
"""Crashes and stuck callbacks: the node ends, comes back, and says what happened to it."""

from __future__ import annotations

import json
import re
import signal
import sys
import time
from collections.abc import Callable
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import asdict
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from harness import Converter
from harness import Counts
from harness import NodeProcess
from harness import Site
from harness import unexplained
from harness import values_of
from ships import detections
from ships import fleet

from obbhbb_ros.nodes.documentation import NODE_TABLES
from obbhbb_ros.nodes.last_run import Run
from obbhbb_ros.nodes.last_run import RunRecord
from obbhbb_ros.nodes.last_run import end_of
from obbhbb_ros.nodes.last_run import read_run

Start = Callable[..., Converter]

# The node as it is, but for a conversion that never returns if a file is there, which it deletes.
STUCK = """
import ctypes, signal, sys, time
from pathlib import Path
# Before libraries start threads, as the executables do.
signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT, signal.SIGTERM])
from obbhbb_ros.nodes import obb_to_hbb
from obbhbb_ros.nodes.__main__ import _run

trap, answer = Path(sys.argv.pop(1)), obb_to_hbb.answer

def stuck_answer(*args):
    if trap.exists():
        trap.unlink()
        {way}(1_000_000)
    return answer(*args)

obb_to_hbb.answer = stuck_answer
sys.exit(_run('obb_to_hbb'))
"""
IN_PYTHON, IN_C = 'time.sleep', 'ctypes.PyDLL(None).sleep'


class Crashing(Converter):
    """A node that can be started again, with a state file, and a trap for one of its callbacks."""

    def __init__(self, site: Site, folder: Path, way: str = IN_PYTHON) -> None:
        self._folder, self._starts = folder, 0
        self.state_file, self._trap = folder / 'state' / 'obb_to_hbb.json', folder / 'trap'
        self._command = [sys.executable, '-c', STUCK.format(way=way), str(self._trap)]
        super().__init__(site)

    def start(self, arguments: Any = (), parameters: Any = None) -> None:
        self._starts += 1
        self.process = NodeProcess(
            self._command, self._folder / f'{self._starts}.log', namespace=self.namespace,
            parameters={'state.path': self.state_file, 'watchdog_timeout': 2.0},
        )

    def work(self) -> None:
        """Have it count messages, and wait until its counters are in the file."""
        self.connect()
        for _ in range(3):
            self.convert(detections(fleet(2)))

        def is_written() -> bool:
            run = read_run(self.state_file.read_bytes())
            return run.counters.get('detections_received') == 6

        self.wait(is_written, 'the counters in the state file')

    def crash(self, how: int | None) -> None:
        """Send a signal, or a message that it gets stuck with."""
        if how is None:
            self._trap.touch()
            self.publisher.publish(detections(fleet(1)))
        else:
            self.process.send_signal(how)

    def start_again(self) -> None:
        """Wait for the end and do as launch does."""
        self.ended, self.log_of_last = self.process.wait(), self.process.log
        self.start()

    def come_back(self) -> None:
        """Wait until it answers and reports."""
        self.connect()
        self.report = self.next_report()
        self.values = values_of(self.report)


WATCHDOG = 'watchdog: no turn of the executor for 2 s, in stuck_answer, <string>:14'
CRASHES = {
    'killed': (signal.SIGKILL, -9, 'killed: SIGKILL, or out of memory'),
    'crashed': (signal.SIGSEGV, -11, 'crashed: Segmentation fault (SIGSEGV)'),
    'stuck in Python': (None, 70, WATCHDOG),
    'stuck in C': (None, 1, 'watchdog: stuck outside Python'),
}


@pytest.fixture(scope='module')
def crashed(site: Site, tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, Crashing]]:
    """Nodes that each have crashed in one of these ways and were started again."""
    with ExitStack() as stack:
        nodes = {
            name: stack.enter_context(Crashing(
                site, tmp_path_factory.mktemp('crashing'),
                IN_C if name == 'stuck in C' else IN_PYTHON,
            ))
            for name in CRASHES
        }
        for node in nodes.values():
            node.work()
        for name, node in nodes.items():
            node.crash(CRASHES[name][0])
        for node in nodes.values():
            node.start_again()
        for node in nodes.values():
            node.come_back()
        yield nodes


# What happened ----------------------------------------------------------------------------------


@pytest.mark.parametrize('name', CRASHES)
def test_after_a_crash_the_node_answers_and_says_why_the_last_run_ended(
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
    # It was there at once.
    assert 'line 14 in stuck_answer' in crashed['stuck in Python'].log_of_last
    assert re.search(rf'\[FATAL\].*: {WATCHDOG}', crashed['stuck in Python'].log_of_last)


def test_restarts_are_counted_until_the_node_is_asked_to_end(crashed: dict[str, Crashing]) -> None:
    node = crashed['killed']
    node.crash(signal.SIGKILL)
    node.start_again()
    node.come_back()
    assert node.values['restarts'] == '2'
    node.process.send_signal(signal.SIGTERM)
    node.start_again()
    node.come_back()
    assert node.ended == 0
    assert (node.values['restarts'], node.values['last_run.ended']) == ('0', 'SIGTERM')
    assert node.report.level == DiagnosticStatus.OK
    assert node.process.log == ''


def test_a_node_without_work_and_one_that_was_stopped_for_long_are_not_stuck(start: Start) -> None:
    parameters = {'watchdog_timeout': 2.0}
    idle = start(parameters=parameters | {'autostart': False})
    stopped = start(parameters=parameters)
    stopped.connect()
    assert idle.state() == 'unconfigured'
    stopped.process.send_signal(signal.SIGSTOP)
    time.sleep(3.5)
    stopped.process.send_signal(signal.SIGCONT)
    stopped.connect()
    assert idle.state() == 'unconfigured'
    assert idle.process.log == stopped.process.log == ''


def test_one_that_cannot_start_leaves_what_the_run_before_it_left(
    site: Site, tmp_path: Path
) -> None:
    file = tmp_path / 'state.json'
    before = asdict(replace(RUN, counters={'chips_stored': 7}))
    file.write_text(json.dumps(before))
    parameters = {
        'state.path': file, 'qos_overrides./boxes.publisher.reliability': 'perhaps',
    }
    with site.start('obb_to_hbb', parameters=parameters) as process:
        assert process.wait() == 1
        assert 'cannot start' in process.log
    assert json.loads(file.read_text()) == before


# Without ---------------------------------------------------------------------------------------


def test_by_default_nothing_is_kept_and_nothing_said(node: Converter) -> None:
    keys = values_of(node.next_report())
    assert not [key for key in keys if key.startswith(('restarts', 'last_run'))]


@pytest.mark.parametrize('executable', ['obb_to_hbb', 'chip_extractor', 'downlink', 'overlay'])
def test_every_managed_node_takes_both_parameters(executable: str) -> None:
    assert {'state.path', 'watchdog_timeout'} <= set(NODE_TABLES[executable].parameters())


def test_a_timeout_that_an_idle_node_would_exceed_is_refused(site: Site) -> None:
    with site.start('obb_to_hbb', parameters={'watchdog_timeout': 0.5}) as process:
        assert process.wait() == 1
        assert process.log == (
            'cannot start: watchdog_timeout must be 0, or 2 or more, not 0.5\n'
        )


# State files that cannot be used ---------------------------------------------------------------


def test_two_nodes_do_not_share_a_file(crashed: dict[str, Crashing], start: Start) -> None:
    one = crashed['crashed']
    other = start(parameters={'state.path': one.state_file})
    other.connect()
    other.wait_for_log(f'state.path: {one.state_file}: in use by another node')
    assert 'restarts' not in values_of(other.next_report())
    assert read_run(one.state_file.read_bytes()).node == f'{one.namespace}/obb_to_hbb'


def test_a_damaged_file_and_a_full_disk_are_said_once_and_stop_nothing(
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
    # Nothing can be written any more.
    file.unlink()
    (file / 'in the way').mkdir(parents=True)
    node.wait_for_log(f'state.path: {file}: ', 'directory')
    for _ in range(2):
        node.next_report()
    assert node.process.log.count('directory') == 1
    assert node.process.log.count('it is damaged') == 1
    assert node.convert(detections(fleet(2))).detections
    assert Counts(node.next_report())['messages_converted']


RUN = Run('/n', 7, 'b', '2030-01-01', '2030-01-02', 2, 'active', '', False, {'messages': 3})
DAMAGED = {
    'empty': b'', 'cut': json.dumps(asdict(RUN)).encode()[:-9], 'a list': b'[]', 'nul': bytes(99),
    'nested': b'[' * 100_000, 'not text': b'\xff\xfe', 'a number': b'9' * 5000,
    'half a character': json.dumps(asdict(replace(RUN, state='\ud800'))).encode(),
    'no field': b'{}', 'another type': json.dumps(asdict(RUN) | {'pid': '7'}).encode(),
    'no counter': json.dumps(asdict(RUN) | {'counters': {'messages': 'many'}}).encode(),
}


@pytest.mark.parametrize('data', DAMAGED.values(), ids=DAMAGED)
def test_a_damaged_file_is_told_from_a_good_one(data: bytes) -> None:
    with pytest.raises(ValueError, match='not the state of a run'):
        read_run(data)
    assert read_run(json.dumps(asdict(RUN)).encode()) == RUN


@pytest.mark.parametrize(
    ('run', 'stacks', 'boot', 'end'),
    [
        (RUN, '', 'b', ('killed: SIGKILL, or out of memory', False)),
        (RUN, '', 'c', ('the machine was restarted: a power cut or a reset', False)),
        (RUN, 'Fatal Python error: Aborted\n\n', 'b', ('crashed: Aborted (SIGABRT)', False)),
        (RUN, 'Timeout (0:00:04)!\n', 'b', ('watchdog: stuck outside Python', False)),
        (replace(RUN, ended='SIGINT', asked=True), '', 'c', ('SIGINT', True)),
        (replace(RUN, ended='OSError: x'), '', 'b', ('OSError: x', False)),
        (replace(RUN, ended='SIGINT', asked=True), 'Fatal Python error: Bus error\n', 'b',
         ('crashed: Bus error (SIGBUS)', False)),
    ],
)
def test_the_end_of_a_run_is_found_out(
    run: Run, stacks: str, boot: str, end: tuple[str, bool]
) -> None:
    assert end_of(run, stacks, boot) == end


@pytest.mark.parametrize('path', ['/', '.', '/dev/null', '/dev/null/x', 'a\0b', '/proc/x'])
def test_a_path_that_cannot_be_a_file_is_told(path: str) -> None:
    told: list[str] = []
    record = RunRecord(path, '/n', {}, told.append)
    record.note('active')
    record.end('SIGINT', asked=True)
    (text,) = told
    assert text.startswith(f'state.path: {path}: ')
    assert not record.is_kept
