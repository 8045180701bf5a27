# SPDX-License-Identifier: Apache-2.0
"""What a node counts and measures."""

from __future__ import annotations

import time
from collections import Counter
from collections import deque

import numpy as np

_LATENCIES = 1000


class Monitor:
    """
    The counters of a node, their rates, its latencies, and how long it has had no input.

    Parameters
    ----------
    rates : tuple of str
        Counters whose rate is reported as well; the first one counts the input.

    Attributes
    ----------
    counts : Counter of str
        The counters, by their keys in the diagnostics.
    """

    def __init__(self, rates: tuple[str, ...]) -> None:
        self.counts: Counter[str] = Counter()
        self._rates = rates
        self._latencies: deque[float] = deque(maxlen=_LATENCIES)
        self._reported, self._report_time = Counter[str](), time.monotonic()
        self._inputs, self._input_time = 0, time.monotonic()

    def add(self, name: str, count: int = 1) -> None:
        """Increase a counter."""
        self.counts[name] += count

    def took(self, seconds: float) -> None:
        """Record the latency of a message: from its arrival in Python to the last publication."""
        self._latencies.append(seconds)

    def expect_input(self) -> None:
        """Measure the time without input from now on."""
        self._inputs, self._input_time = self.counts[self._rates[0]], time.monotonic()

    def silence(self) -> float:
        """Return the time since input was last noticed, by a call of this method, seconds."""
        if self.counts[self._rates[0]] != self._inputs:
            self.expect_input()
        return time.monotonic() - self._input_time

    def rate_values(self) -> dict[str, str]:
        """Return the rates since the last call, per second, by their keys in the diagnostics."""
        now = time.monotonic()
        elapsed = max(now - self._report_time, 1e-9)
        rates = {
            f'{name}_per_second': f'{(self.counts[name] - self._reported[name]) / elapsed:.2f}'
            for name in self._rates
        }
        self._reported, self._report_time = self.counts.copy(), now
        return rates

    def latency_values(self) -> dict[str, str]:
        """Return percentiles of the latest 1000 latencies, by their keys in the diagnostics."""
        if not self._latencies:
            return {}
        values = np.percentile(np.array(self._latencies) * 1e3, (50, 99, 100))
        # In full, so that they are found.
        keys = ('latency_p50_ms', 'latency_p99_ms', 'latency_max_ms')
        return {key: f'{value:.3f}' for key, value in zip(keys, values, strict=True)}
