# SPDX-License-Identifier: Apache-2.0
"""What a node reports: counters, rates, latency percentiles, parameters in force."""

from __future__ import annotations

import time
from collections import Counter
from collections import deque
from collections.abc import Mapping
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from diagnostic_msgs.msg import DiagnosticStatus
from diagnostic_msgs.msg import KeyValue
from rclpy.node import Node

from obbhbb_ros.settings.common import HARDWARE_ID
from obbhbb_ros.settings.common import INPUT_TIMEOUT

PERIOD = 1.0
# Times the input timeout.
_STALE_AFTER = 3.0
_WINDOW = 1000


class Monitor:
    """
    Counts what a node does and publishes it on `/diagnostics` once a second.

    Parameters
    ----------
    node : Node
        The node that is watched.
    rates : tuple of str
        Counters whose rate is published as well; the first counts the input.
    """

    def __init__(self, node: Node, rates: tuple[str, ...]) -> None:
        self.counts: Counter[str] = Counter()
        self._node = node
        self._rates = rates
        self._durations: deque[float] = deque(maxlen=_WINDOW)
        self._last: Counter[str] = Counter()
        self._last_time = time.monotonic()
        self._input_seen = 0, time.monotonic()
        self._trouble = ''

    def add(self, name: str, count: int = 1) -> None:
        """Count."""
        self.counts[name] += count

    def took(self, seconds: float) -> None:
        """Record how long a message took, from its arrival in Python to its publication."""
        self._durations.append(seconds)

    def silence(self) -> float:
        """Return the seconds without input, to the precision of a report."""
        now, inputs = time.monotonic(), self.counts[self._rates[0]]
        if inputs != self._input_seen[0]:
            self._input_seen = inputs, now
        return now - self._input_seen[1]

    def expect_input(self) -> None:
        """Count the time without input from now on."""
        self._input_seen = self.counts[self._rates[0]], time.monotonic()

    def trouble(self, text: str) -> None:
        """Remember what went wrong, for the next report."""
        self._trouble = text

    def remind(self, text: str) -> None:
        """Say something in the next report, unless something has gone wrong since."""
        self._trouble = self._trouble or text

    def report(
        self,
        state: str,
        parameters: Mapping[str, Any],
        facts: Mapping[str, str],
        silent_for: float = 0.0,
    ) -> DiagnosticArray:
        """
        Write the report of the period that ends now.

        Parameters
        ----------
        state : str
            Lifecycle state of the node.
        parameters : mapping of str to value
            Parameters in force.
        facts : mapping of str to str
            Other values.
        silent_for : float
            Seconds without input, if that is too long.

        Returns
        -------
        DiagnosticArray
            One status. Its level is WARN if anything went wrong since the last report, and ERROR or
            STALE without input.
        """
        level = DiagnosticStatus.WARN if self._trouble else DiagnosticStatus.OK
        message = self._trouble or state
        if silent_for:
            stale = silent_for > _STALE_AFTER * parameters[INPUT_TIMEOUT.name]
            level = DiagnosticStatus.STALE if stale else DiagnosticStatus.ERROR
            message = f'no input for {silent_for:.0f} s'
        name = self._node.get_fully_qualified_name()
        values = {'state': state}
        values.update({name: str(count) for name, count in sorted(self.counts.items())})
        values.update(facts)
        values.update(self._rate_values())
        values.update(self._latency_values())
        values.update({f'parameter.{name}': str(value) for name, value in parameters.items()})
        status = DiagnosticStatus(
            level=level,
            name=name.lstrip('/'),
            message=message,
            hardware_id=parameters[HARDWARE_ID.name] or name,
            values=[KeyValue(key=key, value=value) for key, value in values.items()],
        )
        self._trouble = ''
        array = DiagnosticArray(status=[status])
        array.header.stamp = self._node.get_clock().now().to_msg()
        return array

    def _rate_values(self) -> dict[str, str]:
        """Divide what was counted since the last report by the time since."""
        now = time.monotonic()
        elapsed = max(now - self._last_time, 1e-9)
        rates = {
            f'{name}_per_second': f'{(self.counts[name] - self._last[name]) / elapsed:.2f}'
            for name in self._rates
        }
        self._last, self._last_time = self.counts.copy(), now
        return rates

    def _latency_values(self) -> dict[str, str]:
        """Summarise how long the latest messages took."""
        if not self._durations:
            return {}
        milliseconds = np.array(self._durations) * 1e3
        p50, p99, worst = np.percentile(milliseconds, (50, 99, 100))
        return {
            'latency_p50_ms': f'{p50:.3f}',
            'latency_p99_ms': f'{p99:.3f}',
            'latency_max_ms': f'{worst:.3f}',
        }
