# SPDX-License-Identifier: Apache-2.0
"""The rules that a study compares: the paper's, the default of each method, rules by class."""

from __future__ import annotations

from collections.abc import Mapping
from collections.abc import Sequence
from dataclasses import replace
from types import MappingProxyType

import numpy as np

from obbhbb_ros.boxes import FloatArray
from obbhbb_ros.converter import PAPER_RULE
from obbhbb_ros.converter import HullRule
from obbhbb_ros.converter import half_extents
from obbhbb_ros.converter import to_xyxy
from obbhbb_ros.methods import METHODS
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
) -> dict[str, HullRule]:
    """
    Choose a rule for each method.

    Parameters
    ----------
    methods : sequence of str, optional
        Keys of `METHODS`; all by default.
    q, f, s : float, optional
        Parameters of the tunable methods, instead of those in `DEFAULT_RULES`.

    Raises
    ------
    ValueError
        If a method is unknown or a parameter is out of range.
    """
    unknown = [name for name in methods or () if name not in METHODS]
    if unknown:
        raise ValueError(f'no method {unknown[0]!r}; there are {", ".join(METHODS)}')
    chosen = {name: DEFAULT_RULES[name] for name in methods or METHODS}
    for name in chosen.keys() & set(TUNABLE_METHODS):
        own = chosen[name]
        chosen[name] = replace(
            own,
            q=own.q if q is None else q,
            f=own.f if f is None else f,
            s=own.s if s is None else s,
        )
    return chosen


def convert_by_class(
    ships: Ships, rule: HullRule, rule_of_class: Mapping[str, HullRule]
) -> FloatArray:
    """
    Convert ships as the node does: by the rule of their class, or else by `rule`.

    Returns
    -------
    ndarray, shape (N, 4)
        Boxes, pixels.
    """
    rule_of = np.zeros(len(ships), dtype=np.intp)
    for index, class_id in enumerate(rule_of_class, start=1):
        rule_of[ships.class_ids == class_id] = index
    extents = half_extents(ships.boxes, [rule, *rule_of_class.values()], rule_of)
    return to_xyxy(ships.boxes.center, extents)
