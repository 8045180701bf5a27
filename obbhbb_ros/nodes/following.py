# SPDX-License-Identifier: Apache-2.0
"""A subscription whose quality of service follows the publishers of its topic."""

from __future__ import annotations

import time
from collections.abc import Callable
from collections.abc import Iterable
from collections.abc import Mapping
from copy import copy
from typing import Any

from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy
from rclpy.qos import QoSCompatibility
from rclpy.qos import QoSPolicyKind
from rclpy.qos import QoSProfile
from rclpy.qos import ReliabilityPolicy
from rclpy.qos import qos_check_compatible
from rclpy.qos_overriding_options import QoSOverridingOptions

from obbhbb_ros.nodes import internals

OVERRIDABLE = QoSOverridingOptions(
    (
        QoSPolicyKind.HISTORY,
        QoSPolicyKind.DEPTH,
        QoSPolicyKind.RELIABILITY,
        QoSPolicyKind.DURABILITY,
    )
)
"""The policies that `qos_overrides` changes."""

# Seconds in which publishers discover a new subscription, before the one that it replaces is
# destroyed; and seconds after which it is destroyed even if publishers of its own are missing.
_OVERLAP = 1.0
_MAX_OVERLAP = 5.0
# This many messages can be recognised when a latched topic repeats them.
_REMEMBERED = 1000


def quality_to_hear(offered: Iterable[QoSProfile]) -> tuple[ReliabilityPolicy, DurabilityPolicy]:
    """
    Return the best quality of service that is heard by all publishers of a topic.

    Parameters
    ----------
    offered : iterable of QoSProfile
        What the publishers offer; at least one.

    Returns
    -------
    reliability : ReliabilityPolicy
        Reliable if all publishers are.
    durability : DurabilityPolicy
        Transient local (latched) if all publishers are.
    """
    profiles = list(offered)
    is_reliable = all(p.reliability == ReliabilityPolicy.RELIABLE for p in profiles)
    is_latched = all(p.durability == DurabilityPolicy.TRANSIENT_LOCAL for p in profiles)
    return (
        ReliabilityPolicy.RELIABLE if is_reliable else ReliabilityPolicy.BEST_EFFORT,
        DurabilityPolicy.TRANSIENT_LOCAL if is_latched else DurabilityPolicy.VOLATILE,
    )


class FollowingSubscription:
    """
    A raw subscription whose reliability and durability follow the publishers of its topic.

    A subscription cannot change. So a new one is made beside it, and the old one is destroyed when
    the publishers have discovered the new one. No message that one of the two receives is lost, and
    none is handed over twice: each is known by its time and number at its publisher.

    rclpy's `BEST_AVAILABLE` is resolved once, when a subscription is made. It is the value of the
    parameters `qos_overrides.<topic>.subscription.reliability` and `.durability`; with any other
    value the policy is fixed.

    Parameters
    ----------
    node : Node
        The node.
    kind : type
        The message class.
    topic : str
        The topic.
    usual : QoSProfile
        What the usual publisher offers, before any is known.
    callback : callable
        Handles the bytes of a message.
    events : dict
        Callbacks of events, as in `SubscriptionEventCallbacks`, besides `incompatible_qos`.

    Attributes
    ----------
    kind : type
        The message class.
    qos : QoSProfile
        The quality of service now.
    largest : int
        Size of the largest message that has arrived, bytes.
    """

    def __init__(
        self,
        node: Node,
        kind: Any,
        topic: str,
        usual: QoSProfile,
        callback: Callable[[bytes], object],
        events: Mapping[str, Callable[[Any], object]],
    ) -> None:
        self.kind = kind
        self._node, self._topic, self._callback = node, topic, callback
        self._events = {**events, 'incompatible_qos': self._on_incompatible}
        self._heard: dict[tuple[int, int], None] = {}
        self._retiring: Any = None
        asked = copy(usual)
        asked.reliability = ReliabilityPolicy.BEST_AVAILABLE
        asked.durability = DurabilityPolicy.BEST_AVAILABLE
        self._asked = internals.overridden_subscription(
            node, node.resolve_topic_name(topic), asked, OVERRIDABLE
        )
        self.qos = self._profile(usual.reliability, usual.durability)
        self.qos = self._wanted(self.publishers())
        self.largest = 0
        self._made, self._subscription = time.monotonic(), self._make()

    @property
    def has_fixed_reliability(self) -> bool:
        """Whether an override decides on the reliability."""
        return bool(self._asked.reliability != ReliabilityPolicy.BEST_AVAILABLE)

    def publishers(self) -> list[Any]:
        """List the publishers of the topic, of any type."""
        # Not the resolved name, which rclpy would remap again.
        return list(self._node.get_publishers_info_by_topic(self._topic))

    def publisher_count(self) -> int:
        """Return the number of publishers that are heard."""
        counts = [s.get_publisher_count() for s in (self._retiring, self._subscription) if s]
        return int(max(counts, default=0))

    def unheard(self, publishers: Iterable[Any]) -> dict[str, str]:
        """Return which publishers an override excludes, by their nodes, and why."""
        checks = {
            node_of(publisher): qos_check_compatible(publisher.qos_profile, self.qos)
            for publisher in publishers
            if self._is_of_kind(publisher)
        }
        return {
            name: reason.removeprefix('ERROR: ').rstrip(';')
            for name, (compatibility, reason) in checks.items()
            if compatibility == QoSCompatibility.ERROR
        }

    def follow(self, publishers: Iterable[Any]) -> None:
        """Follow the publishers of the topic."""
        if self._retiring is not None:
            self._retire_if_replaced()
        wanted = self._wanted(publishers)
        if self._retiring is None and wanted != self.qos:
            self.qos, self._retiring = wanted, self._subscription
            self._retiring.callback = self._hand_over
            self._made, self._subscription = time.monotonic(), self._make()
            # The executor serves inputs in the order in which the node lists them.
            internals.put_before(self._node, self._subscription, self._retiring)

    def destroy(self) -> None:
        """Unsubscribe."""
        for subscription in (self._retiring, self._subscription):
            self._node.destroy_subscription(subscription)
        self._retiring = self._subscription = None

    def _on_incompatible(self, _: Any) -> None:
        """Follow a publisher that is not heard, without waiting for the next look."""
        if self._subscription is not None:
            self.follow(self.publishers())

    def _is_of_kind(self, publisher: Any) -> bool:
        """Return whether a publisher sends messages of the type that is read."""
        return bool(publisher.topic_type == type_name(self.kind))

    def _wanted(self, publishers: Iterable[Any]) -> QoSProfile:
        """Return the profile for these publishers; the present one if there are none."""
        offered = [p.qos_profile for p in publishers if self._is_of_kind(p)]
        return self._profile(*quality_to_hear(offered)) if offered else self.qos

    def _profile(self, reliability: ReliabilityPolicy, durability: DurabilityPolicy) -> QoSProfile:
        """Return a profile; an override wins."""
        profile = copy(self._asked)
        if profile.reliability == ReliabilityPolicy.BEST_AVAILABLE:
            profile.reliability = reliability
        if profile.durability == DurabilityPolicy.BEST_AVAILABLE:
            profile.durability = durability
        return profile

    def _make(self) -> Any:
        """Subscribe."""
        return self._node.create_subscription(
            self.kind,
            self._topic,
            self._receive,
            self.qos,
            raw=True,
            event_callbacks=SubscriptionEventCallbacks(**self._events),
        )

    def _retire_if_replaced(self) -> None:
        """Destroy the old subscription when the publishers know the new one."""
        age = time.monotonic() - self._made
        counts = [s.get_publisher_count() for s in (self._retiring, self._subscription)]
        if age >= (_OVERLAP if counts[0] <= counts[1] else _MAX_OVERLAP):
            self._drain()
            self._node.destroy_subscription(self._retiring)
            self._retiring = None

    def _drain(self) -> None:
        """Hand over what waits in the old subscription, which was sent before the rest."""
        while (taken := internals.take(self._retiring)) is not None:
            self._hand_over(*taken)

    def _receive(self, data: bytes, info: Mapping[str, int]) -> None:
        """Hand over a message of the new subscription."""
        if self._retiring is not None:
            self._drain()
        self._hand_over(data, info)

    def _hand_over(self, data: bytes, info: Mapping[str, int]) -> None:
        """Hand over a message, unless it was handed over before."""
        heard, key = self._heard, (info['source_timestamp'], info['publication_sequence_number'])
        if key in heard:
            return
        # A middleware that does not tell the time cannot tell messages apart.
        if key[0]:
            heard[key] = None
            if len(heard) > _REMEMBERED:
                del heard[next(iter(heard))]
        self.largest = max(self.largest, len(data))
        self._callback(data)


def type_name(kind: Any) -> str:
    """Return the name of a message class, for example `std_msgs/msg/Bool`."""
    package, folder, *_ = kind.__module__.split('.')
    return f'{package}/{folder}/{kind.__name__}'


def node_of(endpoint: Any) -> str:
    """Return the full name of the node of a publisher, as far as it is known yet."""
    if 'UNKNOWN' in endpoint.node_name:
        return 'an unknown node'
    return f'{endpoint.node_namespace.rstrip("/")}/{endpoint.node_name}'
