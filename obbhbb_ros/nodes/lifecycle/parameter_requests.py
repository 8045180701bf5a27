# SPDX-License-Identifier: Apache-2.0
"""Answers to requests to set parameters, also to those at which rclpy fails."""

from __future__ import annotations

from collections.abc import Callable
from collections.abc import Sequence
from typing import Any

from rcl_interfaces.msg import SetParametersResult
from rclpy.node import Node
from rclpy.parameter import Parameter as RosParameter

from obbhbb_ros.nodes.lifecycle import internals


class ParameterRequests:
    """
    Answers the services `set_parameters` and `set_parameters_atomically` of a node.

    rclpy raises where a value has a type that ROS does not have, and the caller would wait for
    ever. Here nothing of such a request is applied, and the answer says why. A read-only parameter
    may be set to the value that it has, as `ros2 param load` does with the dump of a node.

    Parameters
    ----------
    node : Node
        The node.
    adapted : callable
        Returns a parameter with the type that the node has for it, if it can be read as such;
        ValueError if it cannot.
    apply : callable
        Sets parameters as a whole.
    """

    def __init__(
        self,
        node: Node,
        adapted: Callable[[RosParameter], RosParameter],
        apply: Callable[[Sequence[RosParameter]], SetParametersResult],
    ) -> None:
        self._node, self._adapted, self._apply = node, adapted, apply
        internals.replace_service_callback(node, 'set_parameters', self._set_one_by_one)
        internals.replace_service_callback(node, 'set_parameters_atomically', self._set_together)

    def _set_one_by_one(self, request: Any, response: Any) -> Any:
        """Set every parameter for itself."""
        try:
            changes = [RosParameter.from_parameter_msg(message) for message in request.parameters]
        except Exception as error:
            response.results = [_refused(str(error))] * len(request.parameters)
        else:
            response.results = [self._set([change]) for change in changes]
        return response

    def _set_together(self, request: Any, response: Any) -> Any:
        """Set all parameters or none."""
        try:
            changes = [RosParameter.from_parameter_msg(message) for message in request.parameters]
        except Exception as error:
            response.result = _refused(str(error))
        else:
            response.result = self._set(changes)
        return response

    def _set(self, changes: Sequence[RosParameter]) -> SetParametersResult:
        """Set parameters as a whole; whatever rclpy raises refuses them."""
        try:
            adapted = map(self._adapted, changes)
            return self._apply([change for change in adapted if not self._is_in_force(change)])
        except Exception as error:
            return _refused(str(error))

    def _is_in_force(self, change: RosParameter) -> bool:
        """Return whether a parameter is read-only and has this value already."""
        name = change.name
        if not self._node.has_parameter(name) or not self._node.describe_parameter(name).read_only:
            return False
        current = self._node.get_parameter(name)
        return bool(current.type_ == change.type_ and current.value == change.value)


def _refused(reason: str) -> SetParametersResult:
    """Refuse a request."""
    return SetParametersResult(successful=False, reason=reason)
