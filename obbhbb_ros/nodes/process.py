# SPDX-License-Identifier: Apache-2.0
"""From command line to clean exit: what the process of a node, or of several, does."""

from __future__ import annotations

import gc
import os
import stat
import sys
import threading
from collections import Counter
from collections.abc import Callable
from collections.abc import Mapping
from collections.abc import Sequence
from concurrent.futures import FIRST_COMPLETED
from concurrent.futures import ThreadPoolExecutor
from concurrent.futures import wait
from contextlib import suppress

import rclpy
from rclpy.exceptions import ParameterException
from rclpy.executors import Executor
from rclpy.executors import ExternalShutdownException
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions

from obbhbb_ros.errors import StartError
from obbhbb_ros.nodes.executor import ExpressExecutor
from obbhbb_ros.nodes.executor import UnknownRclpyError
from obbhbb_ros.nodes.failure import REASONS
from obbhbb_ros.nodes.failure import cannot_start
from obbhbb_ros.nodes.given_parameters import warn_of_unused_files
from obbhbb_ros.nodes.stop import RUNNING
from obbhbb_ros.nodes.stop import STARTING
from obbhbb_ros.nodes.stop import Stop
from obbhbb_ros.nodes.supervision import Supervision
from obbhbb_ros.nodes.watchdog import Turns

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
    makers: Mapping[str, Callable[[], Node]],
    stop: Stop,
    make_executor: Callable[[Node], Executor] = executor_for,
) -> int:
    """
    Run nodes until SIGINT, SIGTERM or a shutdown of their context.

    Parameters
    ----------
    makers : mapping of str to callable
        Makes the node of each executable; may raise ParameterException, or what `failure.REASONS`
        lists.
    stop : Stop
        Receives SIGINT and SIGTERM.
    make_executor : callable, optional
        Makes the executor of a node.

    Returns
    -------
    int
        Exit code: 0 after SIGINT, SIGTERM or a shutdown, 1 if a node cannot start.
    """
    stop.patience = STARTING
    never_wait_to_log()
    try:
        rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    except REASONS as error:
        # The arguments after --ros-args cannot be used.
        return cannot_start(error)
    try:
        nodes = _made(makers)
        warn_of_unused_files(nodes)
        supervision = Supervision(nodes)
        supervision.start_nodes()
    except (ParameterException, *REASONS) as error:
        rclpy.try_shutdown()
        return cannot_start(error)
    stop.on_leaving = supervision.end
    stop.patience = RUNNING
    try:
        _run_to_the_end([make_executor(node) for node in nodes], nodes, stop, supervision)
    except BaseException as error:
        supervision.end(f'{type(error).__name__}: {error}')
        raise
    supervision.end(stop.name or 'shutdown', asked=True)
    return 0


def _made(makers: Mapping[str, Callable[[], Node]]) -> list[Node]:
    """Make the nodes of a process; an error says of which of several."""
    nodes: list[Node] = []
    for executable, make_node in makers.items():
        try:
            nodes.append(make_node())
        except (ParameterException, *REASONS) as error:
            if len(makers) == 1:
                raise
            raise StartError(f'{executable}: {error or type(error).__name__}') from error
    names = Counter(node.get_fully_qualified_name() for node in nodes)
    if twice := [name for name, count in names.items() if count > 1]:
        raise StartError(
            f'several nodes are named {twice[0]}: rename one, with -r obb_to_hbb:__node:=...'
        )
    return nodes


def _run_to_the_end(
    executors: Sequence[Executor], nodes: Sequence[Node], stop: Stop, supervision: Supervision
) -> None:
    """Spin nodes until asked to stop, then destroy them."""

    def wake_all() -> None:
        for executor in executors:
            executor.wake()

    stop.wake_by(wake_all)
    try:
        spin_all(executors, nodes, stop, supervision.turns)
    finally:
        supervision.watchdog.stop()
        stop.wake_by(lambda: None)
        for executor, node in zip(executors, nodes, strict=True):
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


def spin_all(
    executors: Sequence[Executor], nodes: Sequence[Node], stop: Stop, turns: Sequence[Turns]
) -> None:
    """Spin every node, several in a thread each, until one of them ends; then all end."""
    # A collection takes 18 ms if it looks through the modules, which live until the end.
    gc.collect()
    gc.freeze()
    jobs = list(zip(executors, nodes, turns, strict=True))
    if len(jobs) == 1:
        spin(*jobs[0], stop)
        return
    with ThreadPoolExecutor(len(jobs), 'spin') as threads:
        ends = [threads.submit(spin, *job, stop) for job in jobs]
        wait(ends, return_when=FIRST_COMPLETED)
        rclpy.try_shutdown()
    for end in ends:
        end.result()


def spin(executor: Executor, node: Node, turns: Turns, stop: Stop) -> None:
    """Spin a node until asked to stop; an error in a callback is logged, and the node goes on."""
    turns.thread = threading.get_ident()
    while not stop.requested and node.context.ok():
        turns.count += 1
        try:
            executor.spin_once(timeout_sec=_MAX_WAIT)
        except ExternalShutdownException:
            return
        except Exception as error:
            node.get_logger().error(
                f'{type(error).__name__} in a callback: {error}', throttle_duration_sec=1.0
            )
