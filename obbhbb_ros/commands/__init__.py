# SPDX-License-Identifier: Apache-2.0
"""The commands of `obbhbb`: one module for each group, with their options and what they print."""

from __future__ import annotations

import shlex
from argparse import Action
from argparse import ArgumentParser
from argparse import Namespace
from collections.abc import Callable
from collections.abc import Sequence
from typing import Any
from typing import NamedTuple

import obbhbb_ros
from obbhbb_ros.commands import bag_command
from obbhbb_ros.commands import chip_commands
from obbhbb_ros.commands import demo_command
from obbhbb_ros.commands import label_commands
from obbhbb_ros.commands import ships_command
from obbhbb_ros.commands import spool_command
from obbhbb_ros.commands import study_commands


class Command(NamedTuple):
    """
    A command of `obbhbb`.

    Attributes
    ----------
    add_options : callable
        Adds the options of the command to its parser.
    run : callable
        Runs the command with the parsed options; returns the exit code, or None for 0. Its
        docstring is the help text of the command.
    """

    add_options: Callable[[ArgumentParser], None]
    run: Callable[[Namespace], int | None]


COMMANDS = {
    'demo': Command(demo_command.add_demo_options, demo_command.run_demo),
    'convert': Command(label_commands.add_convert_options, label_commands.run_convert),
    'evaluate': Command(study_commands.add_evaluate_options, study_commands.run_evaluate),
    'calibrate': Command(study_commands.add_calibrate_options, study_commands.run_calibrate),
    'report': Command(study_commands.add_report_options, study_commands.run_report),
    'chips': Command(chip_commands.add_chips_options, chip_commands.run_chips),
    'bag': Command(bag_command.add_bag_options, bag_command.run_bag),
    'gallery': Command(chip_commands.add_gallery_options, chip_commands.run_gallery),
    'ships': Command(ships_command.add_ships_options, ships_command.run_ships),
    'spool': Command(spool_command.add_spool_options, spool_command.run_spool),
}


class VersionAction(Action):
    """Prints the version, which takes time to look up, and ends the command."""

    def __call__(self, parser: ArgumentParser, *_: Any) -> None:
        """Print the version."""
        print(f'{parser.prog} {obbhbb_ros.__version__}')
        parser.exit()


def command_line() -> ArgumentParser:
    """Describe the commands and their options."""
    parser = ArgumentParser(
        prog='obbhbb', description='Convert oriented boxes to axis-aligned ones, offline.'
    )
    parser.add_argument('--version', action=VersionAction, nargs=0, help='print the version')
    parsers = parser.add_subparsers(required=True, metavar='COMMAND', dest='command')
    for name, command in COMMANDS.items():
        command.add_options(parsers.add_parser(name, help=command.run.__doc__))
    return parser


def run(arguments: Sequence[str]) -> int:
    """
    Parse a command line, without the program's name, and run it; return the exit code.

    Without a command, list all of them.
    """
    if not arguments:
        command_line().print_help()
        return 2
    options = Namespace(invocation=shlex.join(['obbhbb', *arguments]))
    command_line().parse_args(arguments, options)
    return COMMANDS[options.command].run(options) or 0
