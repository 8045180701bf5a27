# SPDX-License-Identifier: Apache-2.0
"""The parameters of a running node, declared and checked by its table."""

from __future__ import annotations

import math
from array import array
from collections.abc import Callable
from collections.abc import Mapping
from collections.abc import Sequence
from typing import Any
from typing import Generic

from rcl_interfaces.msg import FloatingPointRange
from rcl_interfaces.msg import IntegerRange
from rcl_interfaces.msg import ParameterDescriptor
from rcl_interfaces.msg import SetParametersResult
from rclpy.node import Node
from rclpy.parameter import Parameter as RosParameter

from obbhbb_ros.limits import Choices
from obbhbb_ros.limits import Range
from obbhbb_ros.nodes.lifecycle import internals
from obbhbb_ros.nodes.lifecycle.parameter_requests import ParameterRequests
from obbhbb_ros.settings.common import LOCK
from obbhbb_ros.settings.parameter_file import Values
from obbhbb_ros.settings.parameters import Parameter
from obbhbb_ros.settings.parameters import ParameterTable
from obbhbb_ros.settings.parameters import SettingsT


def descriptor(parameter: Parameter) -> ParameterDescriptor:
    """Describe a parameter to ROS tools."""
    limits = parameter.limits
    text = parameter.meaning
    if isinstance(limits, Choices):
        text += f' One of: {", ".join(map(repr, limits.words))}.'
    described = ParameterDescriptor(
        name=parameter.name, description=text, read_only=parameter.read_only
    )
    if isinstance(limits, Range) and math.isinf(limits.high):
        # rqt_reconfigure shows no parameter from the first infinite range on.
        described.description += f' Range: {limits}.'
    elif isinstance(limits, Range):
        kind = float if isinstance(parameter.default, float) else int
        message = FloatingPointRange if kind is float else IntegerRange
        ranges = described.floating_point_range if kind is float else described.integer_range
        # Of another type, a bound would become garbage in the message.
        ranges.append(message(from_value=kind(limits.low), to_value=kind(limits.high)))
    return described


def _plain(value: Any) -> Any:
    """Return a parameter's value as a plain type; a service sends a list of numbers as an array."""
    return value.tolist() if isinstance(value, array) else value


_TYPES = {
    'double': RosParameter.Type.DOUBLE,
    'double[]': RosParameter.Type.DOUBLE_ARRAY,
    'string[]': RosParameter.Type.STRING_ARRAY,
}


def _adapted(given: RosParameter, row: Parameter) -> RosParameter:
    """Return a parameter as its row has it; ValueError if it is a list of another type."""
    value = _plain(given.value)
    adapted = row.adapted(value)
    if isinstance(adapted, list):
        row.check(adapted)
    if adapted is value:
        return given
    return RosParameter(given.name, _TYPES[row.type_name], adapted)


class LiveParameters(Generic[SettingsT]):
    """
    The parameters of a node, and the settings made of them.

    The parameters of a class are declared while the class is in `class_ids`, and always if one of
    them was set at start.

    Parameters
    ----------
    node : Node
        The node.
    table : ParameterTable
        Its parameters.

    Attributes
    ----------
    settings : SettingsT
        The settings in force.
    on_change : callable
        Called after every change.
    unknown : list of str
        Names of the values set at start that are no parameters of the node.

    Raises
    ------
    ValueError
        If the values set at start do not fit together.
    rclpy.exceptions.ParameterException
        If one of them has the wrong type or is out of range.
    """

    def __init__(self, node: Node, table: ParameterTable[SettingsT]) -> None:
        overrides = internals.parameters_given(node)
        self._node = node
        self._table = table
        self.on_change: Callable[[], object] = lambda: None
        self._classes_at_start = table.mentioned_classes(overrides)
        self._declared: dict[str, Parameter] = {}
        self._declare_with(overrides)
        self._follow_classes()
        values = self.values()
        self._check(values)
        self.settings = table.settings(values)
        self._locked = bool(values.get(LOCK.name, False))
        self.unknown = sorted(name for name in overrides if not node.has_parameter(name))
        node.add_on_set_parameters_callback(self._validate)
        node.add_post_set_parameters_callback(self._apply)
        ParameterRequests(node, self._adapted, self._set)

    def values(self) -> Values:
        """Return all values in force by name."""
        return {name: _plain(self._node.get_parameter(name).value) for name in self._declared}

    def notable_values(self) -> Values:
        """Return the values to report: of the parameters of a class only those that were set."""
        always = self._table.parameters()
        return {
            name: value
            for name, value in self.values().items()
            if name in always or value != self._declared[name].default
        }

    def _declare_with(self, overrides: Mapping[str, RosParameter]) -> None:
        """Declare the parameters of the table, with the values set at start."""
        rows = self._table.parameters()
        lists = {name for name, row in rows.items() if isinstance(row.default, list)}
        # rclpy knows no type for an empty list, and cannot declare it.
        empty = [name for name in lists & overrides.keys() if overrides[name].value is None]
        for name in lists & overrides.keys() - {*empty}:
            rows[name].check(_plain(overrides[name].value))
        for name in empty:
            internals.forget_given(self._node, name)
        self._declare(rows)
        self._node.set_parameters([RosParameter(n, _TYPES[rows[n].type_name], []) for n in empty])

    def _adapted(self, change: RosParameter) -> RosParameter:
        """Return a change with the type that the table has for it."""
        row = self._declared.get(change.name)
        return change if row is None else _adapted(change, row)

    def _set(self, changes: Sequence[RosParameter]) -> SetParametersResult:
        """Set parameters as a whole, among them those of classes that are new in `class_ids`."""
        proposed = {change.name: _plain(change.value) for change in changes}
        if 'class_ids' not in self._declared.keys() & proposed.keys():
            return self._set_declared(changes)
        self._declare_classes(self._table.class_ids(proposed))
        try:
            return self._set_declared(changes)
        finally:
            self._follow_classes()

    def _set_declared(self, changes: Sequence[RosParameter]) -> SetParametersResult:
        """Set parameters as a whole; name those that do not exist."""
        unknown = [change.name for change in changes if not self._node.has_parameter(change.name)]
        if unknown:
            # rclpy does not name them.
            reason = f'no such parameters: {", ".join(unknown)}'
            return SetParametersResult(successful=False, reason=reason)
        return self._node.set_parameters_atomically(list(changes))

    def _check(self, values: Values) -> None:
        """Check values, also of classes that are not in `class_ids`."""
        for name, value in values.items():
            self._declared[name].check(value)

    def _declare_classes(self, class_ids: Sequence[str]) -> None:
        """Declare the parameters of classes, where they are not."""
        wanted = self._table.parameters(class_ids)
        self._declare({name: wanted[name] for name in wanted if name not in self._declared})

    def _declare(self, parameters: Mapping[str, Parameter]) -> None:
        """Declare parameters; rclpy takes their values from those set at start."""
        rows = [(row.name, row.default, descriptor(row)) for row in parameters.values()]
        self._node.declare_parameters('', rows)
        self._declared.update(parameters)

    def _follow_classes(self) -> None:
        """Declare the parameters of the classes in `class_ids`, and undeclare those of others."""
        class_ids = [*self._classes_at_start, *self._table.class_ids(self.values())]
        wanted = self._table.parameters(class_ids)
        for name in self._declared.keys() - wanted.keys():
            del self._declared[name]
            self._node.undeclare_parameter(name)
        self._declare_classes(class_ids)

    def _proposed(self, changes: Sequence[RosParameter]) -> SettingsT:
        """Make settings of the values in force and some changes."""
        changed = {
            change.name: _plain(change.value) for change in changes if change.name in self._declared
        }
        self._check(changed)
        return self._table.settings({**self.values(), **changed})

    def _validate(self, changes: Sequence[RosParameter]) -> SetParametersResult:
        """Accept or reject a set of changes as a whole; change nothing yet."""
        if not any(self._node.has_parameter(change.name) for change in changes):
            # This class or rclpy is declaring them.
            return SetParametersResult(successful=True)
        if self._locked:
            return SetParametersResult(
                successful=False,
                reason=f'parameters are locked: the node was started with {LOCK.name}',
            )
        try:
            self._proposed(changes)
        except ValueError as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def _apply(self, changes: Sequence[RosParameter]) -> None:
        """Apply an accepted set as a whole."""
        if not any(change.name in self._declared for change in changes):
            # Not in the table, or of a class that is being declared.
            return
        self.settings = self._proposed(changes)
        if any(change.name == 'class_ids' for change in changes):
            self._follow_classes()
        self.on_change()
