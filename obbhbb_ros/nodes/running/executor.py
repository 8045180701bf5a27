# SPDX-License-Identifier: Apache-2.0
"""
An executor that serves the busy subscriptions and timers of a node without rclpy's overhead.

For every message, rclpy's executors gather all entities of a node, a dozen services among them, and
build a new wait set: about half a millisecond, more than the conversion of the message takes. For
a timer they do so three times. This one keeps its wait set, and calls the callbacks of raw
subscriptions and of timers itself. It leaves everything else to its base class. Why it is not
rclpy's `EventsExecutor`: `doc/executor.md`.
"""

from __future__ import annotations

from contextlib import ExitStack
from itertools import chain
from typing import Any

from rclpy.context import Context
from rclpy.exceptions import InvalidHandle
from rclpy.executors import ExternalShutdownException
from rclpy.executors import ShutdownException
from rclpy.executors import SingleThreadedExecutor
from rclpy.executors import TimeoutException
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.subscription import Subscription
from rclpy.waitable import NumberOfEntities

from obbhbb_ros.errors import ObbhbbError
from obbhbb_ros.nodes.lifecycle import internals

_KINDS = ('subscription', 'guard_condition', 'timer', 'client', 'service')
# Names that rclpy keeps to itself.
_EXECUTOR_NAMES = ('_guard', '_sigint_gc', '_tasks')
_NAMES = {
    'WaitSet': ('clear_entities', 'wait', 'get_ready_entities', *(f'add_{k}' for k in _KINDS)),
    'Timer': ('call_timer', 'is_timer_ready'),
}


class UnknownRclpyError(ObbhbbError, RuntimeError):
    """The installed rclpy lacks something that the executor needs; the text names it."""


class ExpressExecutor(SingleThreadedExecutor):
    """
    Runs a node like its base class, but serves raw subscriptions and timers a shorter way.

    If several raw subscriptions have messages, the executor takes one from each, in the order in
    which the node created them, so that none waits for another to run dry; then it calls the timers
    that are due. The callbacks must be plain functions: of the serialized message, or of it and
    what is known of it, or without arguments. The shorter way is open while the executor has a
    single node without guard conditions (a wait would use up their triggers), and no coroutine is
    in progress.

    Parameters
    ----------
    context : Context, optional
        As in the base class.

    Raises
    ------
    UnknownRclpyError
        If the installed rclpy lacks the private names that the shorter way needs.
    """

    def __init__(self, *, context: Context | None = None) -> None:
        super().__init__(context=context)
        self._wait_set: _KeptWaitSet | None = None
        self._base_may_have_work = True
        missing = [name for name in _EXECUTOR_NAMES if not hasattr(self, name)]
        for kind, names in _NAMES.items():
            made_by = getattr(rclpy_implementation, kind, None)
            missing += [f'{kind}.{name}' for name in names if not hasattr(made_by, name)]
        if not hasattr(Subscription, 'CallbackType'):
            missing.append('Subscription.CallbackType')
        if missing:
            self.shutdown()
            raise UnknownRclpyError(f'this rclpy has no {", ".join(missing)}')

    def spin_once(self, timeout_sec: float | None = None) -> None:
        """
        Wait until something is ready, and handle it.

        Parameters
        ----------
        timeout_sec : float, optional
            Maximum time to wait, seconds; without limit by default.
        """
        if self._base_may_have_work:
            self._spin_base(0.0)
            return
        if self._wait_set is None:
            self._wait_set = self._make_wait_set()
        if self._wait_set is None:
            self._spin_base(timeout_sec)
        else:
            self._spin_express(self._wait_set, timeout_sec)

    def shutdown(self, timeout_sec: float | None = None) -> bool:
        """See the base class."""
        self._close_wait_set()
        return bool(super().shutdown(timeout_sec))

    def _spin_base(self, timeout_sec: float | None) -> None:
        """Let the base class wait, and handle one thing."""
        try:
            handler, _, _ = self.wait_for_ready_callbacks(timeout_sec)
        except (TimeoutException, ShutdownException):
            self._base_may_have_work = False
            return
        handler()
        handler.result()

    def _spin_express(self, wait_set: _KeptWaitSet, timeout_sec: float | None) -> None:
        """Wait, then handle one message of each raw subscription that has one, and due timers."""
        try:
            ready = wait_set.wait(timeout_sec)
        except InvalidHandle:
            # A callback has destroyed an entity since the last wait.
            self._base_may_have_work = True
            self._close_wait_set()
            return
        if not self.context.ok():
            raise ExternalShutdownException
        try:
            for pointer, subscription, argument_count in wait_set.express:
                if pointer in ready:
                    ready.remove(pointer)
                    _take_and_call(subscription, argument_count)
            for timer in wait_set.timers_that_are_due():
                _call_if_due(timer)
        finally:
            # Checked after the messages, which are urgent. A guard condition may announce new
            # entities, so the next wait set is for the entities that exist then.
            if ready or wait_set.others_are_ready() or self._has_tasks():
                self._base_may_have_work = True
                self._close_wait_set()

    def _make_wait_set(self) -> _KeptWaitSet | None:
        """Make a wait set for the present entities; None if the shorter way is not open."""
        nodes = self.get_nodes()
        if len(nodes) != 1 or any(nodes[0].guards) or self._has_tasks():
            return None
        try:
            return _KeptWaitSet(self.context, nodes[0], [self._guard, self._sigint_gc])
        except InvalidHandle:
            # Another thread is destroying an entity; the base class copes with that.
            return None

    def _close_wait_set(self) -> None:
        """Let the entities of the wait set be destroyed."""
        if self._wait_set is not None:
            self._wait_set.close()
        self._wait_set = None

    def _has_tasks(self) -> bool:
        """Return whether coroutines are in progress."""
        # The base class keeps finished ones in the list until its next wait.
        return any(not task.done() for task, _, _ in self._tasks)


def _take_and_call(subscription: Any, argument_count: int) -> None:
    """Handle the next message of a raw subscription, unless a callback has destroyed it."""
    try:
        taken = internals.take(subscription)
    except InvalidHandle:
        return
    if taken is not None:
        subscription.callback(*taken[:argument_count])


def _call_if_due(timer: Any) -> None:
    """Call a timer, unless a callback has cancelled or destroyed it."""
    try:
        with timer.handle:
            if not timer.handle.is_timer_ready():
                return
            timer.handle.call_timer()
    except InvalidHandle:
        return
    timer.callback()


class _KeptWaitSet:
    """
    A wait set of all entities of a node, made once and used for many waits.

    Until `close`, none of the entities can be destroyed.

    Attributes
    ----------
    express : list of (int, Subscription, int)
        The raw subscriptions, with the pointers by which `wait` lists them and the number of
        arguments of their callbacks.
    """

    def __init__(self, context: Context, node: Node, guards: list[Any]) -> None:
        subscriptions, timers = list(node.subscriptions), list(node.timers)
        entities = (subscriptions, guards, timers, node.clients, node.services)
        handles = [[entity.handle for entity in group] for group in entities]
        self._waitables = list(node.waitables)
        self._stack = ExitStack()
        try:
            for in_use in (context.handle, *chain(*handles), *self._waitables):
                self._stack.enter_context(in_use)
            with_info = Subscription.CallbackType.WithMessageInfo
            self.express = [
                (s.handle.pointer, s, 1 + (s._callback_type is with_info))
                for s in subscriptions
                if s.raw
            ]
            self._timers = [(timer.handle.pointer, timer) for timer in timers]
            count = NumberOfEntities(*map(len, handles))
            for waitable in self._waitables:
                count += waitable.get_num_entities()
            counts = [getattr(count, f'num_{kind}s') for kind in (*_KINDS, 'event')]
            self._wait_set = rclpy_implementation.WaitSet(*counts, context.handle)
        except BaseException:
            self._stack.close()
            raise
        kinds = dict(zip(_KINDS, handles, strict=True))
        self._additions = [(getattr(self._wait_set, f'add_{k}'), kinds[k]) for k in _KINDS]
        others = ('guard_condition', 'client', 'service')
        self._other_kinds = [kind for kind in others if kinds[kind]]

    def wait(self, timeout_sec: float | None) -> list[int]:
        """
        Wait for any entity; return the pointers of the subscriptions that are ready.

        Raises InvalidHandle if one of the entities is to be destroyed.
        """
        self._wait_set.clear_entities()
        for add, handles in self._additions:
            for handle in handles:
                add(handle)
        for waitable in self._waitables:
            waitable.add_to_wait_set(self._wait_set)
        self._wait_set.wait(-1 if timeout_sec is None else int(max(timeout_sec, 0.0) * 1e9))
        ready: list[int] = self._wait_set.get_ready_entities('subscription')
        return ready

    def timers_that_are_due(self) -> list[Any]:
        """Return the timers that were due after the wait, in the order of their creation."""
        due = self._wait_set.get_ready_entities('timer') if self._timers else ()
        return [timer for pointer, timer in self._timers if pointer in due]

    def others_are_ready(self) -> bool:
        """Return whether anything but a subscription or a timer was ready after the wait."""
        return any(map(self._wait_set.get_ready_entities, self._other_kinds)) or any(
            waitable.is_ready(self._wait_set) for waitable in self._waitables
        )

    def close(self) -> None:
        """Let the entities be destroyed."""
        self._stack.close()
