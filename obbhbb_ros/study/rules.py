# SPDX-License-Identifier: Apache-2.0
"""The rules that are compared: that of the paper, and the defaults of all methods."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from types import MappingProxyType
from typing import Any

from obbhbb_ros.geometry.converter import PAPER_RULE
from obbhbb_ros.geometry.converter import HullRule
from obbhbb_ros.geometry.methods import METHODS

DEFAULT_RULES: MappingProxyType[str, HullRule] = MappingProxyType(
    {name: HullRule(name) for name in METHODS} | {PAPER_RULE.method: PAPER_RULE}
)
TUNABLE_METHODS = tuple(name for name, method in METHODS.items() if method.tunable)


def choose_rules(
    methods: Sequence[str] | None = None,
    q: float | None = None,
    f: float | None = None,
    s: float | None = None,
    q_bow: float | None = None,
    q_stern: float | None = None,
) -> dict[str, HullRule]:
    """
    Choose a rule for each of some methods, all by default.

    q, f and s are for the tunable methods, instead of those in `DEFAULT_RULES`, q_bow and q_stern
    for those that have ends. Raises ValueError if a method is unknown or a parameter is out of
    range.
    """
    unknown = [name for name in methods or () if name not in METHODS]
    if unknown:
        raise ValueError(f'no method {unknown[0]!r}; there are {", ".join(METHODS)}')
    chosen = {name: DEFAULT_RULES[name] for name in methods or METHODS}
    shape: dict[str, Any] = {'q': q, 'f': f, 's': s}
    shape = {name: value for name, value in shape.items() if value is not None}
    for name in chosen.keys() & set(TUNABLE_METHODS):
        two_ended = METHODS[name].two_ended
        ends: dict[str, Any] = {'q_bow': q_bow, 'q_stern': q_stern} if two_ended else {}
        chosen[name] = replace(chosen[name], **shape, **ends)
    return chosen
