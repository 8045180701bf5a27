"""
An executor for a node with one busy subscription.

rclpy's executors gather all entities of a node, a dozen services among them, and build a wait set
anew for every message: about half a millisecond, more than the rest of the work together. This one
keeps its wait set, and hands messages of the busy subscription over as soon as they are there.
Whatever else becomes ready it leaves to the executor it is made from.
"""

from __future__ import annotations

from typing import Any

from rclpy.executors import ExternalShutdownException
from rclpy.executors import SingleThreadedExecutor
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node

_FOREVER = -1
_KINDS = ('subscription', 'guard_condition', 'timer', 'client', 'service')


class ExpressExecutor(SingleThreadedExecutor):
    """
    Runs one node; messages of `node.express_subscription`, if it has one, take a short way.

    Parameters
    ----------
    node : Node
        The node to run.
    """

    def __init__(self, node: Node) -> None:
        super().__init__(context=node.context)
        self._served = node
        self._wait_set: Any = None
        self._handles: dict[str, list[Any]] = {}
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
            self._wait_set = None
            super().spin_once(timeout_sec)
            return
        nanoseconds = _FOREVER if timeout_sec is None else int(timeout_sec * 1e9)
        try:
            ready = self._wait(nanoseconds)
        except rclpy_implementation.InvalidHandle:
            # Something was destroyed since the handles were gathered.
            self._wait_set = None
            return
        express = subscription.handle.pointer
        if express in ready['subscription']:
            ready['subscription'].remove(express)
            taken = subscription.handle.take_message(subscription.msg_type, subscription.raw)
            if taken is not None:
                subscription.callback(taken[0])
        if any(ready.values()):
            # A guard condition may tell of new entities.
            self._wait_set = None
            super().spin_once(0.0)

    def _wait(self, nanoseconds: int) -> dict[str, list[int]]:
        """Wait; tell what is ready, by kind."""
        if self._wait_set is None:
            self._gather()
        self._wait_set.clear_entities()
        for kind in _KINDS:
            add = getattr(self._wait_set, f'add_{kind}')
            for handle in self._handles[kind]:
                add(handle)
        self._wait_set.wait(nanoseconds)
        if not self._context.ok():
            raise ExternalShutdownException
        return {kind: self._wait_set.get_ready_entities(kind) for kind in _KINDS}

    def _gather(self) -> None:
        """Make a wait set for what the node has now."""
        node = self._served
        guards = [*node.guards, self._guard, self._sigint_gc]
        entities = (node.subscriptions, guards, node.timers, node.clients, node.services)
        self._handles = {
            kind: [entity.handle for entity in group]
            for kind, group in zip(_KINDS, entities, strict=True)
        }
        counts = [len(self._handles[kind]) for kind in _KINDS]
        self._wait_set = rclpy_implementation.WaitSet(*counts, 0, self._context.handle)
