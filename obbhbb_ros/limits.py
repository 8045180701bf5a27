# SPDX-License-Identifier: Apache-2.0
"""
What a setting means and which values it takes, written once: at the field of its dataclass.

The parameters of the nodes are made from these fields, and the dataclass checks itself by them.
"""

from __future__ import annotations

from dataclasses import Field
from dataclasses import dataclass
from dataclasses import field
from inspect import cleandoc
from numbers import Real
from typing import Any
from typing import ClassVar
from typing import TypeAlias
from typing import TypeVar

T = TypeVar('T')

MAX_BYTES = 1e12
# The largest integer that Qt's tools take, rqt_reconfigure among them.
MAX_INT = 2**31 - 1


@dataclass(frozen=True)
class Range:
    """
    Numbers from `low` to `high`.

    Attributes
    ----------
    low, high : float
        Bounds; `high` is included.
    above : bool
        Whether `low` is excluded.

    Examples
    --------
    >>> str(Range(1, 100)), str(Range(0.0, 2.0, above=True))
    ('1 to 100', 'above 0 and at most 2')
    """

    low: float
    high: float
    above: bool = False

    def __str__(self) -> str:
        """Describe the range."""
        if self.above:
            return f'above {self.low:.10g} and at most {self.high:.10g}'
        return f'{self.low:.10g} to {self.high:.10g}'

    def check(self, name: str, value: float) -> None:
        """Raise ValueError with the name if a value is out of range or NaN."""
        require_number(name, value)
        if not self.low <= value <= self.high or (self.above and value == self.low):
            raise ValueError(f'{name} must be {self}, not {value}')


@dataclass(frozen=True)
class Choices:
    """
    A choice of words.

    Examples
    --------
    >>> str(Choices(('', 'png')))
    '"", png'
    """

    words: tuple[str, ...]

    def __str__(self) -> str:
        """List the words."""
        return ', '.join(word or '""' for word in self.words)

    def check(self, name: str, value: str) -> None:
        """Raise ValueError with the name if a value is not one of the words."""
        if value not in self.words:
            raise ValueError(f'{name} must be one of {self}, not {value!r}')


def require_number(name: str, value: float) -> float:
    """Return a number; raise TypeError with the name for any other value."""
    # Without float and int, the check would be slow.
    if not isinstance(value, (float, int, Real)):
        raise TypeError(f'{name} must be a number, not {value!r}')
    return value


Limits: TypeAlias = Range | Choices


def setting(
    default: T, meaning: str, limits: Limits | None = None, *, read_only: bool = False
) -> T:
    """
    Make a field of a dataclass of settings.

    Parameters
    ----------
    default : bool, int, float or str
        Default value.
    meaning : str
        One or two sentences with the unit.
    limits : Range or Choices, optional
        The values that it takes.
    read_only : bool
        Whether the parameter of a node that is made from it can only be set at start.
    """
    metadata = {'meaning': meaning, 'limits': limits, 'read_only': read_only}
    made: Any = field(default=default, metadata=metadata)
    return made


class CheckedSettings:
    """
    A dataclass of settings that checks itself: every value against its limits; None passes.

    Raises
    ------
    ValueError
        If a value is out of its limits; the message begins with the name of the field.
    TypeError
        If a value that must be a number is something else.
    """

    # Listed once: `convert` makes, and checks, a rule in each call.
    _limits: ClassVar[tuple[tuple[str, Limits], ...]]

    def __init_subclass__(cls) -> None:
        """List the fields of a subclass, with their meaning, in its docstring, for `help`."""
        items = {**getattr(cls, '__dataclass_fields__', {}), **vars(cls)}
        settings = {name: item.metadata for name, item in items.items() if isinstance(item, Field)}
        attributes = [f'{name}\n    {facts["meaning"]}' for name, facts in settings.items()]
        cls._limits = tuple(
            (name, facts['limits']) for name, facts in settings.items() if facts['limits']
        )
        text = cleandoc(cls.__doc__ or '')
        cls.__doc__ = '\n'.join((text, '', 'Attributes', '----------', *attributes))

    def __post_init__(self) -> None:
        """Check every value."""
        for name, limits in self._limits:
            value = getattr(self, name)
            if value is not None:
                limits.check(name, value)
