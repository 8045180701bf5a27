# SPDX-License-Identifier: Apache-2.0
"""Subscriptions hear publishers of any quality of service, whoever comes first."""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import rclpy
from harness import Node
from harness import Site
from rclpy.context import Context
from rclpy.qos import DurabilityPolicy
from rclpy.qos import QoSProfile
from rclpy.qos import ReliabilityPolicy
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import CameraInfo
from sensor_msgs.msg import CompressedImage
from sensor_msgs.msg import Image
from std_msgs.msg import Bool
from std_msgs.msg import Int32
from vision_msgs.msg import Detection2DArray

from obbhbb_ros.nodes.lifecycle.following import FollowingSubscription
from obbhbb_ros.nodes.lifecycle.following import quality_to_hear
from obbhbb_ros.nodes.running.executor import ExpressExecutor

# These tests depend on rclpy alone, which is the same in all environments.
pytestmark = pytest.mark.once

RELIABLE, BEST_EFFORT = ReliabilityPolicy.RELIABLE, ReliabilityPolicy.BEST_EFFORT
LATCHED, VOLATILE = DurabilityPolicy.TRANSIENT_LOCAL, DurabilityPolicy.VOLATILE
QUALITIES = list(itertools.product((RELIABLE, BEST_EFFORT), (LATCHED, VOLATILE)))
USUAL = (RELIABLE, VOLATILE)
SECONDS = 30.0

Quality = tuple[ReliabilityPolicy, DurabilityPolicy]

_numbers = itertools.count()


def profile(quality: Quality, depth: int = 10) -> QoSProfile:
    return QoSProfile(depth=depth, reliability=quality[0], durability=quality[1])


def name_of(quality: Any) -> str:
    return ' '.join(policy.name.lower() for policy in quality)


class Listener:
    """A subscription to a topic that looks at its publishers, and publishers in another context."""

    def __init__(self, near: Context, far: Context, parameters: dict[str, str]) -> None:
        number = next(_numbers)
        self.topic = f'/followed_{number}'
        overrides = [
            rclpy.Parameter(f'qos_overrides.{self.topic}.subscription.{policy}', value=value)
            for policy, value in parameters.items()
        ]
        self.node = rclpy.create_node(
            f'listener_{number}', context=near, parameter_overrides=overrides
        )
        self.talker = rclpy.create_node(f'talker_{number}', context=far)
        self._executor = ExpressExecutor(context=near)
        self._executor.add_node(self.node)
        self.heard: list[int] = []
        self.made: list[QoSProfile] = []

    def subscribe(self, usual: Quality = USUAL, look: bool = True, depth: int = 10) -> None:
        self.subscription = FollowingSubscription(
            self.node, Int32, self.topic, profile(usual, depth), self._receive, {}
        )
        if look:
            self.node.create_timer(1.0, self.look)

    def look(self) -> None:
        self.subscription.follow(self.subscription.publishers())

    def _receive(self, data: bytes) -> None:
        self.heard.append(deserialize_message(data, Int32).data)

    @property
    def quality(self) -> Quality:
        return self.subscription.qos.reliability, self.subscription.qos.durability

    def publisher(self, quality: Quality) -> Any:
        return self.talker.create_publisher(Int32, self.topic, profile(quality))

    def spin(self, seconds: float) -> None:
        deadline = time.monotonic() + seconds
        while (left := deadline - time.monotonic()) > 0.0:
            self._executor.spin_once(timeout_sec=left)

    def spin_until(self, condition: Callable[[], Any]) -> None:
        deadline = time.monotonic() + SECONDS
        while not condition():
            assert time.monotonic() < deadline, (self.heard, self.subscription.qos)
            self._executor.spin_once(timeout_sec=0.05)

    def settle(self, *publishers: Any) -> None:
        """Wait until no old subscription is left, and publishers are connected."""
        self.spin_until(lambda: len(list(self.node.subscriptions)) == 1)
        for publisher in publishers:
            self.spin_until(publisher.get_subscription_count)
        self.spin_until(lambda: self.subscription.publisher_count() >= len(publishers))

    def close(self) -> None:
        self._executor.shutdown()
        self.node.destroy_node()
        self.talker.destroy_node()


@pytest.fixture(scope='module')
def other_context(site: Site) -> Iterator[Context]:
    context = Context()
    rclpy.init(context=context)
    yield context
    rclpy.try_shutdown(context=context)


@pytest.fixture
def listen(site: Site, other_context: Context) -> Iterator[Callable[..., Listener]]:
    made: list[Listener] = []

    def make(**parameters: str) -> Listener:
        made.append(Listener(site.context, other_context, parameters))
        return made[-1]

    yield make
    for listener in made:
        listener.close()


def test_the_quality_is_the_best_that_all_publishers_offer() -> None:
    for one, other in itertools.product(QUALITIES, repeat=2):
        quality = quality_to_hear([profile(one), profile(other)])
        assert (quality[0] == RELIABLE) == (one[0] == other[0] == RELIABLE)
        assert (quality[1] == LATCHED) == (one[1] == other[1] == LATCHED)


@pytest.mark.parametrize('usual', [USUAL, (RELIABLE, LATCHED)], ids=name_of)
@pytest.mark.parametrize('comes_first', [True, False], ids=['before', 'after'])
@pytest.mark.parametrize('quality', QUALITIES, ids=name_of)
def test_a_publisher_of_any_quality_is_heard(
    listen: Callable[..., Listener], quality: Quality, comes_first: bool, usual: Quality
) -> None:
    listener = listen()
    if not comes_first:
        listener.subscribe(usual)
        listener.spin(0.2)
    publisher = listener.publisher(quality)
    publisher.publish(Int32(data=0))
    if comes_first:
        listener.subscribe(usual)
    listener.spin_until(lambda: listener.quality == quality)
    listener.settle(publisher)
    for number in (1, 2, 3):
        publisher.publish(Int32(data=number))
    listener.spin_until(lambda: 3 in listener.heard)
    # The last message of a latched topic is heard, and no message twice.
    assert listener.heard == ([0, 1, 2, 3] if 0 in listener.heard else [1, 2, 3])
    assert 0 in listener.heard or quality != (RELIABLE, LATCHED)


@pytest.mark.parametrize('comes_first', [True, False], ids=['before', 'after'])
@pytest.mark.parametrize(('one', 'other'), list(itertools.combinations(QUALITIES, 2)))
def test_two_publishers_of_different_quality_are_both_heard(
    listen: Callable[..., Listener], one: Quality, other: Quality, comes_first: bool
) -> None:
    listener = listen()
    first = listener.publisher(one)
    if not comes_first:
        listener.subscribe()
        listener.spin(0.2)
    second = listener.publisher(other)
    if comes_first:
        listener.subscribe()
    expected = quality_to_hear([profile(one), profile(other)])
    listener.spin_until(lambda: listener.quality == expected)
    listener.settle(first, second)
    for number in range(1, 5):
        (first if number % 2 else second).publish(Int32(data=number))
    listener.spin_until(lambda: len(listener.heard) >= 4)
    assert sorted(listener.heard) == [1, 2, 3, 4]
    # The better one remains.
    best = max(one, other, key=lambda quality: (quality[0] == RELIABLE, quality[1] == LATCHED))
    leaving, staying = (second, first) if best == one else (first, second)
    listener.talker.destroy_publisher(leaving)
    listener.spin_until(lambda: listener.quality == best)
    listener.settle(staying)
    staying.publish(Int32(data=5))
    listener.spin_until(lambda: 5 in listener.heard)
    assert sorted(listener.heard) == [1, 2, 3, 4, 5]


def test_the_history_of_a_latched_topic_does_not_come_twice(
    listen: Callable[..., Listener],
) -> None:
    listener = listen()
    listener.subscribe(look=False)
    publisher = listener.publisher((RELIABLE, LATCHED))
    listener.spin_until(publisher.get_subscription_count)
    for _ in range(3):
        publisher.publish(Int32(data=7))
    listener.spin_until(lambda: len(listener.heard) == 3)
    listener.look()
    assert listener.quality == (RELIABLE, LATCHED)
    listener.spin(0.5)
    publisher.publish(Int32(data=7))
    listener.spin_until(lambda: len(listener.heard) > 3)
    listener.spin(0.3)
    assert listener.heard == [7] * 4


@pytest.mark.parametrize(
    'companion', [q for q in QUALITIES if q != (RELIABLE, LATCHED)], ids=name_of
)
def test_nothing_is_lost_while_the_subscription_changes_at_100_hz(
    listen: Callable[..., Listener], companion: Quality
) -> None:
    listener = listen()
    listener.subscribe(depth=100)
    publisher = listener.publisher((RELIABLE, LATCHED))
    listener.spin_until(publisher.get_subscription_count)
    sent, changes, second, quality = 0, 0, None, listener.quality
    while sent < 800:
        if sent % 400 == 100:
            second = listener.publisher(companion)
        if sent % 400 == 300:
            listener.talker.destroy_publisher(second)
        sent += 1
        publisher.publish(Int32(data=sent))
        listener.spin(0.01)
        changes, quality = changes + (quality != listener.quality), listener.quality
    listener.spin_until(lambda: sent in listener.heard)
    assert changes >= 3
    assert listener.heard == list(range(1, sent + 1))


def test_a_changed_subscription_is_served_in_its_place(listen: Callable[..., Listener]) -> None:
    listener = listen()
    listener.subscribe()
    other = f'{listener.topic}_2'
    listener.node.create_subscription(Int32, other, print, 10, raw=True)
    listener.publisher((BEST_EFFORT, VOLATILE))
    listener.spin_until(lambda: listener.quality == (BEST_EFFORT, VOLATILE))
    listener.spin_until(lambda: len(list(listener.node.subscriptions)) == 2)
    assert [s.topic_name for s in listener.node.subscriptions] == [listener.topic, other]


def test_an_override_wins(listen: Callable[..., Listener]) -> None:
    listener = listen(durability='volatile', depth=3)
    publisher = listener.publisher((RELIABLE, LATCHED))
    listener.subscribe((RELIABLE, LATCHED))
    other = listener.publisher((BEST_EFFORT, LATCHED))
    listener.spin_until(lambda: listener.quality == (BEST_EFFORT, VOLATILE))
    listener.settle()
    listener.talker.destroy_publisher(other)
    listener.spin_until(lambda: listener.quality == (RELIABLE, VOLATILE))
    assert listener.subscription.qos.depth == 3
    listener.talker.destroy_publisher(publisher)


def test_a_publisher_that_an_override_excludes_is_named(listen: Callable[..., Listener]) -> None:
    listener = listen(reliability='reliable')
    listener.subscribe()
    listener.publisher((BEST_EFFORT, VOLATILE))
    unheard: dict[str, str] = {}

    def is_named() -> bool:
        unheard.update(listener.subscription.unheard(listener.subscription.publishers()))
        return f'/{listener.talker.get_name()}' in unheard

    listener.spin_until(is_named)
    assert all('reliable' in reason for reason in unheard.values())


ANY = QoSProfile(depth=10, reliability=BEST_EFFORT)
PLANS = {'crop_regions': Detection2DArray, 'image': Image}
INPUTS = {
    'obb_to_hbb': {'detections': Detection2DArray, 'camera_info': CameraInfo},
    'chip_extractor': {**PLANS, 'camera_info': CameraInfo, 'crop_sources': Detection2DArray},
    'overlay': {**PLANS, 'detections': Detection2DArray, 'boxes': Detection2DArray},
    'downlink': {'contact': Bool},
}


@pytest.mark.parametrize('executable', INPUTS)
def test_every_input_of_every_node_follows_its_publishers(
    site: Site, tmp_path: Path, executable: str
) -> None:
    parameters = {'spool.path': tmp_path / 'spool', 'outbox.path': tmp_path / 'outbox'}
    with Node(site, executable) as node:
        node.start(parameters=parameters if executable in ('chip_extractor', 'downlink') else {})
        # Without them, the nodes do not read their inputs.
        boxes = node.peer.collect(Detection2DArray, 'boxes')
        pictures = node.peer.collect(CompressedImage, 'overlay/compressed')
        for topic, kind in INPUTS[executable].items():
            # Returns when the node hears it.
            publisher = node.peer.publisher(kind, topic, ANY)
            node.send_until(
                lambda publisher=publisher: publisher.publish(b'\0\1\0\0'),
                lambda topic=topic: any(
                    'cannot be read' in line and f'/{topic}' in line
                    for line in node.process.log.splitlines()
                ),
                f'{topic} to be heard',
            )
        assert not boxes
        assert not pictures
