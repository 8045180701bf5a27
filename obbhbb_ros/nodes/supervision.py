# SPDX-License-Identifier: Apache-2.0
"""What watches over a managed node: its state file, and the watchdog of its process."""

from __future__ import annotations

from typing import Any
from typing import NamedTuple

from rclpy.node import Node

from obbhbb_ros.nodes import internals
from obbhbb_ros.nodes.managed import ManagedNode
from obbhbb_ros.nodes.parts import steady_timer
from obbhbb_ros.nodes.reporter import PERIOD
from obbhbb_ros.nodes.state_file import StateFile
from obbhbb_ros.nodes.watchdog import STUCK
from obbhbb_ros.nodes.watchdog import Watchdog
from obbhbb_ros.settings.common import STATE_PATH
from obbhbb_ros.settings.common import WATCHDOG

# A subscriber of the diagnostics has to discover the restarted node before it hears of the restart.
_RESTART_REPORTS = 10


class Supervision(NamedTuple):
    """
    What watches over a node.

    Attributes
    ----------
    state_file : StateFile
        What the run leaves to the next one.
    watchdog : Watchdog
        Ends the process if the executor is blocked.
    """

    state_file: StateFile
    watchdog: Watchdog


def start(node: Node) -> Supervision:
    """
    Supervise a managed node, and start it; for any other node, do neither.

    Raises
    ------
    ValueError
        If the watchdog's timeout is too short.
    StartError
        If the node cannot be configured or activated.
    """
    if not isinstance(node, ManagedNode):
        return Supervision(StateFile('', '', {}, print), Watchdog(0.0, None, print))
    supervision = supervise(node)
    node.autostart()
    # Not before: a run that cannot start leaves what the last one left.
    supervision.state_file.begin(internals.state_label(node))
    return supervision


def supervise(node: ManagedNode[Any]) -> Supervision:
    """
    Start to watch over a node, and report how its last run ended.

    Raises
    ------
    ValueError
        If the watchdog's timeout is too short.
    """
    state_file = StateFile(
        node.get_parameter(STATE_PATH.name).value,
        node.get_fully_qualified_name(),
        node.monitor.counts,
        lambda text: node.reporter.warn(text, text),
    )

    def on_stuck(reason: str) -> None:
        state_file.end(reason)
        node.get_logger().fatal(f'{reason}, leaving with exit code {STUCK}')

    watchdog = Watchdog(node.get_parameter(WATCHDOG.name).value, state_file.stacks_file, on_stuck)
    if state_file.is_kept:
        node.reporter.add_facts(state_file.last_run.facts)
        # In every state of the node.
        steady_timer(node, PERIOD, lambda: state_file.note(internals.state_label(node)))
    if state_file.last_run.warning:
        node.reporter.remind(state_file.last_run.warning, _RESTART_REPORTS)
        node.get_logger().warning(state_file.last_run.warning)
    if state_file.last_run.stacks:
        node.get_logger().warning(f'stacks of the last run:\n{state_file.last_run.stacks}')
    return Supervision(state_file, watchdog)
