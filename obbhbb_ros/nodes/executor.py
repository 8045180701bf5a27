# SPDX-License-Identifier: Apache-2.0
"""
An executor for a node with busy subscriptions.

rclpy's executors gather all entities of a node, a dozen services among them, and build a wait set
anew for every message: about half a millisecond, more than the rest of the work together. This one
keeps its wait set, and hands messages over as soon as they are there. Whatever else becomes ready
it leaves to the executor it is made from.
"""

from __future__ import annotations

from typing import Any

from rclpy.context import Context
from rclpy.exceptions import InvalidHandle
from rclpy.executors import ExternalShutdownException
from rclpy.executors import ShutdownException
from rclpy.executors import SingleThreadedExecutor
from rclpy.executors import TimeoutException

from obbhbb_ros.nodes import internals


class UnknownRclpyError(RuntimeError):
    """The installed rclpy lacks something that the executor needs; the text says what."""


class ExpressExecutor(SingleThreadedExecutor):
    """
    Runs nodes like its base class; messages of a node's `express_subscriptions` take a short way.

    Those subscriptions are listed in the order in which they are served when several have a
    message: one each, so that none waits for another to run dry. Their callbacks are plain
    functions of the message alone. The short way is open while the node is the only one, has no
    guard conditions of its own (a wait uses their triggers up), and no coroutine is in progress.

    Parameters
    ----------
    context : Context, optional
        As in the base class.

    Raises
    ------
    UnknownRclpyError
        If this rclpy does not have what the short way is built on.
    """

    def __init__(self, *, context: Context | None = None) -> None:
        super().__init__(context=context)
        self._express: list[tuple[int, Any]] = []
        self._wait_set: internals.KeptWaitSet | None = None
        # Whether the base class may have something to do.
        self._others_ready = True
        missing = internals.missing(self)
        if missing:
            self.shutdown()
            raise UnknownRclpyError(f'this rclpy has no {", ".join(missing)}')

    def spin_once(self, timeout_sec: float | None = None) -> None:
        """
        Wait until something is ready, and handle it.

        Parameters
        ----------
        timeout_sec : float, optional
            For how long to wait at most; for ever by default.
        """
        if self._others_ready:
            self._spin_base(0.0)
            return
        if self._wait_set is None:
            self._wait_set = self._gather()
        if self._wait_set is None:
            self._spin_base(timeout_sec)
        else:
            self._spin_express(self._wait_set, timeout_sec)

    def shutdown(self, timeout_sec: float | None = None) -> bool:
        """See the base class."""
        self._forget_wait_set()
        ended: bool = super().shutdown(timeout_sec)
        return ended

    def _spin_base(self, timeout_sec: float | None) -> None:
        """Let the base class handle one thing."""
        try:
            handler, _, _ = self.wait_for_ready_callbacks(timeout_sec)
        except (TimeoutException, ShutdownException):
            self._others_ready = False
            return
        handler()
        handler.result()

    def _spin_express(self, wait_set: internals.KeptWaitSet, timeout_sec: float | None) -> None:
        """Wait, then handle one message of each subscription that has one."""
        ready = wait_set.wait(timeout_sec)
        if not self.context.ok():
            raise ExternalShutdownException
        try:
            for pointer, subscription in self._express:
                if pointer in ready:
                    ready.remove(pointer)
                    message = internals.take(subscription)
                    if message is not None:
                        subscription.callback(message)
        finally:
            # Asked for only now that the messages are through. A guard condition may tell of new
            # entities, so the next wait is for what there is then.
            if ready or wait_set.others_ready() or internals.has_tasks(self):
                self._others_ready = True
                self._forget_wait_set()

    def _gather(self) -> internals.KeptWaitSet | None:
        """Make the wait set for what there is now; None where the short way is not open."""
        nodes = self.get_nodes()
        if len(nodes) != 1 or any(nodes[0].guards) or internals.has_tasks(self):
            return None
        express = getattr(nodes[0], 'express_subscriptions', ())
        try:
            self._express = [(internals.pointer(each), each) for each in express]
            return internals.KeptWaitSet(self, nodes[0])
        except InvalidHandle:
            # Another thread is destroying something; the base class knows how to wait all the same.
            return None

    def _forget_wait_set(self) -> None:
        """Let the entities of the wait set be destroyed."""
        if self._wait_set is not None:
            self._wait_set.close()
        self._wait_set = None
