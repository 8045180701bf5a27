# SPDX-License-Identifier: Apache-2.0
"""From command line to clean exit: what every node's process does."""

from __future__ import annotations

import gc
import os
import stat
import sys
from collections.abc import Callable
from collections.abc import Sequence
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
from obbhbb_ros.nodes.last_run import RunRecord
from obbhbb_ros.nodes.stop import RUNNING
from obbhbb_ros.nodes.stop import STARTING
from obbhbb_ros.nodes.stop import Stop
from obbhbb_ros.nodes.watchdog import Watchdog

_LONGEST_WAIT = 1.0


class StartError(RuntimeError):
    """A node cannot start; the text says why."""


_REASONS = (ParameterException, StartError, ValueError, OSError)


def run(make_node: Callable[[], Node], stop: Stop, args: Sequence[str] | None = None) -> int:
    """
    Run a node until SIGINT, SIGTERM or a shutdown.

    Parameters
    ----------
    make_node : callable
        Makes the node; may raise `StartError`, ValueError, OSError or ParameterException.
    stop : Stop
        Receives SIGINT and SIGTERM.
    args : sequence of str, optional
        Command line, `sys.argv` by default.

    Returns
    -------
    int
        Exit code: 0 after SIGINT, SIGTERM or a shutdown of the context, 1 if the node cannot
        start.
    """
    stop.patience = STARTING
    never_wait_to_log()
    try:
        rclpy.init(args=args, signal_handler_options=SignalHandlerOptions.NO)
    except RuntimeError as error:
        # What stands behind --ros-args cannot be used.
        print(f'cannot start: {error}', file=sys.stderr)
        return 1
    try:
        node = make_node()
    except _REASONS as error:
        rclpy.try_shutdown()
        print(f'cannot start: {error}', file=sys.stderr)
        return 1
    # The player has none.
    record: RunRecord = getattr(node, 'record', None) or RunRecord()
    stop.on_leaving = record.end
    stop.patience = RUNNING
    try:
        _live(node, stop)
    except BaseException as error:
        record.end(f'{type(error).__name__}: {error}')
        raise
    record.end(stop.name or 'shutdown', asked=True)
    return 0


def _live(node: Node, stop: Stop) -> None:
    """Spin a node until asked to stop, then destroy it."""
    executor = executor_for(node)
    watchdog: Watchdog = getattr(node, 'watchdog', None) or Watchdog()
    stop.wake_by(executor.wake)
    try:
        spin(executor, node, stop, watchdog)
    finally:
        watchdog.stop()
        stop.wake_by(None)
        executor.shutdown()
        node.destroy_node()
        rclpy.try_shutdown()


def never_wait_to_log() -> None:
    """
    Have standard output and error lose what they cannot take, instead of waiting for a reader.

    A pipe that nobody reads any more fills up, and the next line would stop the node for good. The
    lines are on /rosout and in the log file all the same.
    """
    for number, stream in ((1, sys.stdout), (2, sys.stderr)):
        # Closed at start: the number is that of another file by now. And a file has no reader to
        # wait for.
        mode = stat.S_IFREG if stream is None else os.fstat(number).st_mode
        if stat.S_ISSOCK(mode):
            # journald's for one; it cannot be opened anew.
            os.set_blocking(number, False)
        elif stat.S_ISFIFO(mode) or stat.S_ISCHR(mode):
            # Opened anew: the flag belongs to an open file, and this one is others' too.
            flags = os.O_WRONLY | os.O_NONBLOCK | os.O_NOCTTY
            with suppress(OSError):
                ours = os.open(f'/proc/self/fd/{number}', flags)
                os.dup2(ours, number)
                os.close(ours)


def executor_for(node: Node) -> Executor:
    """Make an executor for a node: `ExpressExecutor`, or rclpy's own if that cannot be made."""
    try:
        executor: Executor = ExpressExecutor(context=node.context)
    except UnknownRclpyError as error:
        node.get_logger().warning(f'{error}: using its own executor, which is slower')
        executor = SingleThreadedExecutor(context=node.context)
    executor.add_node(node)
    return executor


def spin(executor: Executor, node: Node, stop: Stop, watchdog: Watchdog) -> None:
    """Spin until asked to stop; errors in callbacks are logged and survived."""
    # What lives by now lives to the end: a collection that looks through all of it takes 18 ms.
    gc.collect()
    gc.freeze()
    while not stop.requested and node.context.ok():
        watchdog.turns += 1
        try:
            # The stock executor does not return when it is only woken, and the watchdog has to tell
            # an idle one from a stuck one.
            executor.spin_once(timeout_sec=_LONGEST_WAIT)
        except ExternalShutdownException:
            return
        except Exception as error:
            node.get_logger().error(
                f'{type(error).__name__} in a callback: {error}', throttle_duration_sec=1.0
            )
