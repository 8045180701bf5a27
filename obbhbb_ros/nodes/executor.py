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
_OTHER_KINDS = _KINDS[1:]


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
        self._additions: list[tuple[Any, list[Any]]] = []
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
            self._wait(nanoseconds)
            # What else is ready is asked for only when the message is through.
            ready = self._wait_set.get_ready_entities('subscription')
            taken = None
            if subscription.handle.pointer in ready:
                ready.remove(subscription.handle.pointer)
                taken = subscription.handle.take_message(subscription.msg_type, subscription.raw)
        except rclpy_implementation.InvalidHandle:
            # Something was destroyed since the handles were gathered.
            self._wait_set = None
            return
        try:
            if taken is not None:
                subscription.callback(taken[0])
        finally:
            if ready or any(map(self._wait_set.get_ready_entities, _OTHER_KINDS)):
                # A guard condition may tell of new entities.
                self._wait_set = None
                super().spin_once(0.0)

    def _wait(self, nanoseconds: int) -> None:
        """Wait for anything of the node."""
        if self._wait_set is None:
            self._gather()
        self._wait_set.clear_entities()
        for add, handles in self._additions:
            for handle in handles:
                add(handle)
        self._wait_set.wait(nanoseconds)
        if not self._context.ok():
            raise ExternalShutdownException

    def _gather(self) -> None:
        """Make a wait set for what the node has now."""
        node = self._served
        guards = [*node.guards, self._guard, self._sigint_gc]
        entities = (node.subscriptions, guards, node.timers, node.clients, node.services)
        groups = [[entity.handle for entity in group] for group in entities]
        self._wait_set = rclpy_implementation.WaitSet(*map(len, groups), 0, self._context.handle)
        self._additions = [
            (getattr(self._wait_set, f'add_{kind}'), group)
            for kind, group in zip(_KINDS, groups, strict=True)
        ]
