# SPDX-License-Identifier: Apache-2.0
"""
What rclpy keeps to itself and the nodes use all the same; no other module does.

Written for rclpy 7 (Jazzy). `missing` lists what another release lacks.
"""

from __future__ import annotations

from collections.abc import Callable
from collections.abc import Mapping
from contextlib import ExitStack
from itertools import chain
from typing import Any

from rclpy.executors import Executor
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.lifecycle import LifecycleNode
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.waitable import NumberOfEntities

_OF_AN_EXECUTOR = ('_guard', '_sigint_gc', '_tasks')
_OF_A_WAIT_SET = ('clear_entities', 'wait', 'get_ready_entities', 'add_subscription', 'add_event')
_KINDS = ('subscription', 'guard_condition', 'timer', 'client', 'service')


def missing(executor: Executor) -> list[str]:
    """List what `KeptWaitSet` and an executor that uses it need and this rclpy does not have."""
    wait_set = getattr(rclpy_implementation, 'WaitSet', None)
    return [
        *(name for name in _OF_AN_EXECUTOR if not hasattr(executor, name)),
        *(f'WaitSet.{name}' for name in _OF_A_WAIT_SET if not hasattr(wait_set, name)),
    ]


def has_tasks(executor: Executor) -> bool:
    """Return whether an executor has coroutines in progress."""
    # Those that are done stay in its list until it waits again.
    return any(not task.done() for task, _, _ in executor._tasks)


class KeptWaitSet:
    """
    A wait set of all entities of a node, made once and waited on many times.

    What it waits for cannot be destroyed before `close`.

    Parameters
    ----------
    executor : Executor
        Whose guard conditions wake the wait.
    node : Node
        The node. Its guard conditions are left out: a wait would use their triggers up.
    """

    def __init__(self, executor: Executor, node: Node) -> None:
        entities = {
            'subscription': list(node.subscriptions),
            'guard_condition': [executor._guard, executor._sigint_gc],
            'timer': list(node.timers),
            'client': list(node.clients),
            'service': list(node.services),
        }
        self._waitables = list(node.waitables)
        self._stack = ExitStack()
        context = executor.context.handle
        handles = {kind: [each.handle for each in entities[kind]] for kind in _KINDS}
        try:
            for held in (context, *chain(*handles.values()), *self._waitables):
                self._stack.enter_context(held)
            counts = sum(
                (each.get_num_entities() for each in self._waitables),
                NumberOfEntities(*map(len, handles.values())),
            )
            self._wait_set = rclpy_implementation.WaitSet(
                counts.num_subscriptions,
                counts.num_guard_conditions,
                counts.num_timers,
                counts.num_clients,
                counts.num_services,
                counts.num_events,
                context,
            )
        except BaseException:
            self._stack.close()
            raise
        self._additions = [
            (getattr(self._wait_set, f'add_{kind}'), handles[kind]) for kind in _KINDS
        ]
        self._others = [kind for kind in _KINDS[1:] if handles[kind]]

    def wait(self, timeout_sec: float | None) -> list[int]:
        """Wait for anything; give the pointers of the subscriptions that are ready."""
        self._wait_set.clear_entities()
        for add, handles in self._additions:
            for handle in handles:
                add(handle)
        for waitable in self._waitables:
            waitable.add_to_wait_set(self._wait_set)
        self._wait_set.wait(-1 if timeout_sec is None else int(max(timeout_sec, 0.0) * 1e9))
        ready: list[int] = self._wait_set.get_ready_entities('subscription')
        return ready

    def others_ready(self) -> bool:
        """Return whether anything but subscriptions was ready after the wait."""
        return any(map(self._wait_set.get_ready_entities, self._others)) or any(
            waitable.is_ready(self._wait_set) for waitable in self._waitables
        )

    def close(self) -> None:
        """Release the entities."""
        self._stack.close()


def pointer(subscription: Any) -> int:
    """Return what `KeptWaitSet.wait` knows a subscription by."""
    number: int = subscription.handle.pointer
    return number


def take(subscription: Any) -> Any:
    """Take a message; None if there is none."""
    with subscription.handle:
        taken = subscription.handle.take_message(subscription.msg_type, subscription.raw)
    return None if taken is None else taken[0]


def parameters_given(node: Node) -> Mapping[str, Parameter]:
    """Return the parameters of YAML files and command line, declared or not."""
    overrides: Mapping[str, Parameter] = node._parameter_overrides
    return overrides


def state_label(node: LifecycleNode) -> str:
    """Return the lifecycle state of a node."""
    label: str = node._state_machine.current_state[1]
    return label


def refuse_impossible_transitions(node: LifecycleNode, log: Callable[[str], object]) -> None:
    """Have a node answer a request for a transition that its state does not have, with no."""
    service = node._service_change_state
    answer = service.callback

    def change_state(request: Any, response: Any) -> Any:
        # rclpy raises, which leaves the caller without a response.
        try:
            return answer(request, response)
        except rclpy_implementation.RCLError as error:
            log(f'transition refused: {error}')
            response.success = False
            return response

    service.callback = change_state
