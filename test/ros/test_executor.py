# SPDX-License-Identifier: Apache-2.0
"""The express executor beside the stock one: both keep the contract of an executor."""

from __future__ import annotations

import threading
import time
import traceback
from collections.abc import Callable
from collections.abc import Iterator
from typing import Any

import pytest
from harness import Site
from rcl_interfaces.srv import GetParameters
from rclpy.context import Context
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.executors import Executor
from rclpy.executors import ExternalShutdownException
from rclpy.executors import SingleThreadedExecutor
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.qos import QoSProfile
from rclpy.task import Future
from std_msgs.msg import Bool

from obbhbb_ros.nodes.running import process
from obbhbb_ros.nodes.running.executor import ExpressExecutor
from obbhbb_ros.nodes.running.executor import UnknownRclpyError

# These tests depend on rclpy alone, which is the same in all environments.
pytestmark = pytest.mark.once

DEEP = QoSProfile(depth=100)
SECONDS = 20.0


class Busy(Node):
    """A node with two raw subscriptions."""

    def __init__(self, name: str, **kwargs: Any) -> None:
        super().__init__(name, **kwargs)
        self.heard: list[str] = []
        self.raw_subscriptions = [
            self.create_subscription(
                Bool, topic, lambda _, topic=topic: self.heard.append(topic), DEEP, raw=True
            )
            for topic in ('first', 'second')
        ]


class Scene:
    """An executor with a busy node, to which other nodes may be added."""

    def __init__(self, kind: type[Executor], site: Site) -> None:
        self._context = site.context
        self.executor = kind(context=site.context)
        self._nodes: list[Node] = []
        self.node = self.add(Busy)

    def add(self, kind: type[Node] = Node) -> Any:
        name = f'executor_test_{id(self)}_{len(self._nodes)}'
        node = kind(name, namespace=f'/executor_{id(self)}', context=self._context)
        self.executor.add_node(node)
        self._nodes.append(node)
        return node

    def publishers(self) -> list[Any]:
        """Return publishers of both topics, of a node that the executor does not run."""
        node = Node('peer', namespace=self.node.get_namespace(), context=self._context)
        self._nodes.append(node)
        made = [node.create_publisher(Bool, topic, DEEP) for topic in ('first', 'second')]
        self.spin_until(lambda: all(publisher.get_subscription_count() for publisher in made))
        return made

    def spin_until(self, condition: Callable[[], Any]) -> None:
        deadline = time.monotonic() + SECONDS
        while not condition():
            assert time.monotonic() < deadline, 'waited in vain'
            self.executor.spin_once(timeout_sec=0.1)

    def settle(self) -> None:
        """Handle all that is ready, even on a slow machine."""
        for _ in range(20):
            self.executor.spin_once(timeout_sec=0.01)

    def spin_for(self, seconds: float) -> None:
        spin(self.executor, seconds)

    def close(self) -> None:
        self.executor.shutdown()
        for node in self._nodes:
            node.destroy_node()


def spin(executor: Executor, seconds: float) -> None:
    deadline = time.monotonic() + seconds
    while (left := deadline - time.monotonic()) > 0.0:
        executor.spin_once(timeout_sec=left)


@pytest.fixture(params=[SingleThreadedExecutor, ExpressExecutor], ids=['stock', 'express'])
def scene(request: pytest.FixtureRequest, site: Site) -> Iterator[Scene]:
    scene = Scene(request.param, site)
    yield scene
    scene.close()


def test_every_trigger_of_a_guard_condition_is_answered(scene: Scene) -> None:
    calls: list[int] = []
    guard = scene.node.create_guard_condition(lambda: calls.append(1))
    for count in range(1, 6):
        guard.trigger()
        scene.spin_until(lambda count=count: len(calls) == count)


def test_a_guard_condition_of_another_node_is_answered(scene: Scene) -> None:
    calls: list[int] = []
    scene.spin_for(0.2)
    guard = scene.add().create_guard_condition(lambda: calls.append(1))
    scene.spin_for(0.1)
    guard.trigger()
    scene.spin_until(lambda: calls)


def test_the_timers_of_all_nodes_run_at_their_pace(scene: Scene) -> None:
    calls = {'first': 0, 'second': 0}

    def count(name: str) -> None:
        calls[name] += 1

    scene.node.create_timer(0.05, lambda: count('first'))
    other = scene.add()
    other.create_timer(0.05, lambda: count('second'))
    started = time.monotonic()
    scene.spin_until(lambda: min(calls.values()) > 15)
    assert max(calls.values()) <= (time.monotonic() - started) / 0.05 + 2
    scene.executor.remove_node(other)
    scene.spin_for(0.1)
    before = dict(calls)
    scene.spin_until(lambda: calls['first'] > before['first'] + 5)
    assert calls['second'] == before['second']


def test_events_reach_their_callbacks(scene: Scene) -> None:
    matched: list[Any] = []
    scene.spin_for(0.2)
    scene.node.create_subscription(
        Bool,
        'third',
        print,
        DEEP,
        event_callbacks=SubscriptionEventCallbacks(matched=matched.append),
    )
    scene.spin_for(0.1)
    publisher = scene.node.create_publisher(Bool, 'third', DEEP)
    scene.spin_until(lambda: matched)
    assert matched[0].current_count == 1
    scene.node.destroy_publisher(publisher)
    scene.spin_until(lambda: len(matched) > 1)


def test_services_are_answered_while_messages_stream_in(scene: Scene) -> None:
    first, _ = scene.publishers()
    scene.node.create_timer(0.001, lambda: first.publish(Bool()))
    client = scene.add().create_client(GetParameters, f'{scene.node.get_name()}/get_parameters')
    scene.spin_until(client.service_is_ready)
    scene.executor.remove_node(scene.node)
    scene.executor.add_node(scene.node)
    for _ in range(5):
        future = client.call_async(GetParameters.Request(names=['use_sim_time']))
        scene.spin_until(future.done)
        assert len(future.result().values) == 1
    assert scene.node.heard


def test_no_subscription_waits_for_another_to_run_dry(scene: Scene) -> None:
    publishers = scene.publishers()
    for _ in range(20):
        for publisher in publishers:
            publisher.publish(Bool())
    # A stall: all of it has arrived by now.
    time.sleep(0.5)
    scene.spin_until(lambda: len(scene.node.heard) == 40)
    for i in range(0, 40, 2):
        assert set(scene.node.heard[i : i + 2]) == {'first', 'second'}


def test_entities_created_or_destroyed_meanwhile_are_noticed(scene: Scene) -> None:
    first, second = scene.publishers()
    calls: list[int] = []
    timer = scene.node.create_timer(0.01, lambda: calls.append(1))
    scene.spin_until(lambda: len(calls) > 2)
    scene.node.destroy_timer(timer)
    scene.node.destroy_subscription(scene.node.raw_subscriptions.pop())
    scene.spin_for(0.1)
    count = len(calls)
    first.publish(Bool())
    second.publish(Bool())
    scene.spin_until(lambda: scene.node.heard)
    scene.spin_for(0.2)
    assert scene.node.heard == ['first']
    assert len(calls) == count


def test_a_callback_may_destroy_or_cancel_what_is_due_beside_it(scene: Scene) -> None:
    first, second = scene.publishers()
    calls: list[str] = []
    timers: list[Any] = []

    def destroy_the_others() -> None:
        calls.append('first')
        timers[0].cancel()
        timers[1].cancel()
        scene.node.destroy_timer(timers[2])
        scene.node.destroy_subscription(scene.node.raw_subscriptions[1])

    for callback in (destroy_the_others, lambda: calls.append('other'), lambda: 1 / 0):
        timers.append(scene.node.create_timer(0.3, callback))
    # All are due at once, and there are messages.
    time.sleep(0.5)
    first.publish(Bool())
    scene.spin_until(lambda: calls)
    second.publish(Bool())
    first.publish(Bool())
    scene.spin_until(lambda: scene.node.heard.count('first') == 2)
    scene.spin_for(0.4)
    assert calls == ['first']
    assert scene.node.heard == ['first', 'first']


def test_tasks_run_and_coroutines_continue_when_their_futures_are_done(scene: Scene) -> None:
    first, _ = scene.publishers()
    done: list[str] = []
    scene.spin_for(0.2)
    for name in ('one', 'two'):
        scene.executor.create_task(lambda name=name: done.append(name))
    scene.spin_until(lambda: sorted(done) == ['one', 'two'])
    future: Future = Future()

    async def wait() -> None:
        done.append(await future)

    scene.executor.create_task(wait)
    scene.spin_for(0.1)
    scene.node.create_timer(0.1, lambda: future.done() or future.set_result('three'))
    first.publish(Bool())
    scene.spin_until(lambda: 'three' in done)
    assert scene.node.heard


def test_an_error_in_a_callback_reaches_the_caller_and_loses_nothing(scene: Scene) -> None:
    first, second = scene.publishers()
    scene.node.heard.clear()
    # The attribute is public, and read by both executors.
    scene.node.raw_subscriptions[0].callback = lambda _: 1 / 0
    first.publish(Bool())
    second.publish(Bool())
    time.sleep(0.2)
    with pytest.raises(ZeroDivisionError):
        scene.spin_until(lambda: False)
    scene.spin_until(lambda: scene.node.heard == ['second'])


def test_a_wait_ends_with_its_time(scene: Scene) -> None:
    scene.spin_for(0.3)
    started = time.monotonic()
    scene.executor.spin_once(timeout_sec=0.2)
    assert time.monotonic() - started < 5.0


def test_the_end_of_the_context_ends_a_wait(scene: Scene) -> None:
    context = Context()
    context.init()
    executor = type(scene.executor)(context=context)
    executor.add_node(Busy('short_lived', context=context))
    ending = threading.Timer(0.5, context.try_shutdown)
    ending.start()
    with pytest.raises(ExternalShutdownException):
        spin(executor, SECONDS)
    ending.join()
    executor.shutdown()


def test_a_wake_returns_from_a_wait_at_once(site: Site) -> None:
    scene = Scene(ExpressExecutor, site)
    scene.spin_for(0.3)
    started = time.monotonic()
    scene.executor.wake()
    scene.executor.spin_once(timeout_sec=10.0)
    assert time.monotonic() - started < 5.0
    scene.close()


def test_messages_and_timers_bypass_rclpy_only_where_that_is_allowed(site: Site) -> None:
    scene = Scene(ExpressExecutor, site)
    first, _ = scene.publishers()
    callers: list[str] = []
    # The attribute is public, and read by both executors.
    scene.node.raw_subscriptions[0].callback = lambda _: callers.extend(
        frame.filename for frame in traceback.extract_stack()
    )

    ticks: list[str] = []
    scene.node.create_timer(
        0.1, lambda: ticks.extend(frame.filename for frame in traceback.extract_stack())
    )

    def bypasses_rclpy() -> bool:
        scene.settle()
        # The first tick after a change is rclpy's in any case.
        ticks.clear()
        scene.spin_until(lambda: ticks)
        ticks.clear()
        callers.clear()
        first.publish(Bool())
        scene.spin_until(lambda: callers)
        scene.spin_until(lambda: ticks)
        by_rclpy = {
            any(name.endswith('rclpy/task.py') for name in each) for each in (callers, ticks)
        }
        assert len(by_rclpy) == 1
        return by_rclpy == {False}

    assert bypasses_rclpy()
    guard = scene.node.create_guard_condition(print)
    assert not bypasses_rclpy()
    scene.node.destroy_guard_condition(guard)
    assert bypasses_rclpy()
    other = scene.add()
    assert not bypasses_rclpy()
    scene.executor.remove_node(other)
    assert bypasses_rclpy()
    scene.close()


def test_another_rclpy_gets_its_own_executor_and_a_warning(
    site: Site, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delattr(rclpy_implementation.WaitSet, 'get_ready_entities')
    with pytest.raises(UnknownRclpyError, match=r'WaitSet\.get_ready_entities'):
        ExpressExecutor(context=site.context)
    node = Busy('other_release', context=site.context)
    warnings: list[str] = []
    monkeypatch.setattr(node, 'get_logger', lambda: Logger(warnings))
    executor = process.executor_for(node)
    assert type(executor) is SingleThreadedExecutor
    assert executor.get_nodes() == [node]
    assert 'WaitSet.get_ready_entities' in warnings[0]
    executor.shutdown()
    node.destroy_node()


class Logger:
    """Keeps warnings."""

    def __init__(self, warnings: list[str]) -> None:
        self.warning = warnings.append
