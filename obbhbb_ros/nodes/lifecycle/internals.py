# SPDX-License-Identifier: Apache-2.0
"""
Private names of rclpy that the nodes use.

Only this module and `executor.py` use any. Both are written for rclpy 7 (Jazzy).
"""

from __future__ import annotations

from collections.abc import Callable
from collections.abc import Mapping
from copy import copy
from typing import Any

from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.lifecycle import LifecycleNode
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile
from rclpy.qos_overriding_options import QoSOverridingOptions
from rclpy.qos_overriding_options import _declare_qos_parameters
from rclpy.subscription import Subscription


def parameters_given(node: Node) -> dict[str, Parameter]:
    """Return the parameters from YAML files and the command line, declared or not."""
    return dict(node._parameter_overrides)


def forget_given(node: Node, name: str) -> None:
    """Declare a parameter with its default, whatever a YAML file or the command line gave."""
    del node._parameter_overrides[name]


def overridden_subscription(
    node: Node, topic: str, qos: QoSProfile, options: QoSOverridingOptions
) -> QoSProfile:
    """Return a profile with the QoS overrides for the subscription to a topic, and declare them."""
    profile = copy(qos)
    _declare_qos_parameters(Subscription, node, topic, profile, options)
    return profile


def put_before(node: Node, subscription: Subscription, other: Subscription) -> None:
    """Make an executor serve a new subscription of a node before another one."""
    subscriptions = node._subscriptions
    subscriptions.remove(subscription)
    subscriptions.insert(subscriptions.index(other), subscription)


def take(subscription: Subscription) -> tuple[bytes, Mapping[str, int]] | None:
    """Take the next message of a raw subscription, as it came, with its metadata, if any waits."""
    with subscription.handle:
        taken: tuple[bytes, Mapping[str, int]] | None = subscription.handle.take_message(
            subscription.msg_type, True
        )
    return taken


def state_label(node: LifecycleNode) -> str:
    """Return the lifecycle state of a node."""
    return str(node._state_machine.current_state[1])


def replace_service_callback(node: Node, service: str, callback: Callable[[Any, Any], Any]) -> None:
    """Make a function answer the requests to a service of a node, given its name in the node."""
    name = f'{node.get_fully_qualified_name().rstrip("/")}/{service}'
    (existing,) = (made for made in node.services if made.service_name == name)
    existing.callback = callback


def refuse_impossible_transitions(node: LifecycleNode, log: Callable[[str], object]) -> None:
    """Make a node answer a request for an impossible transition with `success: false`."""
    service = node._service_change_state
    answer = service.callback

    def change_state(request: Any, response: Any) -> Any:
        # rclpy raises, and the caller would wait for ever.
        try:
            return answer(request, response)
        except rclpy_implementation.RCLError as error:
            log(f'transition refused: {error}')
            response.success = False
            return response

    service.callback = change_state
