# SPDX-License-Identifier: Apache-2.0
"""The topics of a managed node."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from typing import Any

from rclpy.node import Node
from rclpy.qos import DurabilityPolicy
from rclpy.qos import QoSProfile
from rclpy.qos import ReliabilityPolicy

from obbhbb_ros.nodes.lifecycle import internals
from obbhbb_ros.nodes.lifecycle.following import OVERRIDABLE
from obbhbb_ros.nodes.lifecycle.following import FollowingSubscription
from obbhbb_ros.nodes.lifecycle.following import type_name
from obbhbb_ros.nodes.lifecycle.input_advice import advice_on_loss
from obbhbb_ros.nodes.lifecycle.input_advice import advice_on_silence
from obbhbb_ros.nodes.lifecycle.input_advice import advice_on_type
from obbhbb_ros.nodes.lifecycle.input_advice import may_be_meant
from obbhbb_ros.nodes.lifecycle.parts import Part
from obbhbb_ros.nodes.lifecycle.parts import steady_timer
from obbhbb_ros.nodes.lifecycle.reporter import DIAGNOSTICS
from obbhbb_ros.nodes.lifecycle.reporter import Reporter
from obbhbb_ros.wire.buffer import WireError
from obbhbb_ros.wire.layouts import InputType

OVERRIDE_PREFIX = 'qos_overrides.'
_DEPTH = 10
# Seconds between two looks at the publishers of the inputs, and the number of looks before the node
# reports a topic without a publisher.
_LOOK_PERIOD = 1.0
_PATIENCE = 5


def message_type(input_type: InputType) -> Any:
    """
    Return the message class of an input type.

    Raises
    ------
    ModuleNotFoundError
        If the package that defines it is not installed.
    """
    return message_class(input_type.package, input_type.name)


def message_class(package: str, name: str) -> Any:
    """
    Return a message class of a package that may be missing.

    Raises
    ------
    ModuleNotFoundError
        If the package is not installed.
    """
    try:
        return getattr(import_module(f'{package}.msg'), name)
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(
            f'{name} needs the ROS package {package}: install and source it ({error})'
        ) from None


def reliable(depth: int, durability: DurabilityPolicy = DurabilityPolicy.VOLATILE) -> QoSProfile:
    """Return a reliable quality of service."""
    return QoSProfile(depth=depth, reliability=ReliabilityPolicy.RELIABLE, durability=durability)


def create_output(node: Node, kind: Any, topic: str, depth: int) -> Any:
    """Create a reliable publisher, given its message class."""
    return node.create_publisher(kind, topic, reliable(depth), qos_overriding_options=OVERRIDABLE)


@dataclass(eq=False)
class TopicOutput:
    """A topic that a node publishes on; made by `NodeTopics.output`."""

    node: Node
    kind: Any
    topic: str
    depth: int
    _publisher: Any = None

    @property
    def topic_name(self) -> str:
        """Name of the topic after namespace and remaps."""
        return str(self.node.resolve_topic_name(self.topic))

    def open(self) -> None:
        """Create the publisher."""
        self._publisher = create_output(self.node, self.kind, self.topic, self.depth)

    def close(self) -> None:
        """Destroy the publisher, if there is one."""
        self.node.destroy_publisher(self._publisher)
        self._publisher = None

    def publish(self, message: Any) -> None:
        """Publish a message or its bytes, while the topic is open."""
        self._publisher.publish(message)

    def wanted(self) -> bool:
        """Return whether the topic has a subscriber."""
        return self._publisher is not None and self._publisher.get_subscription_count() > 0


@dataclass(eq=False)
class TopicInput:
    """
    A topic that a node subscribes to, for the bytes of its messages; made by `NodeTopics.input`.

    It hears publishers of any quality of service; `qos` is that of the usual one.
    It counts messages that arrive while the node is inactive or that cannot be read, and messages
    that the middleware lost.
    """

    topics: NodeTopics
    kind: Any
    topic: str
    callback: Callable[[bytes], object]
    counter: str
    qos: QoSProfile
    optional: bool = False
    _lonely_looks: int = 0
    _subscription: FollowingSubscription | None = None

    @property
    def topic_name(self) -> str:
        """Name of the topic after namespace and remaps."""
        return str(self.topics.node.resolve_topic_name(self.topic))

    @property
    def is_open(self) -> bool:
        """Whether the node is subscribed."""
        return self._subscription is not None

    def open(self) -> None:
        """Subscribe."""
        self._subscription = FollowingSubscription(
            self.topics.node,
            message_type(self.kind) if isinstance(self.kind, InputType) else self.kind,
            self.topic,
            self.qos,
            self._receive_when_active if self.counter else self._receive,
            {'message_lost': self._on_message_lost},
        )

    @property
    def type_name(self) -> str:
        """Name of the message type, without its package."""
        return self.kind.name if isinstance(self.kind, InputType) else str(self.kind.__name__)

    def close(self) -> None:
        """Unsubscribe, if subscribed."""
        if self._subscription is not None:
            self._subscription.destroy()
        self._subscription, self._lonely_looks = None, 0

    def has_publisher(self) -> bool:
        """Return whether the topic has a publisher that matches."""
        return self._subscription is not None and self._subscription.publisher_count() > 0

    def look(self) -> None:
        """Follow the publishers of the topic, and report what keeps messages from the node."""
        if self._subscription is None:
            return
        publishers = self._subscription.publishers()
        self._subscription.follow(publishers)
        self._report_other_types({publisher.topic_type for publisher in publishers})
        self._report_loneliness(bool(publishers))
        for name, reason in self._subscription.unheard(publishers).items():
            self.topics.reporter.warn(
                f'unheard {name} on {self.topic_name}',
                f'no messages from {name} on {self.topic_name}, incompatible QoS: {reason}; '
                f'see {OVERRIDE_PREFIX}{self.topic_name}.subscription',
            )

    @property
    def is_lonely(self) -> bool:
        """Whether nobody has published on the topic for some time, though the node needs it."""
        return self._lonely_looks >= _PATIENCE

    def _report_other_types(self, types: set[str]) -> None:
        """Report that the topic carries messages of other types alone."""
        if self._subscription is None or not types or type_name(self._subscription.kind) in types:
            return
        # Of the types of detections, the parameter `input_type` decides on the topic alone.
        kind = self.kind
        by_parameter = kind if isinstance(kind, InputType) and kind.topic == self.topic else None
        for carried in sorted(types):
            plain = carried.rpartition('/')[2]
            advice = advice_on_type(self.topic_name, by_parameter, self.type_name, plain)
            self.topics.reporter.warn(
                f'{carried} on {self.topic_name}',
                f'{self.topic_name} carries {carried.replace("/msg/", "/")}, this node reads '
                f'{self.type_name}: {advice}',
            )

    def _report_loneliness(self, has_publisher: bool) -> None:
        """Say once that nobody publishes on a topic that the node needs while it is active."""
        if has_publisher or self.optional or not self.topics.is_active:
            self._lonely_looks = 0
            return
        self._lonely_looks += 1
        if self._lonely_looks == _PATIENCE:
            advice = advice_on_silence(self.topic_name, self._carriers())
            self.topics.node.get_logger().warning(
                f'nobody publishes on {self.topic_name} ({self.type_name}){advice}'
            )

    def _carriers(self) -> dict[str, str]:
        """Return other topics that have a publisher and may be meant, and their types."""
        node, own = self.topics.node, self.topics.published()
        kinds = (
            {self.type_name, 'Image', 'CompressedImage'}
            if 'Image' in self.type_name
            else {self.type_name}
        )
        return {
            name: plain
            for name, types in node.get_topic_names_and_types()
            for plain in (carried.rpartition('/')[2] for carried in types)
            if plain in kinds
            and name not in own
            and may_be_meant(self.topic, name)
            and node.get_publishers_info_by_topic(name)
        }

    def _receive_when_active(self, data: bytes) -> None:
        """Count a message, and handle it if the node is active."""
        counts = self.topics.reporter.monitor.counts
        counts[self.counter] += 1
        if self.topics.is_active:
            self._receive(data)
        else:
            counts['messages_while_inactive'] += 1

    def _receive(self, data: bytes) -> None:
        """Handle a message; count and report it if it cannot be read."""
        try:
            self.callback(data)
        except WireError as error:
            self.topics.reporter.monitor.add('messages_unreadable')
            self.topics.reporter.warn(
                'unreadable message',
                f'dropped a message of {len(data)} bytes on {self.topic_name}, it cannot be '
                f'read as {self.type_name}: {error}',
            )

    def _on_message_lost(self, status: Any) -> None:
        """Count messages that the middleware lost, and say how to avoid it."""
        self.topics.reporter.monitor.add('messages_lost', status.total_count_change)
        subscription, topic = self._subscription, self.topic_name
        if subscription is None:
            return
        advice = advice_on_loss(
            topic,
            subscription.qos.depth,
            subscription.qos.reliability == ReliabilityPolicy.RELIABLE,
            subscription.has_fixed_reliability,
            subscription.largest,
        )
        self.topics.reporter.warn(
            f'messages lost on {topic}',
            f'the middleware lost {status.total_count_change} messages on {topic}, '
            f'{status.total_count} in all: {advice}',
        )


class NodeTopics(Part):
    """
    The inputs and outputs of a node, open from `configure` to `cleanup`.

    Parameters
    ----------
    node : Node
        The node.
    reporter : Reporter
        Counts messages and receives warnings.

    Attributes
    ----------
    is_active : bool
        Whether the node is active.
    """

    def __init__(self, node: Node, reporter: Reporter) -> None:
        self.node, self.reporter, self.is_active = node, reporter, False
        reporter.add_notes(self.notes)
        self._topics: list[TopicOutput | TopicInput] = []
        self._on_demand: list[TopicInput] = []
        self._timer: Any = None

    def output(self, kind: Any, topic: str, depth: int = _DEPTH) -> TopicOutput:
        """Add a topic to publish on, given its message class."""
        output = TopicOutput(self.node, kind, topic, depth)
        self._topics.append(output)
        return output

    def input(
        self,
        kind: Any,
        topic: str,
        callback: Callable[[bytes], object],
        counter: str = '',
        qos: QoSProfile | None = None,
        on_demand: bool = False,
        optional: bool | None = None,
    ) -> TopicInput:
        """
        Add a topic to subscribe to.

        If several inputs have messages, they are served in the order in which they were added.

        Parameters
        ----------
        kind : type or InputType
            The message class, or an input type whose package is imported by `configure`.
        topic : str
            The topic.
        callback : callable
            Handles the bytes of a message; may raise WireError.
        counter : str
            Counts the messages. They are handled only while the node is active; without a counter,
            always.
        qos : QoSProfile, optional
            Quality of service of the usual publisher; by default reliable.
        on_demand : bool
            Whether the node itself opens the input, instead of `configure`.
        optional : bool
            Whether the node works without it; by default if it has no counter.

        Returns
        -------
        TopicInput
            The topic.
        """
        if optional is None:
            optional = not counter
        added = TopicInput(self, kind, topic, callback, counter, qos or reliable(_DEPTH), optional)
        (self._on_demand if on_demand else self._topics).append(added)
        return added

    def published(self) -> list[str]:
        """List the topics that the node publishes, by their full names."""
        return [topic.topic_name for topic in self._topics if isinstance(topic, TopicOutput)]

    def summary(self) -> str:
        """Say what the node listens to and what it publishes."""
        listens = ', '.join(f'{topic.topic_name} ({topic.type_name})' for topic in self._inputs())
        publishes = ', '.join([*self.published(), DIAGNOSTICS])
        return f'listens to {listens}; publishes {publishes}'

    def notes(self) -> list[str]:
        """Say what the node waits for."""
        lonely = [topic.topic_name for topic in self._inputs() if topic.is_lonely]
        return [f'nobody publishes on {", ".join(lonely)}'] if lonely else []

    def configure(self) -> None:
        """Create publishers and subscriptions."""
        for topic in self._topics:
            topic.open()
        self._warn_of_unused_overrides()
        self._timer = steady_timer(self.node, _LOOK_PERIOD, self._look)

    def activate(self) -> None:
        """Hand messages to the node."""
        self.is_active = True

    def deactivate(self) -> None:
        """Count messages and drop them."""
        self.is_active = False

    def cleanup(self) -> None:
        """Destroy subscriptions and publishers."""
        self.node.destroy_timer(self._timer)
        for topic in (*self._on_demand, *reversed(self._topics)):
            topic.close()

    def _look(self) -> None:
        """Look at the publishers of all inputs."""
        for topic in self._inputs():
            topic.look()

    def _inputs(self) -> list[TopicInput]:
        """List all inputs."""
        topics = (*self._topics, *self._on_demand)
        return [topic for topic in topics if isinstance(topic, TopicInput)]

    def _warn_of_unused_overrides(self) -> None:
        """Warn of QoS overrides that match no topic, or no policy that can be overridden."""
        # rclpy declares their parameters when the input is opened.
        later = tuple(f'{OVERRIDE_PREFIX}{topic.topic_name}.' for topic in self._on_demand)
        unused = [
            name
            for name in sorted(internals.parameters_given(self.node))
            if name.startswith(OVERRIDE_PREFIX)
            and not name.startswith(later)
            and not self.node.has_parameter(name)
        ]
        if unused:
            self.node.get_logger().warning(
                'ignored, no such topic (after namespace and remaps) or policy: '
                + ', '.join(unused)
            )
