# SPDX-License-Identifier: Apache-2.0
"""The rules that are compared: the paper's, the default of each method, rules by class."""

from __future__ import annotations

from collections.abc import Mapping
from collections.abc import Sequence
from dataclasses import replace
from types import MappingProxyType
from typing import Any

from obbhbb_ros.geometry.boxes import FloatArray
from obbhbb_ros.geometry.converter import PAPER_RULE
from obbhbb_ros.geometry.converter import HullRule
from obbhbb_ros.geometry.converter import centers_and_extents
from obbhbb_ros.geometry.converter import to_xyxy
from obbhbb_ros.geometry.methods import METHODS
from obbhbb_ros.study.ships import Ships

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
    given: dict[str, Any] = {'q': q, 'f': f, 's': s}
    given = {name: value for name, value in given.items() if value is not None}
    for name in chosen.keys() & set(TUNABLE_METHODS):
        two_ended = METHODS[name].two_ended
        ends: dict[str, Any] = {'q_bow': q_bow, 'q_stern': q_stern} if two_ended else {}
        chosen[name] = replace(chosen[name], **given, **ends)
    return chosen


def convert_by_class(
    ships: Ships, rule: HullRule, rule_of_class: Mapping[str, HullRule]
) -> FloatArray:
    """Convert N ships as the node does, by the rule of their class, or else by `rule`; (N, 4)."""
    rules = [*rule_of_class.values(), rule]
    # The index of a class without a rule, -1, is that of the last rule.
    rule_of = ships.class_index(rule_of_class) % len(rules)
    return to_xyxy(*centers_and_extents(ships.boxes, rules, rule_of))
