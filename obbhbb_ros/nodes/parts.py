# SPDX-License-Identifier: Apache-2.0
"""What a managed node is made of."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from rclpy.clock import Clock
from rclpy.clock import ClockType
from rclpy.node import Node

# With `use_sim_time`, the clock of the node may stand still or go backwards.
_STEADY = Clock(clock_type=ClockType.STEADY_TIME)


class Part:
    """
    A part of a managed node, which passes its lifecycle transitions on to all of its parts.

    They reach the parts in order, only `cleanup` in reverse. `deactivate` and `cleanup` may come in
    any state, also after a `configure` that failed half-way.
    """

    def configure(self) -> None:
        """Get what the part needs; whatever it raises fails the transition."""

    def activate(self) -> None:
        """Start working."""

    def deactivate(self) -> None:
        """Stop working, and drop unfinished work."""

    def cleanup(self) -> None:
        """Release what `configure` got."""


def steady_timer(node: Node, period: float, callback: Callable[[], object]) -> Any:
    """Create a timer with a period in seconds that is independent of simulated time."""
    return node.create_timer(period, callback, clock=_STEADY)
