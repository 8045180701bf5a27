"""
An executor for a node with one busy subscription.

rclpy's executors gather all entities of a node, a dozen services among them, and build a wait set
anew for every message: about half a millisecond, more than the rest of the work together. This one
keeps its wait sets, and hands messages of the busy subscription over as soon as they are there.
Whatever else becomes ready it leaves to the executor it is made from.
"""

from __future__ import annotations

import time
from typing import Any

from rclpy.executors import ExternalShutdownException
from rclpy.executors import SingleThreadedExecutor
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node

_FOREVER = -1
# How long a service may have to wait while messages follow one another, seconds.
_PATIENCE = 0.05


class _Wait:
    """
    A wait set that is kept.

    Parameters
    ----------
    groups : dict of str to list
        Handles of what to wait for, by kind.
    context : Any
        Handle of the context.

    Attributes
    ----------
    has_services : bool
        Whether services are among it.
    """

    KINDS = ('subscription', 'guard_condition', 'timer', 'client', 'service')

    def __init__(self, groups: dict[str, list[Any]], context: Any) -> None:
        counts = [len(groups[kind]) for kind in self.KINDS]
        self._wait_set = rclpy_implementation.WaitSet(*counts, 0, context)
        self._additions = [
            (getattr(self._wait_set, f'add_{kind}'), groups[kind]) for kind in self.KINDS
        ]
        self.has_services = bool(groups['service'])
        self._others = [kind for kind in self.KINDS[1:] if groups[kind]]

    def wait(self, nanoseconds: int) -> list[int]:
        """Wait for anything; tell which subscriptions are ready."""
        self._wait_set.clear_entities()
        for add, handles in self._additions:
            for handle in handles:
                add(handle)
        self._wait_set.wait(nanoseconds)
        ready: list[int] = self._wait_set.get_ready_entities('subscription')
        return ready

    def others(self) -> bool:
        """Tell whether anything but subscriptions is ready."""
        return any(map(self._wait_set.get_ready_entities, self._others))


class ExpressExecutor(SingleThreadedExecutor):
    """
    Runs one node; messages of `node.express_subscription`, if it has one, take a short way.

    While they follow one another, services are looked at only now and then: what they add to
    each wait would delay every message.

    Parameters
    ----------
    node : Node
        The node to run.
    """

    def __init__(self, node: Node) -> None:
        super().__init__(context=node.context)
        self._served = node
        self._waits: tuple[_Wait, _Wait] | None = None
        self._busy_until = 0.0
        self.add_node(node)

    def spin_once(self, timeout_sec: float | None = None) -> None:
        """
        Wait for anything to be ready and see to it.

        Parameters
        ----------
        timeout_sec : float, optional
            For how long to wait at most; for ever by default.
        """
        subscription = getattr(self._served, 'express_subscription', None)
        if subscription is None:
            self._waits = None
            super().spin_once(timeout_sec)
            return
        try:
            wait, timeout_sec = self._choose(timeout_sec)
            ready = wait.wait(_FOREVER if timeout_sec is None else int(timeout_sec * 1e9))
            if not self._context.ok():
                raise ExternalShutdownException
            taken = None
            if subscription.handle.pointer in ready:
                ready.remove(subscription.handle.pointer)
                taken = subscription.handle.take_message(subscription.msg_type, subscription.raw)
        except rclpy_implementation.InvalidHandle:
            # Something was destroyed since the handles were gathered.
            self._waits = None
            return
        try:
            if taken is not None:
                subscription.callback(taken[0])
                if wait.has_services:
                    self._busy_until = time.monotonic() + _PATIENCE
        finally:
            # What else is ready is asked for only now that the message is through.
            self._see_to_others(wait, bool(ready))

    def _choose(self, timeout_sec: float | None) -> tuple[_Wait, float | None]:
        """Choose what to wait for, and for how long."""
        if self._waits is None:
            self._waits = self._gather()
        few, everything = self._waits
        left = self._busy_until - time.monotonic()
        if left > 0.0:
            return few, left if timeout_sec is None else min(left, timeout_sec)
        return everything, timeout_sec

    def _see_to_others(self, wait: _Wait, subscriptions: bool) -> None:
        """Have another subscription, or anything else that is ready, served."""
        others = wait.others()
        if others:
            # Where there is one request there may be more.
            self._busy_until = 0.0
        if others or subscriptions:
            # A guard condition may tell of new entities.
            self._waits = None
            super().spin_once(0.0)

    def _gather(self) -> tuple[_Wait, _Wait]:
        """Make wait sets for what the node has now: without services, and for everything."""
        node = self._served
        guards = [*node.guards, self._guard, self._sigint_gc]
        entities = (node.subscriptions, guards, node.timers, node.clients, node.services)
        groups = {
            kind: [entity.handle for entity in group]
            for kind, group in zip(_Wait.KINDS, entities, strict=True)
        }
        context = self._context.handle
        few = {**groups, 'client': [], 'service': []}
        return _Wait(few, context), _Wait(groups, context)
