# SPDX-License-Identifier: Apache-2.0
"""
Parameters as rows of a table, and the settings made of their values.

Declaration, descriptors, validation, the YAML files in `config/` and the tables in `doc/` all
follow from the rows. Values are validated as a whole before any is applied: a set that is rejected
changes nothing.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from collections.abc import Iterable
from collections.abc import Mapping
from dataclasses import dataclass
from dataclasses import fields
from dataclasses import replace
from typing import Any
from typing import Generic
from typing import TypeVar

from obbhbb_ros.settings.parameter_file import Value

SettingsT = TypeVar('SettingsT')

# Nine parameters are declared for each class.
MAX_CLASSES = 256
# The largest integer that Qt's tools take, rqt_reconfigure among them.
MAX_INT = 2**31 - 1
MAX_BYTES = 1e12


@dataclass(frozen=True)
class Parameter:
    """
    One row of a parameter table.

    Attributes
    ----------
    name : str
        Parameter name; `<id>` in it stands for each class id.
    default : bool, int, float, str, or a list of str or float that is not empty
        Its type is the parameter's type.
    meaning : str
        One sentence with the unit.
    low, high : float, optional
        Bounds of a number, both included.
    choices : tuple of str
        Allowed strings; any where empty.
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
        """Name of the type in ROS documentation."""
        if isinstance(self.default, list):
            return 'double[]' if isinstance(self.default[0], float) else 'string[]'
        return {bool: 'bool', int: 'int', float: 'double', str: 'string'}[type(self.default)]

    @property
    def range_text(self) -> str:
        """The accepted values, for people."""
        if self.choices:
            return ', '.join(f'`{choice}`' if choice else '`""`' for choice in self.choices)
        if self.low is None or self.high is None:
            return ''
        return f'{self.low:.10g} to {self.high:.10g}'

    def check(self, value: Value) -> None:
        """
        Check one value.

        Raises
        ------
        ValueError
            If it has another type than the default, is out of range, or is none of the choices;
            the message names the parameter.
        """
        if not self._has_type(value):
            raise ValueError(f'{self.name} must be a {self.type_name}, not {value!r}')
        if self.choices and value not in self.choices:
            raise ValueError(f'{self.name} must be one of {self.range_text}, not {value!r}')
        if self.low is None or self.high is None or isinstance(value, (str, list)):
            return
        if math.isnan(value) or not self.low <= value <= self.high:
            raise ValueError(f'{self.name} must be {self.range_text}, not {value}')

    def _has_type(self, value: Value) -> bool:
        """Tell whether a value has the type of the default, in a list each of its elements."""
        if isinstance(value, list) and isinstance(self.default, list):
            return all(type(each) is type(self.default[0]) for each in value)
        return type(value) is type(self.default)


@dataclass(frozen=True)
class ParameterTable(Generic[SettingsT]):
    """
    The parameters of a node.

    Attributes
    ----------
    rows : tuple of Parameter
        Parameters that are always there.
    build : callable
        Makes settings of all values by name; raises ValueError where they do not fit together.
    class_rows : tuple of Parameter
        Parameters of each class in `class_ids`, with `<id>` in their names.
    """

    rows: tuple[Parameter, ...]
    build: Callable[[Mapping[str, Any]], SettingsT]
    class_rows: tuple[Parameter, ...] = ()

    def parameters(self, class_ids: Iterable[str] = ()) -> dict[str, Parameter]:
        """List all parameters by name, those of some classes included."""
        own = (
            replace(row, name=row.name.replace('<id>', class_id))
            for class_id in class_ids
            for row in self.class_rows
        )
        return {row.name: row for row in (*self.rows, *own)}

    def class_ids(self, values: Mapping[str, Value]) -> list[str]:
        """
        List the classes with parameters of their own.

        Raises
        ------
        ValueError
            If there are more than `MAX_CLASSES`.
        """
        listed = values.get('class_ids', [])
        names = listed if isinstance(listed, list) else []
        found = [class_id for class_id in names if class_id and isinstance(class_id, str)]
        if len(found) > MAX_CLASSES:
            raise ValueError(f'class_ids has {len(found)} classes, the maximum is {MAX_CLASSES}')
        return found

    def mentioned_classes(self, names: Iterable[str]) -> list[str]:
        """List the class ids in some parameter names."""
        found: dict[str, None] = {}
        for row in self.class_rows:
            before, _, after = row.name.partition('<id>')
            for name in names:
                long_enough = len(name) > len(before) + len(after)
                if long_enough and name.startswith(before) and name.endswith(after):
                    found.setdefault(name[len(before) : len(name) - len(after)])
        return list(found)

    def settings(self, values: Mapping[str, Value]) -> SettingsT:
        """
        Check values, each by itself and all together, and make settings of them.

        Parameters
        ----------
        values : mapping of str to value
            Values by parameter name; the default is taken where there is none.

        Returns
        -------
        SettingsT
            The settings.

        Raises
        ------
        ValueError
            If a value cannot be used; the message names the parameter.
        """
        parameters = self.parameters(self.class_ids(values))
        complete = {
            name: values.get(name, parameter.default) for name, parameter in parameters.items()
        }
        for name, value in complete.items():
            parameters[name].check(value)
        return self.build(complete)


def group_of(group: Any, values: Mapping[str, Any], prefix: str) -> Any:
    """Make a dataclass of the values under a prefix."""
    own = {field.name: values[prefix + field.name] for field in fields(group)}
    try:
        return group(**own)
    except ValueError as error:
        raise ValueError(f'{prefix}{error}') from None
