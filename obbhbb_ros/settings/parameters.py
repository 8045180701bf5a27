# SPDX-License-Identifier: Apache-2.0
"""
Parameters as rows of a table, and the settings made of their values.

Declaration, descriptors, validation, the YAML files in `config/` and the tables in `doc/` all
follow from the rows. Values are validated as a whole before any is applied: a set that is rejected
changes nothing.
"""

from __future__ import annotations

from collections.abc import Callable
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
            raise ValueError(f'{self.name} must be a {self.type_name}, not {value!r}')
        if self.limits is not None:
            self.limits.check(self.name, value)

    def _has_type(self, value: Value) -> bool:
        """Return whether a value has the type of the default; of a list, each of its elements."""
        if isinstance(value, list) and isinstance(self.default, list):
            return all(type(element) is type(self.default[0]) for element in value)
        return type(value) is type(self.default)


def parameter_of(settings: type[DataclassInstance], name: str, prefix: str = '') -> Parameter:
    """Make a parameter of a field that `limits.setting` describes, under a prefix."""
    metadata = {field.name: field.metadata for field in fields(settings)}[name]
    default = getattr(settings, name)
    return Parameter(prefix + name, default, metadata['meaning'], metadata['limits'])


@dataclass(frozen=True)
class ParameterGroup(Generic[GroupT]):
    """
    The fields of a dataclass as parameters under a prefix.

    Attributes
    ----------
    settings : type
        Dataclass whose fields `limits.setting` describes.
    prefix : str
        What the names of the parameters begin with.
    """

    settings: type[GroupT]
    prefix: str = ''

    @property
    def rows(self) -> tuple[Parameter, ...]:
        """Parameters in the order of the fields."""
        return tuple(
            parameter_of(self.settings, field.name, self.prefix) for field in fields(self.settings)
        )

    def build(self, values: Mapping[str, Any]) -> GroupT:
        """Make the settings; ValueError with the name of the parameter if they do not fit."""
        names = [field.name for field in fields(self.settings)]
        try:
            return self.settings(**{name: values[self.prefix + name] for name in names})
        except ValueError as error:
            raise ValueError(f'{self.prefix}{error}') from None


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
        listed = values.get('class_ids', [])
        names = listed if isinstance(listed, list) else []
        class_ids = [name for name in names if name and isinstance(name, str)]
        if len(class_ids) > MAX_CLASSES:
            raise ValueError(
                f'class_ids has {len(class_ids)} classes, the maximum is {MAX_CLASSES}'
            )
        return class_ids

    def mentioned_classes(self, names: Iterable[str]) -> list[str]:
        """List the class ids that occur in some parameter names."""
        affixes = [row.name.split('<id>') for row in self.class_rows]
        # As the keys of a dictionary: in order, each once.
        class_ids = {
            name[len(before) : len(name) - len(after)]: None
            for before, after in affixes
            for name in names
            if len(name) > len(before) + len(after)
            if name.startswith(before) and name.endswith(after)
        }
        return list(class_ids)

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
