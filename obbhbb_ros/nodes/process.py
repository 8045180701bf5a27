"""From command line to clean exit: what every node's `main` does."""

from __future__ import annotations

import sys
from collections.abc import Callable
from collections.abc import Sequence

import rclpy
from rclpy.exceptions import ParameterException
from rclpy.executors import Executor
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node

from obbhbb_ros.nodes.executor import ExpressExecutor

_LONGEST_WAIT = 1.0


class StartError(RuntimeError):
    """A node cannot start; the text says why."""


_REASONS = (ParameterException, StartError, ValueError, OSError)


def run(make_node: Callable[[], Node], args: Sequence[str] | None = None) -> int:
    """
    Run a node until it is told to stop.

    Parameters
    ----------
    make_node : callable
        Makes the node; may raise `StartError`, ValueError, OSError or ParameterException.
    args : sequence of str, optional
        Command line, `sys.argv` by default.

    Returns
    -------
    int
        Exit code: 0 after SIGINT, SIGTERM or a shutdown of the context, 1 if the node cannot
        start.
    """
    try:
        rclpy.init(args=args)
    except RuntimeError as error:
        # What stands behind --ros-args cannot be used.
        print(f'cannot start: {error}', file=sys.stderr)
        return 1
    try:
        node = make_node()
    except KeyboardInterrupt:
        rclpy.try_shutdown()
        return 0
    except Exception as error:
        # A signal that comes this early takes the context from under the node being made.
        told_to_stop = not rclpy.ok()
        rclpy.try_shutdown()
        if told_to_stop:
            return 0
        if not isinstance(error, _REASONS):
            raise
        print(f'cannot start: {error}', file=sys.stderr)
        return 1
    executor = ExpressExecutor(node)
    try:
        spin(executor, node)
    except KeyboardInterrupt:
        pass
    finally:
        executor.shutdown()
        node.destroy_node()
        rclpy.try_shutdown()
    return 0


def spin(executor: Executor, node: Node) -> None:
    """Spin until the context ends; an error in a callback is logged and survived."""
    while rclpy.ok():
        try:
            # Not for ever: rclpy wakes its executors a moment before a signal ends the context, and
            # who is back at waiting by then would never hear of it.
            executor.spin_once(timeout_sec=_LONGEST_WAIT)
        except ExternalShutdownException:
            return
        except Exception as error:
            if not rclpy.ok():
                return
            node.get_logger().error(
                f'{type(error).__name__} in a callback: {error}', throttle_duration_sec=1.0
            )
