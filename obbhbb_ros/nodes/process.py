# SPDX-License-Identifier: Apache-2.0
"""From command line to clean exit: what every node's process does."""

from __future__ import annotations

import gc
import os
import stat
import sys
from collections.abc import Callable
from contextlib import suppress

import rclpy
from rclpy.exceptions import ParameterException
from rclpy.executors import Executor
from rclpy.executors import ExternalShutdownException
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions

from obbhbb_ros.nodes.executor import ExpressExecutor
from obbhbb_ros.nodes.executor import UnknownRclpyError
from obbhbb_ros.nodes.failure import REASONS
from obbhbb_ros.nodes.failure import cannot_start
from obbhbb_ros.nodes.given_parameters import warn_of_unused_files
from obbhbb_ros.nodes.managed import ManagedNode
from obbhbb_ros.nodes.stop import RUNNING
from obbhbb_ros.nodes.stop import STARTING
from obbhbb_ros.nodes.stop import Stop
from obbhbb_ros.nodes.supervision import Supervision
from obbhbb_ros.nodes.watchdog import Watchdog

# The stock executor does not return when it is only woken, and the watchdog has to tell an idle
# executor from a blocked one.
_MAX_WAIT = 1.0


def executor_for(node: Node) -> Executor:
    """Make an executor for a node: `ExpressExecutor`, or rclpy's own if that cannot be made."""
    try:
        executor: Executor = ExpressExecutor(context=node.context)
    except UnknownRclpyError as error:
        node.get_logger().warning(f'{error}: using its own executor, which is slower')
        executor = SingleThreadedExecutor(context=node.context)
    executor.add_node(node)
    return executor


def run(
    make_node: Callable[[], Node],
    stop: Stop,
    make_executor: Callable[[Node], Executor] = executor_for,
) -> int:
    """
    Run a node until SIGINT, SIGTERM or a shutdown of its context.

    Parameters
    ----------
    make_node : callable
        Makes the node; may raise ParameterException, or what `failure.REASONS` lists.
    stop : Stop
        Receives SIGINT and SIGTERM.
    make_executor : callable, optional
        Makes the executor of the node.

    Returns
    -------
    int
        Exit code: 0 after SIGINT, SIGTERM or a shutdown, 1 if the node cannot start.
    """
    stop.patience = STARTING
    never_wait_to_log()
    try:
        rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    except REASONS as error:
        # The arguments after --ros-args cannot be used.
        return cannot_start(error)
    try:
        node = make_node()
        warn_of_unused_files([node])
        supervision = Supervision([node] if isinstance(node, ManagedNode) else [])
        supervision.start_nodes()
    except (ParameterException, *REASONS) as error:
        rclpy.try_shutdown()
        return cannot_start(error)
    stop.on_leaving = supervision.end
    stop.patience = RUNNING
    try:
        _run_to_the_end(make_executor(node), node, stop, supervision)
    except BaseException as error:
        supervision.end(f'{type(error).__name__}: {error}')
        raise
    supervision.end(stop.name or 'shutdown', asked=True)
    return 0


def _run_to_the_end(executor: Executor, node: Node, stop: Stop, supervision: Supervision) -> None:
    """Spin a node until asked to stop, then destroy it."""
    stop.wake_by(executor.wake)
    try:
        spin(executor, node, stop, supervision.watchdog)
    finally:
        supervision.watchdog.stop()
        stop.wake_by(lambda: None)
        executor.shutdown()
        node.destroy_node()
        rclpy.try_shutdown()


def never_wait_to_log() -> None:
    """
    Make standard output and error drop lines instead of waiting for a reader.

    A pipe that nobody reads fills up, and the next line would block the node for good. The lines
    are on /rosout and in the log file as well.
    """
    for number, stream in ((1, sys.stdout), (2, sys.stderr)):
        # A stream that was closed at start: by now its number belongs to another file. A regular
        # file never blocks.
        mode = stat.S_IFREG if stream is None else os.fstat(number).st_mode
        if stat.S_ISSOCK(mode):
            # A socket, such as that of journald, cannot be opened a second time.
            os.set_blocking(number, False)
        elif stat.S_ISFIFO(mode) or stat.S_ISCHR(mode):
            # Opened a second time, because other processes share the flags of the first.
            flags = os.O_WRONLY | os.O_NONBLOCK | os.O_NOCTTY
            with suppress(OSError):
                descriptor = os.open(f'/proc/self/fd/{number}', flags)
                os.dup2(descriptor, number)
                os.close(descriptor)


def spin(executor: Executor, node: Node, stop: Stop, watchdog: Watchdog) -> None:
    """Spin until asked to stop; an error in a callback is logged, and the node goes on."""
    # A collection takes 18 ms if it looks through the modules, which live until the end.
    gc.collect()
    gc.freeze()
    while not stop.requested and node.context.ok():
        watchdog.turns += 1
        try:
            executor.spin_once(timeout_sec=_MAX_WAIT)
        except ExternalShutdownException:
            return
        except Exception as error:
            node.get_logger().error(
                f'{type(error).__name__} in a callback: {error}', throttle_duration_sec=1.0
            )
