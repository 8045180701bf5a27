# SPDX-License-Identifier: Apache-2.0
"""What a managed node tells its operator: diagnostics once a second, and warnings."""

from __future__ import annotations

import time
from collections.abc import Callable
from collections.abc import Mapping
from itertools import chain
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from diagnostic_msgs.msg import DiagnosticStatus
from diagnostic_msgs.msg import KeyValue
from rclpy.lifecycle import LifecycleNode

from obbhbb_ros.nodes import internals
from obbhbb_ros.nodes.monitor import Monitor
from obbhbb_ros.nodes.parts import Part
from obbhbb_ros.nodes.parts import steady_timer
from obbhbb_ros.settings.common import HARDWARE_ID
from obbhbb_ros.settings.common import INPUT_TIMEOUT
from obbhbb_ros.settings.parameter_file import Value
from obbhbb_ros.settings.parameter_file import yaml_value

DIAGNOSTICS = '/diagnostics'
"""The topic of the diagnostics."""

PERIOD = 1.0
"""Time between two diagnostics messages, seconds."""

WAITING = {
    'unconfigured': 'waits for a lifecycle manager to configure it',
    'inactive': 'waits for a lifecycle manager to activate it',
    'finalized': 'restart its process',
}
"""What a node waits for in each state in which it does not work."""

_WARNING_PERIOD = 5.0
_MAX_SAID = 100
# Without input, the level is ERROR after the input timeout, and STALE after this many of them.
_STALE_AFTER = 3.0
# This many, because a subscriber must discover a restarted node before it hears of the restart.
_REMINDERS = 10


def plain_yaml(value: Value) -> str:
    """Write a value for the diagnostics: as in a parameter file, a text without quotes."""
    return value if isinstance(value, str) else yaml_value(value)


class Reporter(Part):
    """
    Publishes the state, counters, rates, latencies and parameters of a node, and warns.

    It does so in every state of the node, from its start to its end.

    Parameters
    ----------
    node : LifecycleNode
        The node.
    monitor : Monitor
        Its counters.
    parameters : callable
        Returns its parameter values by name.
    """

    def __init__(
        self, node: LifecycleNode, monitor: Monitor, parameters: Callable[[], Mapping[str, Any]]
    ) -> None:
        self.monitor = monitor
        self._node, self._log, self._parameters = node, node.get_logger(), parameters
        self._facts: list[Callable[[], Mapping[str, str]]] = []
        self._notes: list[Callable[[], list[str]]] = []
        self._troubles: dict[str, str] = {}
        self._reminder, self._reminders_left = '', 0
        self._quiet_until: dict[str, float] = {}
        self._said: set[str] = set()
        self._is_silent = False
        self._publisher = node.create_publisher(DiagnosticArray, DIAGNOSTICS, 1)
        steady_timer(node, PERIOD, self._publish)

    def add_facts(self, facts: Callable[[], Mapping[str, str]]) -> None:
        """Report what a function returns, besides counters, rates and parameters."""
        self._facts.append(facts)

    def add_notes(self, notes: Callable[[], list[str]]) -> None:
        """Add what a function returns to the message of a node that is in order."""
        self._notes.append(notes)

    def log_state(self, state: str) -> None:
        """Log that the node is in a state in which it does not work."""
        self._log.info(f'{state}, {WAITING[state]}')

    def warn(self, kind: str, text: str) -> None:
        """Warn in the next diagnostics and in the log, there at most every 5 s for each kind."""
        self.raise_level(kind, text)
        now = time.monotonic()
        if now >= self._quiet_until.get(kind, now):
            self._quiet_until[kind] = now + _WARNING_PERIOD
            self._log.warning(text)

    def warn_once(self, text: str) -> None:
        """Warn as `warn` does, of the same text only once, and of 100 texts at most."""
        if text not in self._said and len(self._said) < _MAX_SAID:
            self._said.add(text)
            self.warn(text, text)

    def raise_level(self, kind: str, text: str) -> None:
        """Warn in the next diagnostics alone, of the last trouble of each kind."""
        self._troubles[kind] = text

    def remind(self, text: str) -> None:
        """Warn in those of the next ten reports that have nothing else to warn of."""
        self._reminder, self._reminders_left = text, _REMINDERS

    def activate(self) -> None:
        """Expect input."""
        self.monitor.expect_input()

    def _publish(self) -> None:
        """Publish the report of the period that ends now."""
        state, parameters = internals.state_label(self._node), self._parameters()
        # They come first, because they may count and warn.
        facts = [facts() for facts in self._facts]
        values = {'state': state}
        values.update({key: str(count) for key, count in sorted(self.monitor.counts.items())})
        for mapping in (*facts, self.monitor.rate_values(), self.monitor.latency_values()):
            values.update(mapping)
        values.update({f'parameter.{key}': plain_yaml(value) for key, value in parameters.items()})
        level, message = self._summary(state, parameters.get(INPUT_TIMEOUT.name, 0.0))
        name = self._node.get_fully_qualified_name()
        status = DiagnosticStatus(
            level=level,
            name=name.lstrip('/'),
            message=message,
            hardware_id=parameters[HARDWARE_ID.name] or name,
            values=[KeyValue(key=key, value=value) for key, value in values.items()],
        )
        array = DiagnosticArray(status=[status])
        array.header.stamp = self._node.get_clock().now().to_msg()
        self._publisher.publish(array)

    def _summary(self, state: str, input_timeout: float) -> tuple[bytes, str]:
        """Return level and message of a report: silence, or else trouble, or else the state."""
        waiting = [f'{state}, {WAITING[state]}'] if state in WAITING else []
        trouble = '; '.join([*self._troubles.values(), *waiting])
        self._troubles.clear()
        if self._reminders_left:
            self._reminders_left -= 1
            trouble = trouble or self._reminder
        silence = self.monitor.silence()
        self._notice_silence(silence, input_timeout if state == 'active' else 0.0)
        notes = [*chain(*(notes() for notes in self._notes))]
        if self._is_silent:
            is_stale = silence > _STALE_AFTER * input_timeout
            level = DiagnosticStatus.STALE if is_stale else DiagnosticStatus.ERROR
            reasons = [trouble] if trouble else notes
            return level, '; '.join([f'no input for {silence:.0f} s', *reasons])
        if trouble:
            return DiagnosticStatus.WARN, trouble
        return DiagnosticStatus.OK, ', '.join([state, *notes])

    def _notice_silence(self, silence: float, timeout: float) -> None:
        """Log when the node begins to miss input, and when input is back; 0 for no timeout."""
        was_silent, self._is_silent = self._is_silent, 0.0 < timeout < silence
        if self._is_silent and not was_silent:
            self._log.error(f'no input for {silence:.0f} s, see input_timeout')
        elif was_silent and timeout and not self._is_silent:
            self._log.info('input is back')
