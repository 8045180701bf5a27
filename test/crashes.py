# SPDX-License-Identifier: Apache-2.0
"""The conversion node, which crashes or hangs in several ways and is started again."""

from __future__ import annotations

import signal
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from diagnostic_msgs.msg import DiagnosticStatus
from harness import Converter
from harness import NodeProcess
from harness import Site
from harness import time_of
from harness import values_of
from ships import detections
from ships import fleet

from obbhbb_ros.nodes.running.last_run import read_run

WATCHDOG = 'watchdog: no turn of the executor for 2 s, in stuck_answer, <string>:14'
# By name: how it crashes, its exit code, and what the next run reports.
CRASHES: dict[str, tuple[Any, int, str]] = {
    'killed': (signal.SIGKILL, -9, 'killed: SIGKILL, or out of memory'),
    'crashed': (signal.SIGSEGV, -11, 'crashed: Segmentation fault (SIGSEGV)'),
    'stuck in Python': ('time.sleep', 70, WATCHDOG),
    # While it holds Python's lock.
    'stuck in C': ('ctypes.PyDLL(None).sleep', -signal.SIGALRM, 'watchdog: stuck outside Python'),
}

# The real node, but a conversion deletes a certain file if that exists, and then never returns.
STUCK = """
import ctypes, signal, sys, time
from pathlib import Path
# Before libraries start threads, as the executables do.
signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT, signal.SIGTERM])
from obbhbb_ros.nodes import obb_to_hbb
from obbhbb_ros.nodes.__main__ import run_executable

trap, answer = Path(sys.argv.pop(1)), obb_to_hbb.answer

def stuck_answer(*args):
    if trap.exists():
        trap.unlink()
        {way}(1_000_000)
    return answer(*args)

obb_to_hbb.answer = stuck_answer
sys.exit(run_executable('obb_to_hbb'))
"""


class Crashing(Converter):
    """A node with a state file and a way to crash, which can be started again."""

    def __init__(self, site: Site, folder: Path, way: str | int) -> None:
        self._folder, self._starts, self._way = folder, 0, way
        self.state_file, self._trap = folder / 'state' / 'obb_to_hbb.json', folder / 'trap'
        stuck = STUCK.format(way=way if isinstance(way, str) else 'time.sleep')
        self._command = [sys.executable, '-c', stuck, str(self._trap)]
        super().__init__(site)

    def start(self, arguments: Any = (), parameters: Any = None) -> None:
        self._starts += 1
        self._started = time.time()
        self.process = NodeProcess(
            self._command,
            self._folder / f'{self._starts}.log',
            namespace=self.namespace,
            parameters={'state.path': self.state_file, 'watchdog_timeout': 2.0},
        )

    def work(self) -> None:
        """Convert some messages, and wait until the counters are in the state file."""
        self.connect()
        for _ in range(3):
            self.convert(detections(fleet(2)))

        def is_written() -> bool:
            run = read_run(self.state_file.read_bytes())
            return run.counters.get('detections_received') == 6

        self.wait(is_written, 'the counters in the state file')

    def crash(self) -> None:
        """Crash the node in its way, or send it a message that it hangs on."""
        if isinstance(self._way, int):
            self.process.send_signal(self._way)
        else:
            self._trap.touch()
            self.publisher.publish(detections(fleet(1)))

    def start_again(self) -> None:
        """Wait for the end, and restart the node as launch does."""
        self.ended, self.log_of_last = self.process.wait(), self.process.log
        self.start()

    def come_back(self) -> None:
        """Wait until it answers and reports."""
        self.connect()

        def reports_of_this_run() -> Iterator[DiagnosticStatus]:
            # Reports of the last run may still be on their way.
            for report in self.reports():
                if time_of(report) > self._started:
                    yield report.status[0]

        self.report = self.wait_for(reports_of_this_run, 'a report of this run')
        self.values = values_of(self.report)
