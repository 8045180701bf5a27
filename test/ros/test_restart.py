# SPDX-License-Identifier: Apache-2.0
"""Crashes and stuck callbacks: the node ends, comes back, and says what happened to it."""

from __future__ import annotations

import json
import re
import signal
import sys
import time
from collections.abc import Callable
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

# The node as it is, but for a conversion that never returns while a file is there, which it deletes.
STUCK = """
import ctypes, sys, time
from pathlib import Path
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
        self.state_file = folder / 'state' / 'obb_to_hbb.json'
        self._command = [sys.executable, '-c', STUCK.format(way=way), str(folder / 'trap')]
        self._trap, self._folder, self._starts = folder / 'trap', folder, 0
        super().__init__(site)
        self.convert_some()

    def start(self, arguments: Any = (), parameters: Any = None) -> None:
        self._starts += 1
        self.process = NodeProcess(
            self._command, self._folder / f'{self._starts}.log', namespace=self.namespace,
            parameters={'state.path': self.state_file, 'watchdog_timeout': 2.0},
        )

    def convert_some(self) -> None:
        """Have it count messages, and wait until its counters are in the file."""
        self.connect()
        for _ in range(3):
            self.convert(detections(fleet(2)))
        self.next_report()
        self.next_report()

    def get_stuck(self) -> None:
        self._trap.touch()
        self.publisher.publish(detections(fleet(1)))

    def come_back(self) -> dict[str, str]:
        """Wait for the end, start it again, wait until it answers, and give what it reports."""
        self.ended = self.process.wait()
        self.log_of_last = self.process.log
        self.start()
        self.connect()
        self.report = self.next_report()
        return values_of(self.report)


@pytest.fixture
def crashing(site: Site, tmp_path: Path) -> Any:
    with Crashing(site, tmp_path) as node:
        yield node


# What happened ----------------------------------------------------------------------------------


def test_after_each_crash_the_node_answers_and_says_why_the_last_run_ended(
    crashing: Crashing
) -> None:
    crashing.process.send_signal(signal.SIGKILL)
    values = crashing.come_back()
    assert values['last_run.ended'] == 'killed: SIGKILL, or out of memory'
    assert (values['restarts'], values['last_run.state']) == ('1', 'active')
    # Messages of this run are its own.
    assert int(values['last_run.messages_converted']) >= 4
    assert crashing.report.level == DiagnosticStatus.WARN
    assert crashing.report.message.startswith('restart 1 in a row; end of the last run: killed')
    crashing.wait_for_log('[WARN]', 'restart 1 in a row')

    crashing.process.send_signal(signal.SIGSEGV)
    values = crashing.come_back()
    assert crashing.ended == -signal.SIGSEGV
    assert values['last_run.ended'] == 'crashed: Segmentation fault (SIGSEGV)'
    assert values['restarts'] == '2'
    assert re.search(r'stacks of the last run:\n.*line \d+ in spin', crashing.process.log, re.S)

    crashing.get_stuck()
    values = crashing.come_back()
    assert crashing.ended == 70
    assert 'line 12 in stuck_answer' in crashing.log_of_last
    expected = 'watchdog: no turn of the executor for 2 s, in stuck_answer, <string>:12'
    assert f'[FATAL] [{expected}' in re.sub(r'\[\S+\]: ', '[', crashing.log_of_last)
    assert values['last_run.ended'] == expected
    assert values['restarts'] == '3'
    assert not unexplained(values, 'obb_to_hbb.md')

    crashing.process.send_signal(signal.SIGTERM)
    values = crashing.come_back()
    assert crashing.ended == 0
    assert (values['restarts'], values['last_run.ended']) == ('0', 'SIGTERM')
    assert crashing.report.level == DiagnosticStatus.OK
    assert 'restart' not in crashing.process.log


def test_a_callback_stuck_outside_python_is_noticed_too(site: Site, tmp_path: Path) -> None:
    with Crashing(site, tmp_path, IN_C) as node:
        node.get_stuck()
        values = node.come_back()
        assert node.ended == 1
        assert values['last_run.ended'] == 'watchdog: stuck outside Python'
        assert 'line 12 in stuck_answer' in node.process.log


def test_an_idle_node_and_one_that_was_stopped_for_long_are_not_stuck(crashing: Crashing) -> None:
    crashing.peer.spin_to(time.monotonic() + 2.5)
    crashing.process.send_signal(signal.SIGSTOP)
    time.sleep(3.0)
    crashing.process.send_signal(signal.SIGCONT)
    crashing.convert(detections(fleet(1)))
    assert 'watchdog' not in crashing.process.log


def test_one_that_cannot_start_leaves_what_the_run_before_it_left(
    site: Site, tmp_path: Path
) -> None:
    file = tmp_path / 'state.json'
    before = asdict(replace(RUN, counters={'chips_stored': 7}))
    file.write_text(json.dumps(before))
    (tmp_path / 'spool').touch()
    parameters = {'state.path': file, 'spool.path': tmp_path / 'spool'}
    with site.start('chip_extractor', parameters=parameters) as process:
        assert process.wait() == 1
        assert 'cannot start' in process.log
    assert json.loads(file.read_text()) == before


# Without ---------------------------------------------------------------------------------------


def test_by_default_nothing_is_kept_and_nothing_said(start: Start) -> None:
    node = start()
    keys = values_of(node.next_report())
    assert 'restarts' not in keys
    assert not [key for key in keys if key.startswith('last_run')]
    node.process.send_signal(signal.SIGKILL)
    node.process.wait()
    node.start()
    node.connect()
    assert node.next_report().level == DiagnosticStatus.OK
    assert node.process.log == ''


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


def test_two_nodes_do_not_share_a_file(start: Start, tmp_path: Path) -> None:
    file = tmp_path / 'state.json'
    one = start(parameters={'state.path': file})
    one.next_report()
    other = start(parameters={'state.path': file})
    other.connect()
    other.wait_for_log(f'state.path: {file}: in use by another node')
    assert 'restarts' not in values_of(other.next_report())
    assert read_run(file.read_bytes()).node == f'{one.namespace}/obb_to_hbb'


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
    assert node.process.log.count('damaged') == 1
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


@pytest.mark.parametrize('path', ['/', '.', '/dev/null', '/dev/null/x.json', 'a\0b', '/proc/x.json'])
def test_a_path_that_cannot_be_a_file_is_told(path: str) -> None:
    told: list[str] = []
    record = RunRecord(path, '/n', {}, told.append)
    record.note('active')
    record.end('SIGINT', asked=True)
    (text,) = told
    assert text.startswith(f'state.path: {path}: ')
    assert not record.is_kept
