# SPDX-License-Identifier: Apache-2.0
"""
Parameters as rows of a table, and the settings made of their values.

Declaration, descriptors, validation, the YAML files in `config/` and the tables in `doc/` all
follow from the rows. Values are validated as a whole before any is applied: a set that is rejected
changes nothing.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from collections.abc import Collection
from collections.abc import Iterable
from collections.abc import Mapping
from dataclasses import dataclass
from dataclasses import fields
from dataclasses import replace
from typing import TYPE_CHECKING
from typing import Any
from typing import Generic
from typing import TypeVar

from obbhbb_ros.limits import Limits
from obbhbb_ros.settings.parameter_file import Value

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

SettingsT = TypeVar('SettingsT')
GroupT = TypeVar('GroupT', bound='DataclassInstance')

# Nine parameters are declared for each class.
MAX_CLASSES = 256


@dataclass(frozen=True)
class Parameter:
    """
    One row of a parameter table.

    Attributes
    ----------
    name : str
        Parameter name; `<id>` in it stands for each class id.
    default : bool, int, float, str, or a list of str or float that is not empty
        Default value; its type is the type of the parameter.
    meaning : str
        One or two sentences with the unit.
    limits : Range or Choices, optional
        The values that it takes.
    read_only : bool
        Whether it can only be set at start.
    """

    name: str
    default: Value
    meaning: str
    limits: Limits | None = None
    read_only: bool = False

    @property
    def type_name(self) -> str:
        """Name of the type in ROS documentation."""
        if isinstance(self.default, list):
            return 'double[]' if isinstance(self.default[0], float) else 'string[]'
        return {bool: 'bool', int: 'int', float: 'double', str: 'string'}[type(self.default)]

    def check(self, value: Any) -> None:
        """
        Check one value.

        Raises
        ------
        ValueError
            If it has another type than the default or is out of its limits; the message begins
            with the name of the parameter.
        """
        if not self._has_type(value):
            kind = f'{"an" if self.type_name.startswith("int") else "a"} {self.type_name}'
            raise ValueError(f'{self.name} must be {kind}, not {value!r}{self._advice(value)}')
        if self.limits is not None:
            self.limits.check(self.name, value)

    def adapted(self, value: Any) -> Any:
        """
        Return a value as this parameter has it, where tools cannot write its type.

        `ros2 param load` sends an empty list as one of booleans, and numbers without a decimal
        point, such as `inf` and `1e-05`, as text.

        Examples
        --------
        >>> Parameter('q', 3.0, 'Shape exponent.').adapted('inf')
        inf
        """
        if isinstance(self.default, list) and value == []:
            return []
        if self.type_name in ('double', 'double[]') and isinstance(value, str):
            try:
                numbers = [float(text) for text in value.strip('[]').split(',')]
            except ValueError:
                return value
            return numbers if isinstance(self.default, list) else numbers[0]
        return value

    def _advice(self, value: Any) -> str:
        """Say how to write a value that was read as another type."""
        elements = value if isinstance(value, list) else [value]
        if self.type_name == 'string[]' and isinstance(value, list):
            return f': quote them: {json.dumps([str(element) for element in value])}'
        if self.type_name.startswith('double') and any(type(one) is int for one in elements):
            return ': write 2.0 instead of 2'
        return ''

    def _has_type(self, value: Value) -> bool:
        """Return whether a value has the type of the default; of a list, each of its elements."""
        if isinstance(value, list) and isinstance(self.default, list):
            return all(type(element) is type(self.default[0]) for element in value)
        return type(value) is type(self.default)


def rows_of(settings: type[DataclassInstance], prefix: str = '') -> tuple[Parameter, ...]:
    """
    Make parameters of the fields of a dataclass that `limits.setting` describes.

    Parameters
    ----------
    settings : type
        The dataclass.
    prefix : str
        What the names of the parameters begin with.

    Returns
    -------
    tuple of Parameter
        Parameters in the order of the fields.
    """
    return tuple(
        Parameter(prefix + field.name, getattr(settings, field.name), **field.metadata)
        for field in fields(settings)
    )


def settings_of(settings: type[GroupT], values: Mapping[str, Any], prefix: str = '') -> GroupT:
    """
    Make settings of the values of parameters.

    Parameters
    ----------
    settings : type
        The dataclass of the settings.
    values : mapping of str to value
        Values by parameter name, one for every field.
    prefix : str
        What the names of the parameters begin with.

    Raises
    ------
    ValueError
        If the values do not fit together; the message begins with the name of the parameter.
    """
    try:
        return settings(**{field.name: values[prefix + field.name] for field in fields(settings)})
    except ValueError as error:
        raise ValueError(f'{prefix}{error}') from None


@dataclass(frozen=True)
class ParameterTable(Generic[SettingsT]):
    """
    All parameters of a node, and how settings are made of them.

    Attributes
    ----------
    rows : tuple of Parameter
        Parameters that the node always has.
    build : callable
        Makes settings of all values by name; ValueError if they do not fit together.
    class_rows : tuple of Parameter
        Parameters of each class in `class_ids`, with `<id>` in their names.
    """

    rows: tuple[Parameter, ...]
    build: Callable[[Mapping[str, Any]], SettingsT]
    class_rows: tuple[Parameter, ...] = ()

    def parameters(self, class_ids: Iterable[str] = ()) -> dict[str, Parameter]:
        """Return all parameters by name, including those of some classes."""
        class_rows = (
            replace(row, name=row.name.replace('<id>', class_id))
            for class_id in class_ids
            for row in self.class_rows
        )
        return {row.name: row for row in (*self.rows, *class_rows)}

    def class_ids(self, values: Mapping[str, Value]) -> list[str]:
        """
        List the classes that have parameters of their own.

        Raises
        ------
        ValueError
            If there are more than `MAX_CLASSES`.
        """
        listed = values.get('class_ids')
        names = listed if isinstance(listed, list) else []
        classes = [name for name in names if name and isinstance(name, str)]
        if len(classes) > MAX_CLASSES:
            raise ValueError(f'class_ids has {len(classes)} classes, the maximum is {MAX_CLASSES}')
        return classes

    def mentioned_classes(self, names: Collection[str]) -> list[str]:
        """List the class ids that occur in parameter names."""
        patterns = [re.escape(row.name).replace('<id>', '(.+)') for row in self.class_rows]
        matches = [re.fullmatch(pattern, name, re.S) for pattern in patterns for name in names]
        # As the keys of a dictionary: in order, without duplicates.
        return list(dict.fromkeys(match[1] for match in matches if match))

    def settings(self, values: Mapping[str, Value]) -> SettingsT:
        """
        Check the values, first one by one and then together, and make settings of them.

        Parameters
        ----------
        values : mapping of str to value
            Values by parameter name; missing ones take their default.

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
