# SPDX-License-Identifier: Apache-2.0
"""What watches over the nodes of a process: their state files, and one watchdog."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from rclpy.node import Node

from obbhbb_ros.nodes.lifecycle import internals
from obbhbb_ros.nodes.lifecycle.managed import ManagedNode
from obbhbb_ros.nodes.lifecycle.parts import steady_timer
from obbhbb_ros.nodes.lifecycle.reporter import PERIOD
from obbhbb_ros.nodes.running.last_run import LastRun
from obbhbb_ros.nodes.running.state_file import StateFile
from obbhbb_ros.nodes.running.state_file import open_state_file
from obbhbb_ros.nodes.running.watchdog import STUCK
from obbhbb_ros.nodes.running.watchdog import Turns
from obbhbb_ros.nodes.running.watchdog import Watchdog
from obbhbb_ros.settings.common import STATE_PATH
from obbhbb_ros.settings.common import WATCHDOG


class Supervision:
    """
    Watches over the managed nodes of a process, and reports how their last runs ended.

    Parameters
    ----------
    nodes : sequence of Node
        The nodes of the process, not started yet. The watchdog watches the executors of all.

    Attributes
    ----------
    turns : list of Turns
        Those of the executors of the nodes.
    watchdog : Watchdog
        Ends the process if an executor is blocked.

    Raises
    ------
    ValueError
        If the watchdog's timeout is too short.
    """

    def __init__(self, nodes: Sequence[Node]) -> None:
        self._nodes = [node for node in nodes if isinstance(node, ManagedNode)]
        self.turns = [Turns(node.get_name()) for node in nodes]
        self._state_files = [(node, file) for node in self._nodes if (file := _state_file_of(node))]
        # Of the nodes of a process, one file has the stacks of all.
        stacks: dict[int, str] = {}
        for _, file in self._state_files:
            stacks |= file.last_stacks
        for node, file in self._state_files:
            _report_last_run(node, file.explain(stacks))
        timeouts = [node.get_parameter(WATCHDOG.name).value for node in self._nodes]
        stacks_file = next((file.stacks_file for _, file in self._state_files), None)
        self.watchdog = Watchdog(
            min(filter(None, timeouts), default=0.0),
            self.turns,
            stacks_file,
            self._stuck,
            [node.worker_sign for node in self._nodes],
        )

    def start_nodes(self) -> None:
        """
        Start the nodes, and begin to write their state files.

        Raises
        ------
        StartError
            If one cannot be configured or activated. Then the files keep what the last run left.
        """
        for node in self._nodes:
            node.autostart()
        for node, state_file in self._state_files:
            state_file.begin(internals.state_label(node))

    def end(self, reason: str, asked: bool = False) -> None:
        """Write to the state files why the process ends."""
        for _, state_file in self._state_files:
            state_file.end(reason, asked)

    def _stuck(self, reason: str) -> None:
        """Write and log that the watchdog ends the process."""
        self.end(reason)
        for node in self._nodes:
            node.get_logger().fatal(f'{reason}, leaving with exit code {STUCK}')


def _state_file_of(node: ManagedNode[Any]) -> StateFile | None:
    """Open the state file of a node, if it keeps one, and write it from now on."""
    reporter = node.reporter
    state_file = open_state_file(
        node.get_parameter(STATE_PATH.name).value,
        node.get_fully_qualified_name(),
        node.monitor.counts,
        lambda text: reporter.warn(text, text),
    )
    if state_file is not None:
        # In every state of the node.
        steady_timer(node, PERIOD, lambda: state_file.note(internals.state_label(node)))
    return state_file


def _report_last_run(node: ManagedNode[Any], last_run: LastRun) -> None:
    """Report how the last run of a node ended."""
    log = node.get_logger()
    node.reporter.add_facts(last_run.facts)
    if last_run.warning:
        node.reporter.remind(last_run.warning)
        log.warning(last_run.warning)
    if last_run.stacks:
        log.warning(f'stacks of the last run:\n{last_run.stacks}')
