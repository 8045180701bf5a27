# SPDX-License-Identifier: Apache-2.0
"""Nodes in processes of their own, for the time of a demo."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from collections.abc import Mapping
from collections.abc import Sequence

import rclpy
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor

# Three nodes take half a minute to start on a busy machine.
_TIMEOUT = 60.0
_AGAIN = 0.5


class DemoChain:
    """
    Nodes in separate processes, and a node that talks to them, for the time of a `with` block.

    They have a namespace to themselves.

    Parameters
    ----------
    nodes : mapping of str to sequence of str
        Arguments after `--ros-args`, by executable.

    Attributes
    ----------
    node : rclpy.node.Node
        The node that talks to them.
    """

    def __init__(self, nodes: Mapping[str, Sequence[str]]) -> None:
        self._namespace = f'/obbhbb_{os.getpid()}'
        self._context = Context()
        self._nodes = nodes
        self._processes: dict[str, subprocess.Popen[bytes]] = {}

    def __enter__(self) -> DemoChain:
        """Start the processes."""
        rclpy.init(context=self._context)
        self.node = rclpy.create_node('client', namespace=self._namespace, context=self._context)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self.node)
        for executable, arguments in self._nodes.items():
            self.start(executable, arguments)
        return self

    def __exit__(self, *_: object) -> None:
        """Stop the processes."""
        for process in self._processes.values():
            process.send_signal(signal.SIGINT)
        for process in self._processes.values():
            process.wait(_TIMEOUT)
        self._executor.shutdown()
        self.node.destroy_node()
        rclpy.try_shutdown(context=self._context)

    def start(self, executable: str, arguments: Sequence[str]) -> None:
        """Start one more process, with arguments after `--ros-args`."""
        command = [sys.executable, '-m', 'obbhbb_ros.nodes', executable, '--ros-args']
        # Until discovery is complete, warnings of missing messages are normal.
        command += ['--log-level', 'error', '-r', f'__ns:={self._namespace}', *arguments]
        self._processes[executable] = subprocess.Popen(command)

    def spin_to_end_of(self, executable: str) -> None:
        """Receive messages until a process that ends by itself has ended; else TimeoutError."""
        process, deadline = self._processes[executable], time.monotonic() + _TIMEOUT
        while process.poll() is None:
            if time.monotonic() > deadline:
                raise TimeoutError(f'{executable} has not ended in {_TIMEOUT:g} s')
            self._executor.spin_once(timeout_sec=0.05)
        del self._processes[executable]
        if process.returncode:
            raise ChildProcessError(f'{executable} has failed')

    def spin_for(self, seconds: float) -> None:
        """Receive messages for some time."""
        end = time.monotonic() + seconds
        while (left := end - time.monotonic()) > 0.0:
            self._executor.spin_once(timeout_sec=left)

    def spin_until(
        self,
        condition: Callable[[], bool],
        what: str,
        send: Callable[[], object] = lambda: None,
        period: float = _AGAIN,
    ) -> None:
        """Receive, and send something repeatedly, until a condition holds; else TimeoutError."""
        deadline, again = time.monotonic() + _TIMEOUT, 0.0
        while not condition():
            now = time.monotonic()
            for name, process in self._processes.items():
                if process.poll() is not None:
                    raise ChildProcessError(f'{name} has ended')
            if now > deadline:
                raise TimeoutError(f'{", ".join(self._nodes)}: no {what} in {_TIMEOUT:g} s')
            if now >= again:
                send()
                again = now + period
            self._executor.spin_once(timeout_sec=0.05)
