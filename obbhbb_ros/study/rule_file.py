# SPDX-License-Identifier: Apache-2.0
"""Write calibrated rules as a parameter file for the node."""

from __future__ import annotations

import json
from collections.abc import Mapping
from collections.abc import Sequence

from obbhbb_ros.geometry.converter import HullRule
from obbhbb_ros.geometry.methods import ONBOARD_METHODS
from obbhbb_ros.settings.parameter_file import yaml_value


def yaml_text(
    rule: HullRule, rule_of_class: Mapping[str, HullRule], notes: Sequence[str] = ()
) -> str:
    """
    Return rules as YAML for `--params-file`, for a node of any name in any namespace.

    Parameters
    ----------
    rule : HullRule
        Rule of every class that is not in `rule_of_class`.
    rule_of_class : mapping of str to HullRule
        Rules by class.
    notes : sequence of str
        Comments for the top of the file.

    Raises
    ------
    ValueError
        If the node has no such method, or a class id cannot be part of a parameter's name.

    Examples
    --------
    >>> print(yaml_text(HullRule('superellipse', q=3.5), {}))
    /**:
      ros__parameters:
        method: "superellipse"
        q: 3.5
        f: 1.0
        s: 1.0
    <BLANKLINE>
    """
    for class_id, class_rule in {'': rule, **rule_of_class}.items():
        if class_rule.method not in ONBOARD_METHODS:
            raise ValueError(f'the node does not offer the method {class_rule.method}')
        if class_id != class_id.strip() or not class_id.isprintable():
            raise ValueError(f'class {class_id!r} cannot be part of a parameter name')
    lines = [f'# {line}' for note in notes for line in note.splitlines()]
    lines += ['/**:', '  ros__parameters:', *_values(rule, '    ')]
    if rule_of_class:
        lines += [f'    class_ids: {json.dumps(list(rule_of_class))}', '    classes:']
        for class_id, class_rule in rule_of_class.items():
            lines += [f'      {json.dumps(class_id)}:', *_values(class_rule, '        ')]
    return '\n'.join(lines) + '\n'


def _values(rule: HullRule, indent: str) -> list[str]:
    """Format the parameters of a rule; q_bow and q_stern only if it has them."""
    lines = [f'{indent}method: {json.dumps(rule.method)}']
    for name in ('q', 'f', 's', 'q_bow', 'q_stern'):
        if (number := getattr(rule, name)) is not None:
            lines.append(f'{indent}{name}: {yaml_value(float(number))}')
    return lines
