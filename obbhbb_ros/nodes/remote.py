# SPDX-License-Identifier: Apache-2.0
"""A conversion node in a process of its own, and somebody who talks to it over DDS."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Mapping
from types import TracebackType
from typing import Any

import rclpy
from rcl_interfaces.srv import SetParametersAtomically
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile
from vision_msgs.msg import Detection2DArray

_TIMEOUT = 20.0


class RemoteConverter:
    """
    Runs `obb_to_hbb` in a namespace of its own, for as long as the `with` block lasts.

    Raises
    ------
    TimeoutError
        If the node does not answer in time.
    """

    def __init__(self) -> None:
        self._namespace = f'/obbhbb_{os.getpid()}'
        self._answers: list[Detection2DArray] = []

    def __enter__(self) -> RemoteConverter:
        """Start the node and wait until it is there."""
        command = [sys.executable, '-m', 'obbhbb_ros.nodes', 'obb_to_hbb', '--ros-args']
        self._process = subprocess.Popen([*command, '-r', f'__ns:={self._namespace}'])
        try:
            self._connect()
        except BaseException:
            self._leave()
            raise
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Stop the node."""
        self._leave()

    def _connect(self) -> None:
        """Find the node's topics and services."""
        self._context = Context()
        rclpy.init(context=self._context)
        self._node = rclpy.create_node(
            'client', namespace=self._namespace, context=self._context
        )
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self._node)
        self._parameters = self._node.create_client(
            SetParametersAtomically, 'obb_to_hbb/set_parameters_atomically'
        )
        self._node.create_subscription(
            Detection2DArray, 'boxes', self._answers.append, QoSProfile(depth=10)
        )
        self._publisher = self._node.create_publisher(
            Detection2DArray, 'detections', QoSProfile(depth=10)
        )
        self._wait(
            lambda: self._publisher.get_subscription_count()
            and self._node.count_publishers('boxes')
            and self._parameters.service_is_ready()
        )

    def _leave(self) -> None:
        """Stop the node and the client."""
        self._process.send_signal(signal.SIGINT)
        self._process.wait(_TIMEOUT)
        self._executor.shutdown()
        self._node.destroy_node()
        rclpy.try_shutdown(context=self._context)

    def set_parameters(self, values: Mapping[str, Any]) -> None:
        """
        Change parameters of the node, all or none.

        Raises
        ------
        ValueError
            If the node rejects them; the text is its reason.
        """
        request = SetParametersAtomically.Request()
        request.parameters = [
            Parameter(name, value=value).to_parameter_msg() for name, value in values.items()
        ]
        future = self._parameters.call_async(request)
        self._wait(future.done)
        result = future.result().result
        if not result.successful:
            raise ValueError(result.reason)

    def convert(self, message: Detection2DArray) -> Detection2DArray:
        """Send detections and wait for their boxes."""
        self._answers.clear()
        # The node's end of `boxes` may know of us a little later than we know of it.
        deadline = time.monotonic() + _TIMEOUT
        while not self._answers:
            if time.monotonic() > deadline:
                raise TimeoutError('the node sends no boxes')
            self._publisher.publish(message)
            again = time.monotonic() + 1.0
            while not self._answers and time.monotonic() < again:
                self._executor.spin_once(timeout_sec=0.1)
        return self._answers[0]

    def _wait(self, condition: Any) -> None:
        """Spin until something holds."""
        deadline = time.monotonic() + _TIMEOUT
        while not condition():
            if self._process.poll() is not None or time.monotonic() > deadline:
                raise TimeoutError('the node does not answer')
            self._executor.spin_once(timeout_sec=0.05)
