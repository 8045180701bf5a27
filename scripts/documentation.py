# SPDX-License-Identifier: Apache-2.0
"""
The parameter files in `config/` and the tables in `doc/`, written from the code.

`python scripts/documentation.py` rewrites them in the checkout that is the working folder. A test
checks that they are up to date.
"""

from __future__ import annotations

import textwrap
from collections.abc import Mapping
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from obbhbb_ros.files import write_text
from obbhbb_ros.geometry.converter import PAPER_RULE
from obbhbb_ros.geometry.methods import METHODS
from obbhbb_ros.labels import FORMATS
from obbhbb_ros.limits import Choices
from obbhbb_ros.settings.all_nodes import NODE_TABLES
from obbhbb_ros.settings.common import AUTOSTART
from obbhbb_ros.settings.common import COMMON_WITH_INPUT
from obbhbb_ros.settings.parameter_file import yaml_value
from obbhbb_ros.settings.parameters import Parameter
from obbhbb_ros.text_tables import markdown_table

# A parameter that the rule leaves open keeps its default.
PAPER = {name: value for name, value in asdict(PAPER_RULE).items() if value is not None}
# Name, node, title, and the values that differ from the defaults.
PARAMETER_FILES: tuple[tuple[str, str, str, Mapping[str, Any]], ...] = (
    ('obb_to_hbb', 'obb_to_hbb', 'the recommended settings.', {}),
    ('paper', 'obb_to_hbb', "the paper's rule (Algorithm 1) and its best parameters.", PAPER),
    ('chip_extractor', 'chip_extractor', 'the default settings.', {}),
    ('downlink', 'downlink', 'the default settings. Set the two folders.', {}),
    ('overlay', 'overlay', 'the default settings.', {}),
    ('ship_tracker', 'ship_tracker', 'the default settings.', {}),
)
_INDENT = ' ' * 4
_COLUMNS = 100


def yaml_file(title: str, values: Mapping[str, Any], table: Sequence[Parameter]) -> str:
    """
    Write a parameter file with every parameter and its comment.

    Parameters
    ----------
    title : str
        First comment.
    values : mapping of str to value
        Values that differ from the defaults.
    table : sequence of Parameter
        Parameters of the node.

    Returns
    -------
    str
        A file for `--params-file` that applies to a node of any name in any namespace.
    """
    lines = [*_comment(title, ''), '/**:', '  ros__parameters:']
    group = ''
    for spec in table:
        prefix, _, name = spec.name.rpartition('.')
        if prefix and prefix != group:
            lines.append(f'{_INDENT}{prefix}:')
        group = prefix
        indent = _INDENT + ('  ' if group else '')
        lines += _comment(_note(spec), indent)
        lines.append(f'{indent}{name}: {yaml_value(values.get(spec.name, spec.default))}')
    return '\n'.join(lines) + '\n'


def aggregator_file() -> str:
    """Write the parameter file of `diagnostic_aggregator`: one analyzer for each managed node."""
    lines = [
        '# diagnostic_aggregator: one analyzer for each managed node, in any namespace.',
        'analyzers:',
        '    ros__parameters:',
        '        path: Aggregation',
        '        pub_rate: 1.0',
        '        obbhbb:',
        '            type: diagnostic_aggregator/AnalyzerGroup',
        '            path: obbhbb',
        '            analyzers:',
    ]
    for node, table in NODE_TABLES.items():
        if AUTOSTART not in table.rows:
            continue
        lines += [
            f'                {node}:',
            '                    type: diagnostic_aggregator/GenericAnalyzer',
            f'                    path: {node}',
            f"                    regex: ['(.*/)?{node}']",
            '                    timeout: 5.0',
        ]
        if node in ('overlay', 'ship_tracker'):
            lines += [
                '                    # It may be absent.',
                '                    num_items: 0',
            ]
    return '\n'.join(lines) + '\n'


def parameters_table(table: Sequence[Parameter]) -> str:
    """Write parameters as a Markdown table."""
    rows = [
        (
            f'`{spec.name}`',
            spec.type_name,
            f'`{yaml_value(spec.default)}`',
            _limits(spec),
            spec.meaning + (' Only at start.' if spec.read_only else ''),
        )
        for spec in table
    ]
    return markdown_table(('parameter', 'type', 'default', 'range', 'meaning'), rows)


def with_table(document: str, name: str, table: str) -> str:
    """
    Put a table between the markers that name its place in a document.

    Raises
    ------
    ValueError
        If the document has no such place.
    """
    begin, end = f'<!-- {name}: begin -->\n', f'<!-- {name}: end -->'
    if not 0 <= document.find(begin) < document.find(end):
        raise ValueError(f'the document has no place for the table {name!r}')
    before, rest = document.split(begin, 1)
    return before + begin + table + rest[rest.index(end) :]


def page_tables() -> dict[str, dict[str, str]]:
    """Write the tables of the pages: by page, and by the name of the place on the page."""
    methods = [
        (f'`{m.name}`', m.summary, 'q, f, s' if m.tunable else '', 'yes' if m.onboard else '')
        for m in METHODS.values()
    ]
    formats = [
        (f'`{f.name}`', ', '.join(f'`{suffix}`' for suffix in f.suffixes), f.summary)
        for f in FORMATS.values()
    ]
    head = ('method', 'what it encloses', 'tuned by', 'in the node')
    pages = {
        'method': {'methods': markdown_table(head, methods)},
        'formats': {'formats': markdown_table(('format', 'files', 'what it is'), formats)},
        'nodes': {'common parameters': parameters_table(COMMON_WITH_INPUT)},
    }
    for node, table in NODE_TABLES.items():
        rows = [row for row in (*table.rows, *table.class_rows) if row not in COMMON_WITH_INPUT]
        pages[node] = {'parameters': parameters_table(rows)}
    return pages


def documents(root: Path) -> dict[Path, str]:
    """
    Write every file that is generated from the code.

    Parameters
    ----------
    root : Path
        Top folder of a checkout.

    Returns
    -------
    dict of Path to str
        The text of each file.
    """
    files = {
        root / 'config' / f'{name}.yaml': yaml_file(
            f'{node}: {title} Every parameter is here.', values, NODE_TABLES[node].rows
        )
        for name, node, title, values in PARAMETER_FILES
    }
    files[root / 'config' / 'diagnostic_aggregator.yaml'] = aggregator_file()
    for page, tables in page_tables().items():
        path = root / 'doc' / f'{page}.md'
        files[path] = path.read_text(encoding='utf-8')
        for name, table in tables.items():
            files[path] = with_table(files[path], name, table)
    return files


def _limits(spec: Parameter) -> str:
    """Write the values that a parameter takes for a cell of a table."""
    if isinstance(spec.limits, Choices):
        return ', '.join(f'`{word}`' if word else '`""`' for word in spec.limits.words)
    return str(spec.limits or '')


def _note(spec: Parameter) -> str:
    """Write meaning and range of a parameter."""
    return f'{spec.meaning} [{spec.limits}]' if spec.limits else spec.meaning


def _comment(text: str, indent: str) -> list[str]:
    """Wrap a comment."""
    return textwrap.wrap(
        text, _COLUMNS, initial_indent=indent + '# ', subsequent_indent=indent + '# '
    )


def main() -> None:
    """Rewrite the files of the checkout in the working folder."""
    for path, text in documents(Path.cwd()).items():
        write_text(path, text)
        print(path)


if __name__ == '__main__':
    main()
