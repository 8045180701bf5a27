# SPDX-License-Identifier: Apache-2.0
"""`--help` and `--version` of the executables, and arguments that are not for ROS."""

from __future__ import annotations

from argparse import ArgumentParser
from argparse import RawDescriptionHelpFormatter
from importlib import import_module
from textwrap import fill

from obbhbb_ros import __version__
from obbhbb_ros.errors import StartError
from obbhbb_ros.settings.parameter_file import yaml_value
from obbhbb_ros.settings.parameters import Parameter
from obbhbb_ros.settings.parameters import ParameterTable

_USAGE = """%(prog)s [--help] [--version] [--ros-args ARGUMENT ...]

  --ros-args -p NAME:=VALUE        set a parameter
  --ros-args --params-file FILE    set those in a file
  --ros-args -r TOPIC:=OTHER       use another topic
  --ros-args -r __ns:=/NAMESPACE   run in a namespace"""
_INDENT = ' ' * 6


def answer(name: str, arguments: list[str]) -> None:
    """
    Print what `--help` or `--version` ask for.

    Parameters
    ----------
    name : str
        Name of the executable.
    arguments : list of str
        Its arguments that are not for ROS; at least one.

    Raises
    ------
    SystemExit
        With 0, after the answer.
    StartError
        If the arguments are others.
    """
    module = import_module(f'obbhbb_ros.nodes.{name}')
    table: ParameterTable[object] = getattr(
        import_module(f'obbhbb_ros.settings.{name}'), name.upper()
    )
    parser = ArgumentParser(
        name,
        _USAGE,
        module.__doc__,
        '\n'.join(['parameters:', *map(_paragraph, (*table.rows, *table.class_rows))]),
        formatter_class=RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    parser.add_argument('--version', action='version', version=f'{name} {__version__}')
    _, unknown = parser.parse_known_args(arguments)
    raise StartError(
        f'unknown arguments: {" ".join(unknown)}; parameters and remaps follow --ros-args'
    )


def _paragraph(row: Parameter) -> str:
    """Describe a parameter: name, type, default, meaning."""
    meaning = fill(row.meaning, 92, initial_indent=_INDENT, subsequent_indent=_INDENT)
    return f'  {row.name} ({row.type_name}, {yaml_value(row.default)})\n{meaning}'
