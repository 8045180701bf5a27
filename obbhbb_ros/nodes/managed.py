# SPDX-License-Identifier: Apache-2.0
"""What the managed nodes have in common: life cycle, topics, diagnostics, warnings."""

from __future__ import annotations

import time
from abc import ABC
from abc import abstractmethod
from collections.abc import Callable
from collections.abc import Mapping
from collections.abc import Sequence
from importlib import import_module
from typing import Any
from typing import Generic

from diagnostic_msgs.msg import DiagnosticArray
from rclpy.clock import Clock
from rclpy.clock import ClockType
from rclpy.event_handler import PublisherEventCallbacks
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.lifecycle import LifecycleNode
from rclpy.lifecycle import LifecycleState
from rclpy.lifecycle import TransitionCallbackReturn
from rclpy.qos import DurabilityPolicy
from rclpy.qos import QoSProfile
from rclpy.qos import ReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions

from obbhbb_ros.nodes import internals
from obbhbb_ros.nodes.last_run import RunRecord
from obbhbb_ros.nodes.live_parameters import LiveParameters
from obbhbb_ros.nodes.monitor import PERIOD
from obbhbb_ros.nodes.monitor import Monitor
from obbhbb_ros.nodes.process import StartError
from obbhbb_ros.nodes.watchdog import Watchdog
from obbhbb_ros.settings.common import AUTOSTART
from obbhbb_ros.settings.common import INPUT_TIMEOUT
from obbhbb_ros.settings.common import STATE_PATH
from obbhbb_ros.settings.common import WATCHDOG
from obbhbb_ros.settings.parameters import ParameterTable
from obbhbb_ros.settings.parameters import SettingsT
from obbhbb_ros.wire.layouts import InputType

_DEPTH = 10
_WARN_PERIOD = 5.0
_OVERRIDES = 'qos_overrides.'
# Not that of `use_sim_time`, which may stand still or run back.
_STEADY = Clock(clock_type=ClockType.STEADY_TIME)
# Who subscribes to the diagnostics has to discover a node that is back before it hears of it.
_RESTART_REPORTS = 10


def message_type(input_type: InputType) -> Any:
    """
    Return the message class of an input type.

    Raises
    ------
    ModuleNotFoundError
        If the package that defines it is not installed.
    """
    try:
        return getattr(import_module(f'{input_type.package}.msg'), input_type.name)
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(
            f'{input_type.name} needs the ROS package {input_type.package}: install and source it '
            f'({error})'
        ) from None


class ManagedNode(LifecycleNode, ABC, Generic[SettingsT]):
    """
    Base of the managed nodes.

    A node creates its topics in `_create_topics` and drops its collected data in `_forget`;
    it calls `_autostart` at the end of its own `__init__`.

    Attributes
    ----------
    record : RunRecord
        What this run leaves to the next one.
    watchdog : Watchdog
        Notices a callback that does not return; runs from here on.

    Parameters
    ----------
    name : str
        Default name of the node.
    table : ParameterTable
        Its parameters, `AUTOSTART` among them.
    rates : tuple of str
        Counters whose rate is in the diagnostics as well.
    **kwargs
        Passed to `rclpy.lifecycle.LifecycleNode`.

    Raises
    ------
    ValueError, rclpy.exceptions.ParameterException
        If the parameters given at start cannot be used.
    """

    def __init__(
        self, name: str, table: ParameterTable[SettingsT], rates: tuple[str, ...], **kwargs: Any
    ) -> None:
        super().__init__(name, **kwargs)
        self._parameters_in_force = LiveParameters[SettingsT](
            self, table, internals.parameters_given(self)
        )
        self._warn_of_unknown_parameters()
        self._monitor = Monitor(self, rates)
        self._active = False
        self._is_silent = False
        self._silent_until: dict[str, float] = {}
        self._outputs: list[Any] = []
        self._inputs: list[Any] = []
        self._diagnostics_publisher: Any = None
        self._timer: Any = None
        self.record = RunRecord(
            self.get_parameter(STATE_PATH.name).value,
            self.get_fully_qualified_name(),
            self._monitor.counts,
            lambda text: self._warn(text, text),
        )
        self.watchdog = Watchdog(
            self.get_parameter(WATCHDOG.name).value, self.record, self.get_logger().fatal
        )
        if self.record.is_kept:
            # As long as the node lives, in every state.
            self._every(PERIOD, lambda: self.record.note(internals.state_label(self)))
        self._restart_reports = 0
        self._tell_of_last_run()
        internals.refuse_impossible_transitions(self, self.get_logger().error)

    @abstractmethod
    def _create_topics(self) -> None:
        """Create publishers by `_output` and subscriptions by `_input`."""

    def _late_topics(self) -> Sequence[str]:
        """List the topics that are not there from the beginning."""
        return ()

    def _forget(self) -> None:
        """Drop what was collected from the topics."""

    def _facts(self) -> dict[str, str]:
        """Return what the diagnostics report besides counters."""
        return {}

    def _autostart(self) -> None:
        """
        Go to the active state without a lifecycle manager, if `autostart` is set.

        From here on the run counts as one.

        Raises
        ------
        StartError
            If the node cannot be configured or activated.
        """
        if self.get_parameter(AUTOSTART.name).value:
            for name, transition in (
                ('configure', self.trigger_configure),
                ('activate', self.trigger_activate),
            ):
                if transition() != TransitionCallbackReturn.SUCCESS:
                    raise StartError(f'{self.get_name()} failed to {name}; the log says why')
        # One that cannot start leaves what the run before it left.
        self.record.note(internals.state_label(self))

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Create the topics; messages are ignored until activation."""
        try:
            self._create_topics()
            self._warn_of_unused_overrides()
            self._diagnostics_publisher = self.create_publisher(DiagnosticArray, '/diagnostics', 1)
            self._timer = self._every(PERIOD, self._publish_diagnostics)
        except Exception as error:
            self.get_logger().fatal(f'cannot configure: {type(error).__name__}: {error}')
            self._release()
            return TransitionCallbackReturn.FAILURE
        return super().on_configure(state)

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Start working."""
        self._active = True
        self._monitor.expect_input()
        return super().on_activate(state)

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Stop working; incoming messages are counted and dropped."""
        self._active = False
        self._forget()
        return super().on_deactivate(state)

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Remove every topic."""
        self._release()
        return super().on_cleanup(state)

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Remove every topic, from any state."""
        self._active = False
        self._release()
        return super().on_shutdown(state)

    def on_error(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Remove every topic and be unconfigured again."""
        self.get_logger().error(f'error in state {state.label}, going back to unconfigured')
        self._active = False
        self._release()
        return super().on_error(state)

    def _every(self, period: float, callback: Callable[[], object]) -> Any:
        """Create a timer that goes on while a simulated clock stands still."""
        return self.create_timer(period, callback, clock=_STEADY)

    def _output(
        self,
        message_type: Any,
        topic: str,
        depth: int = _DEPTH,
        on_matched: Callable[[Any], None] | None = None,
    ) -> Any:
        """
        Create a publisher that is silent while the node is not active.

        `on_matched` is called whenever a subscriber comes or goes.
        """
        publisher = self.create_lifecycle_publisher(
            message_type,
            topic,
            QoSProfile(depth=depth, reliability=ReliabilityPolicy.RELIABLE),
            event_callbacks=PublisherEventCallbacks(matched=on_matched),
            qos_overriding_options=QoSOverridingOptions.with_default_policies(),
        )
        self._outputs.append(publisher)
        return publisher

    def _input(
        self,
        message_type: Any,
        topic: str,
        callback: Callable[[bytes], None],
        reliability: ReliabilityPolicy = ReliabilityPolicy.BEST_EFFORT,
        depth: int = _DEPTH,
        durability: DurabilityPolicy = DurabilityPolicy.VOLATILE,
    ) -> Any:
        """Subscribe to the bytes of messages, by default from publishers of any reliability."""
        subscription: Any = self.create_subscription(
            message_type,
            topic,
            callback,
            QoSProfile(depth=depth, reliability=reliability, durability=durability),
            raw=True,
            event_callbacks=SubscriptionEventCallbacks(
                message_lost=lambda status: self._on_message_lost(subscription, status)
            ),
            qos_overriding_options=QoSOverridingOptions.with_default_policies(),
        )
        self._inputs.append(subscription)
        return subscription

    def _release(self) -> None:
        """Destroy topics and timer."""
        if self._timer is not None:
            self.destroy_timer(self._timer)
        self._release_inputs()
        if self._diagnostics_publisher is not None:
            self.destroy_publisher(self._diagnostics_publisher)
        for publisher in self._outputs:
            self.destroy_lifecycle_publisher(publisher)
        self._outputs = []
        self._diagnostics_publisher = self._timer = None
        self._forget()

    def _release_inputs(self) -> None:
        """Unsubscribe from everything."""
        for subscription in self._inputs:
            self.destroy_subscription(subscription)
        self._inputs = []

    def _on_message_lost(self, subscription: Any, status: Any) -> None:
        """Count messages that the middleware lost, and say how to avoid it."""
        self._monitor.add('messages_lost', status.total_count_change)
        topic = subscription.topic_name
        self._warn(
            f'messages lost on {topic}',
            f'the middleware lost {status.total_count_change} messages on {topic}, '
            f'{status.total_count} in all: messages over 0.5 MB need the DDS profile '
            'config/fastdds_large.xml at both ends, or '
            f'qos_overrides.{topic}.subscription.reliability: reliable',
        )

    def _drop_unreadable(self, data: bytes, subscription: Any, error: Exception) -> None:
        """Count and report a message that cannot be read."""
        self._monitor.add('messages_unreadable')
        self._warn(
            'unreadable message',
            f'dropped a message of {len(data)} bytes on {subscription.topic_name}, it cannot be '
            f'read as {subscription.msg_type.__name__}: {error}',
        )

    def _warn(self, kind: str, text: str) -> None:
        """Warn in the next diagnostics and in the log, there at most every 5 s for each kind."""
        self._monitor.trouble(text)
        now = time.monotonic()
        if now >= self._silent_until.get(kind, now):
            self._silent_until[kind] = now + _WARN_PERIOD
            self.get_logger().warning(text)

    def _warn_of_unknown_parameters(self) -> None:
        """Warn of parameters that were given and do not exist."""
        unknown = self._parameters_in_force.unknown
        unknown = [name for name in unknown if not name.startswith(_OVERRIDES)]
        if unknown:
            self.get_logger().warning('unknown parameters, ignored: ' + ', '.join(unknown))

    def _warn_of_unused_overrides(self) -> None:
        """Warn of QoS overrides that belong to no topic, or name no policy that can be changed."""
        late = tuple(f'{_OVERRIDES}{topic}.' for topic in self._late_topics())
        unused = [
            name
            for name in self._parameters_in_force.unknown
            if name.startswith(_OVERRIDES)
            and not name.startswith(late)
            and not self.has_parameter(name)
        ]
        if unused:
            self.get_logger().warning(
                'ignored, no such topic (after namespace and remaps) or policy: '
                + ', '.join(unused)
            )

    def _silent_for(self, values: Mapping[str, Any]) -> float:
        """Return the seconds without input if that is too long, else 0; log when it begins."""
        silence, timeout = self._monitor.silence(), values.get(INPUT_TIMEOUT.name, 0.0)
        is_silent = bool(self._active and timeout and silence > timeout)
        if is_silent != self._is_silent:
            self._is_silent = is_silent
            if is_silent:
                self.get_logger().error(f'no input for {silence:.0f} s, see input_timeout')
            elif self._active and timeout:
                self.get_logger().info('no longer without input')
        return silence if is_silent else 0.0

    def _publish_diagnostics(self) -> None:
        """Publish the state, counters and parameters."""
        state = internals.state_label(self)
        values: Mapping[str, Any] = self._parameters_in_force.notable_values()
        if self._restart_reports:
            self._restart_reports -= 1
            self._monitor.remind(self.record.restart)
        facts = {**self._facts(), **self._last_run_facts()}
        report = self._monitor.report(state, values, facts, self._silent_for(values))
        self._diagnostics_publisher.publish(report)

    def _tell_of_last_run(self) -> None:
        """Say in the log that this is a restart, and prepare to say so in the diagnostics."""
        if self.record.restart:
            self._restart_reports = _RESTART_REPORTS
            self.get_logger().warning(self.record.restart)
            if self.record.stacks:
                self.get_logger().warning(f'stacks of the last run:\n{self.record.stacks}')

    def _last_run_facts(self) -> dict[str, str]:
        """Report the run before, if there is a state file."""
        if not self.record.is_kept:
            return {}
        facts = {'restarts': str(self.record.restarts)}
        facts.update({f'last_run.{name}': text for name, text in self.record.last.items()})
        return facts
