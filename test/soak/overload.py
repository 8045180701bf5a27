# SPDX-License-Identifier: Apache-2.0
"""
Measure how an executor treats timers and other topics while one callback is too slow.

    python test/soak/overload.py --seconds 20
    python test/soak/overload.py --executor rclpy.experimental:EventsExecutor

A topic at 100 Hz has a callback of 20 ms; beside it there are a topic at 10 Hz and a timer of 1 Hz.
At least half of the ticks and nine tenths of the other messages must come.
With another executor this is the second half of the test described in doc/executor.md.
"""

from __future__ import annotations

import argparse
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import rclpy
from rclpy.clock import Clock
from rclpy.clock import ClockType
from rclpy.executors import Executor
from rclpy.node import Node
from std_msgs.msg import Int64

sys.path.insert(0, str(Path(__file__).parents[1]))

from executors import OURS
from executors import executor_class

SLOW_PERIOD, CALLBACK, OTHERS = 0.01, 0.02, 10
TIMER_PERIOD = 1.0
# Less means starvation, on however slow a machine.
MIN_TICKS, MIN_MESSAGES = 0.5, 0.9


class Overloaded(Node):
    """A node with a callback that takes longer than its messages leave it."""

    def __init__(self) -> None:
        super().__init__('overloaded')
        self.ticks: list[float] = []
        self.received = 0
        self.create_subscription(Int64, 'slow', lambda _: time.sleep(CALLBACK), 10, raw=True)
        self.create_subscription(Int64, 'other', self._receive, 10, raw=True)
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self.create_timer(TIMER_PERIOD, lambda: self.ticks.append(time.monotonic()), clock=steady)

    def _receive(self, _: bytes) -> None:
        self.received += 1


def publish(node: Node, seconds: float) -> int:
    """Publish on both topics for some time, and return the number of messages on the other one."""
    slow, other = (node.create_publisher(Int64, topic, 10) for topic in ('slow', 'other'))
    while not (slow.get_subscription_count() and other.get_subscription_count()):
        time.sleep(0.01)
    started, count = time.monotonic(), 0
    while (due := started + count * SLOW_PERIOD) < started + seconds:
        time.sleep(max(0.0, due - time.monotonic()))
        slow.publish(Int64())
        if count % OTHERS == 0:
            other.publish(Int64())
        count += 1
    return -(-count // OTHERS)


def measure(make_executor: Callable[..., Executor], seconds: float) -> bool:
    """Overload an executor; print and judge what becomes of the timer and the other topic."""
    rclpy.init()
    node, peer = Overloaded(), Node('peer')
    executor = make_executor()
    executor.add_node(node)
    sent: list[int] = []
    publishing = threading.Thread(target=lambda: sent.append(publish(peer, seconds)))
    publishing.start()
    started = time.monotonic()
    while publishing.is_alive():
        executor.spin_once(timeout_sec=0.1)
    ended = time.monotonic()
    # The last messages, and whatever the executor has queued, are not part of the overload.
    while time.monotonic() < ended + 1.0:
        executor.spin_once(timeout_sec=0.1)
    ticks = [tick for tick in node.ticks if tick <= ended]
    gaps = np.diff([started, *ticks, ended])
    executor.shutdown()
    node.destroy_node()
    peer.destroy_node()
    rclpy.shutdown()
    print(
        f'timer: {len(ticks)} ticks in {ended - started:.1f} s, longest gap {gaps.max():.2f} s; '
        f'other topic: {node.received} of {sent[0]} messages'
    )
    expected = MIN_TICKS * int(seconds / TIMER_PERIOD)
    return len(ticks) >= expected and node.received >= MIN_MESSAGES * sent[0]


def main() -> None:
    """Overload the executor and judge it."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parser.add_argument('--seconds', type=float, default=20.0)
    parser.add_argument('--executor', default=OURS, help='module:class')
    options = parser.parse_args()
    sys.exit(0 if measure(executor_class(options.executor), options.seconds) else 1)


if __name__ == '__main__':
    main()
