# SPDX-License-Identifier: Apache-2.0
"""
What the example for chips uses of message_filters, which PyPI lacks.

The rule is that of the real one: messages belong together if their header stamps are equal.
"""

from __future__ import annotations

from collections.abc import Callable
from collections.abc import Sequence
from functools import partial
from typing import Any


class Subscriber:
    """A subscription that passes messages on."""

    def __init__(self, node: Any, kind: Any, topic: str, qos_profile: Any = 10) -> None:
        self.callbacks: list[Callable[[Any], None]] = []
        node.create_subscription(kind, topic, self._pass_on, qos_profile)

    def _pass_on(self, message: Any) -> None:
        for callback in self.callbacks:
            callback(message)


class TimeSynchronizer:
    """Calls back with one message of each subscriber when all have the same stamp."""

    def __init__(self, subscribers: Sequence[Subscriber], queue_size: int) -> None:
        self._size = queue_size
        self._queues: list[dict[int, Any]] = [{} for _ in subscribers]
        for queue, subscriber in zip(self._queues, subscribers, strict=True):
            subscriber.callbacks.append(partial(self._add, queue))

    def registerCallback(self, callback: Callable[..., None]) -> None:  # noqa: N802
        self._callback = callback

    def _add(self, queue: dict[int, Any], message: Any) -> None:
        stamp = message.header.stamp.sec * 10**9 + message.header.stamp.nanosec
        queue[stamp] = message
        if len(queue) > self._size:
            del queue[min(queue)]
        if all(stamp in each for each in self._queues):
            self._callback(*(each.pop(stamp) for each in self._queues))
