# SPDX-License-Identifier: Apache-2.0
"""The base of the managed nodes: lifecycle, topics, parameters, diagnostics."""

from __future__ import annotations

from typing import Any
from typing import Generic

from rclpy.lifecycle import LifecycleNode
from rclpy.lifecycle import LifecycleState
from rclpy.lifecycle import TransitionCallbackReturn

from obbhbb_ros.errors import StartError
from obbhbb_ros.nodes.lifecycle import internals
from obbhbb_ros.nodes.lifecycle.given_parameters import report_unknown
from obbhbb_ros.nodes.lifecycle.live_parameters import LiveParameters
from obbhbb_ros.nodes.lifecycle.monitor import Monitor
from obbhbb_ros.nodes.lifecycle.node_topics import NodeTopics
from obbhbb_ros.nodes.lifecycle.parts import Part
from obbhbb_ros.nodes.lifecycle.reporter import Reporter
from obbhbb_ros.settings.common import AUTOSTART
from obbhbb_ros.settings.parameters import ParameterTable
from obbhbb_ros.settings.parameters import SettingsT


class ManagedNode(LifecycleNode, Part, Generic[SettingsT]):
    """
    Base of the managed nodes.

    A node is made of parts, and is itself the last of them. In its `__init__` it adds its inputs
    and outputs to `topics`, further parts to `parts`, and what it reports to `reporter`. What else
    it does in a transition stands in the methods that it overrides from `Part`.

    Parameters
    ----------
    name : str
        Default name of the node.
    table : ParameterTable
        Its parameters, `AUTOSTART` among them.
    rates : tuple of str
        Counters whose rate is reported as well; the first one counts the input.
    **kwargs
        Passed to `rclpy.lifecycle.LifecycleNode`.

    Attributes
    ----------
    parameters : LiveParameters
        The parameters in force.
    monitor : Monitor
        Counters and latencies.
    reporter : Reporter
        Diagnostics and warnings.
    topics : NodeTopics
        Inputs and outputs.
    parts : list of Part
        The parts besides the node itself.

    Raises
    ------
    ValueError, rclpy.exceptions.ParameterException
        If the parameters given at start cannot be used.
    """

    def __init__(
        self, name: str, table: ParameterTable[SettingsT], rates: tuple[str, ...], **kwargs: Any
    ) -> None:
        super().__init__(name, **kwargs)
        self.parameters = LiveParameters[SettingsT](self, table)
        report_unknown(self, self.parameters.unknown)
        self.monitor = Monitor(rates)
        self.reporter = Reporter(self, self.monitor, self.parameters.notable_values)
        self.topics = NodeTopics(self, self.reporter)
        self.parts: list[Part] = [self.reporter, self.topics]
        self._is_starting = False
        internals.refuse_impossible_transitions(self, self.get_logger().error)

    def worker_sign(self) -> int | None:
        """Return a number that grows as long as the node's thread goes on; None if it has none."""
        return None

    def autostart(self) -> None:
        """
        Configure and activate the node, if the parameter `autostart` is set.

        Raises
        ------
        StartError
            If one of the two fails.
        """
        if not self.get_parameter(AUTOSTART.name).value:
            self.reporter.log_state('unconfigured')
            return
        self._is_starting = True
        transitions = {'configure': self.trigger_configure, 'activate': self.trigger_activate}
        for name, trigger in transitions.items():
            if trigger() != TransitionCallbackReturn.SUCCESS:
                raise StartError(f'{self.get_name()} failed to {name}; the log says why')
        self._is_starting = False

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Configure all parts; messages are counted and dropped until activation."""
        try:
            for part in self._all_parts():
                part.configure()
        except Exception as error:
            self.get_logger().fatal(f'cannot configure: {type(error).__name__}: {error}')
            self._release_parts()
            return TransitionCallbackReturn.FAILURE
        if not self._is_starting:
            self.reporter.log_state('inactive')
        return super().on_configure(state)

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Start working."""
        for part in self._all_parts():
            part.activate()
        self.get_logger().info(f'active, {self.topics.summary()}')
        return super().on_activate(state)

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Stop working; messages are counted and dropped."""
        for part in self._all_parts():
            part.deactivate()
        self.reporter.log_state('inactive')
        return super().on_deactivate(state)

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Remove all topics but that of the diagnostics."""
        self._release_parts()
        self.reporter.log_state('unconfigured')
        return super().on_cleanup(state)

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Remove all topics but that of the diagnostics, from any state."""
        self._release_parts()
        self.reporter.log_state('finalized')
        return super().on_shutdown(state)

    def on_error(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Remove all topics but that of the diagnostics, and become unconfigured."""
        self.get_logger().error(f'error in state {state.label}, going back to unconfigured')
        self._release_parts()
        return super().on_error(state)

    def _all_parts(self) -> tuple[Part, ...]:
        """Return all parts, the node itself last."""
        return (*self.parts, self)

    def _release_parts(self) -> None:
        """Deactivate all parts, whatever the state, and clean them up."""
        for part in self._all_parts():
            part.deactivate()
        for part in reversed(self._all_parts()):
            part.cleanup()
