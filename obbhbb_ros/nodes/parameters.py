# SPDX-License-Identifier: Apache-2.0
"""
Parameter tables: one row a parameter, and all that follows from a row.

Declaration, descriptors, validation, the shipped YAML and the README table are made from the
same rows. Values are validated as a whole before any is applied: a set that is rejected changes
nothing.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from collections.abc import Iterable
from collections.abc import Mapping
from collections.abc import Sequence
from dataclasses import dataclass
from dataclasses import replace
from typing import Generic
from typing import TypeAlias
from typing import TypeVar

from rcl_interfaces.msg import FloatingPointRange
from rcl_interfaces.msg import IntegerRange
from rcl_interfaces.msg import ParameterDescriptor
from rcl_interfaces.msg import SetParametersResult
from rclpy.node import Node
from rclpy.parameter import Parameter

Value: TypeAlias = bool | int | float | str | list[str]
Values: TypeAlias = dict[str, Value]
SettingsT = TypeVar('SettingsT')


@dataclass(frozen=True)
class ParameterSpec:
    """
    One row of a parameter table.

    Attributes
    ----------
    name : str
        Parameter name; `<id>` in it stands for each class id.
    default : bool, int, float, str or list of str
        Its type is the parameter's type.
    meaning : str
        One sentence with the unit.
    low, high : float, optional
        Bounds of a number, both included.
    choices : tuple of str
        What a string may be; anything where empty.
    read_only : bool
        Whether it can only be given at start.
    """

    name: str
    default: Value
    meaning: str
    low: float | None = None
    high: float | None = None
    choices: tuple[str, ...] = ()
    read_only: bool = False

    @property
    def type_name(self) -> str:
        """Name of the type as ROS documentation has it."""
        if isinstance(self.default, list):
            return 'string[]'
        return {bool: 'bool', int: 'int', float: 'double', str: 'string'}[type(self.default)]

    @property
    def range_text(self) -> str:
        """What values are accepted, for people."""
        if self.choices:
            return ', '.join(f'`{choice}`' if choice else '`""`' for choice in self.choices)
        if self.low is None or self.high is None:
            return ''
        return f'{self.low:.10g} to {self.high:.10g}'

    def descriptor(self) -> ParameterDescriptor:
        """Describe the parameter to ROS tools."""
        meaning = self.meaning
        if self.choices:
            meaning += ' One of: ' + ', '.join(repr(choice) for choice in self.choices) + '.'
        descriptor = ParameterDescriptor(
            name=self.name, description=meaning, read_only=self.read_only
        )
        if self.low is not None and self.high is not None:
            if isinstance(self.default, float):
                # An integer would end up as garbage in the message.
                bounds = FloatingPointRange(
                    from_value=float(self.low), to_value=float(self.high)
                )
                descriptor.floating_point_range.append(bounds)
            else:
                limits = IntegerRange(from_value=int(self.low), to_value=int(self.high))
                descriptor.integer_range.append(limits)
        return descriptor

    def check(self, value: Value) -> None:
        """
        Check one value by itself.

        Raises
        ------
        ValueError
            If it is out of range or none of the choices; the message names the parameter.
        """
        if self.choices and value not in self.choices:
            raise ValueError(f'{self.name} must be one of {self.range_text}, not {value!r}')
        if self.low is None or self.high is None or isinstance(value, (str, list)):
            return
        if math.isnan(value) or not self.low <= value <= self.high:
            raise ValueError(f'{self.name} must be {self.range_text}, not {value}')


LOCK = ParameterSpec(
    'lock_parameters', False,
    'Refuse every change of a parameter after the start. Anyone on the DDS domain can make one.',
    read_only=True,
)
# Each declares five parameters, 0.1 ms each.
MOST_CLASSES = 256
# What Qt's tools take, rqt_reconfigure among them.
INT_LIMIT = 2**31 - 1


class LiveParameters(Generic[SettingsT]):
    """
    A node's parameters, and the settings that they amount to.

    Parameters
    ----------
    node : Node
        Whose parameters they are.
    table : sequence of ParameterSpec
        Rows for parameters that are always there.
    build : callable
        Makes settings of all values by name; raises ValueError where they do not fit together.
    overrides : mapping of str to Parameter
        What was given at start, by YAML or command line.
    per_class : sequence of ParameterSpec
        Rows with `<id>` in their names, declared for each entry of the parameter `class_ids`, for
        as long as it is one, and for each class that `overrides` mentions.

    Raises
    ------
    ValueError
        If the values given at start do not fit together.
    rclpy.exceptions.ParameterException
        If one of them has the wrong type or is out of its range.
    """

    def __init__(
        self,
        node: Node,
        table: Sequence[ParameterSpec],
        build: Callable[[Values], SettingsT],
        overrides: Mapping[str, Parameter],
        per_class: Sequence[ParameterSpec] = (),
    ) -> None:
        self._node = node
        self._build = build
        self._per_class = per_class
        self._fixed = {spec.name: spec for spec in table}
        self._given_classes = _mentioned_classes(overrides, per_class)
        self._specs: dict[str, ParameterSpec] = {}
        self._declare(self._fixed)
        self._follow_classes()
        values = self.values()
        self.settings = build(self._checked(values))
        self._locked = bool(values.get(LOCK.name, False))
        self.unknown = sorted(name for name in overrides if not node.has_parameter(name))
        node.add_on_set_parameters_callback(self._validate)
        node.add_post_set_parameters_callback(self._apply)

    def values(self) -> Values:
        """All values in force, by name."""
        return {name: self._node.get_parameter(name).value for name in self._specs}

    def notable_values(self) -> Values:
        """Give the values worth telling: of parameters of a class only those that were set."""
        return {
            name: value for name, value in self.values().items()
            if name in self._fixed or value != self._specs[name].default
        }

    def _declare(self, specs: Mapping[str, ParameterSpec]) -> None:
        """Declare parameters with what was given for them at start."""
        self._node.declare_parameters(
            '', [(name, spec.default, spec.descriptor()) for name, spec in specs.items()]
        )
        self._specs.update(specs)

    def _follow_classes(self) -> None:
        """Declare the rows of the classes that there are now, and forget those of others."""
        class_ids = [*self._given_classes, *self._class_ids(self.values())]
        wanted = {**self._fixed, **self._class_specs(class_ids)}
        for name in [name for name in self._specs if name not in wanted]:
            del self._specs[name]
            self._node.undeclare_parameter(name)
        self._declare({name: spec for name, spec in wanted.items() if name not in self._specs})

    def _class_specs(self, class_ids: Iterable[str]) -> dict[str, ParameterSpec]:
        """Write a row for each class and each parameter of a class."""
        specs = (
            replace(spec, name=spec.name.replace('<id>', class_id))
            for class_id in class_ids for spec in self._per_class
        )
        return {spec.name: spec for spec in specs}

    def _class_ids(self, values: Values) -> list[str]:
        """
        Read the class list, if this node has one.

        Raises
        ------
        ValueError
            If it is too long.
        """
        class_ids = values.get('class_ids', [])
        found = [c for c in class_ids if c] if isinstance(class_ids, list) else []
        if len(found) > MOST_CLASSES:
            raise ValueError(f'class_ids has {len(found)} classes, the maximum is {MOST_CLASSES}')
        return found

    def _checked(self, values: Values) -> Values:
        """Check each value by itself, those of classes new in the list included."""
        specs = {**self._specs, **self._class_specs(self._class_ids(values))}
        for name, spec in specs.items():
            spec.check(values.setdefault(name, spec.default))
        return values

    def _proposed(self, changes: Sequence[Parameter]) -> Values:
        """Lay proposed changes over the values in force."""
        values = self.values()
        values.update({p.name: p.value for p in changes if p.name in self._specs})
        return values

    def _validate(self, changes: Sequence[Parameter]) -> SetParametersResult:
        """Accept or reject a set of changes as a whole; change nothing yet."""
        if not any(self._node.has_parameter(change.name) for change in changes):
            # They are being declared, by us or by rclpy.
            return SetParametersResult(successful=True)
        if self._locked:
            return SetParametersResult(
                successful=False,
                reason=f'parameters are locked: the node was started with {LOCK.name}',
            )
        try:
            self._build(self._checked(self._proposed(changes)))
        except ValueError as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def _apply(self, changes: Sequence[Parameter]) -> None:
        """Put an accepted set in force, all of it at once."""
        if not any(change.name in self._specs for change in changes):
            # Not of our table, or of a class that is being declared.
            return
        self.settings = self._build(self._checked(self._proposed(changes)))
        if any(change.name == 'class_ids' for change in changes):
            self._follow_classes()


def _mentioned_classes(
    overrides: Mapping[str, Parameter], per_class: Sequence[ParameterSpec]
) -> list[str]:
    """Find the class ids in parameter names given at start."""
    found: dict[str, None] = {}
    for spec in per_class:
        before, _, after = spec.name.partition('<id>')
        for name in overrides:
            if name.startswith(before) and name.endswith(after):
                found.setdefault(name[len(before) : len(name) - len(after)])
    return list(found)
