# SPDX-License-Identifier: Apache-2.0
"""Several nodes in one process, each with its own name, parameters, lifecycle and state file."""

from __future__ import annotations

from argparse import ArgumentParser
from argparse import RawDescriptionHelpFormatter

from obbhbb_ros import __version__
from obbhbb_ros.errors import StartError
from obbhbb_ros.nodes.running.executables import PAYLOAD
from obbhbb_ros.nodes.running.executables import PAYLOAD_NODES

_USAGE = """%(prog)s [--help] [--version] [--nodes NODE ...] [--ros-args ARGUMENT ...]

  --ros-args -p NODE:NAME:=VALUE    set a parameter of a node
  --ros-args --params-file FILE     set those in a file, by the names of the nodes
  --ros-args -r NODE:__node:=OTHER  give a node another name
  --ros-args -r TOPIC:=OTHER        use another topic, in all nodes
  --ros-args -r __ns:=/NAMESPACE    run all in a namespace"""


def chosen(arguments: list[str]) -> list[str]:
    """
    Read which nodes to run; answer `--help` and `--version`.

    Parameters
    ----------
    arguments : list of str
        Those that are not for ROS.

    Returns
    -------
    list of str
        The executables of the nodes; without ``--nodes``, the chain from boxes to downlink.

    Raises
    ------
    SystemExit
        With 0, after an answer.
    StartError
        If an argument is unknown, or a node is unknown or named twice.

    Examples
    --------
    >>> chosen(['--nodes', 'downlink', 'obb_to_hbb'])
    ['downlink', 'obb_to_hbb']
    """
    parser = ArgumentParser(
        PAYLOAD,
        _USAGE,
        __doc__,
        formatter_class=RawDescriptionHelpFormatter,
        allow_abbrev=False,
        exit_on_error=False,
    )
    parser.add_argument('--version', action='version', version=f'{PAYLOAD} {__version__}')
    parser.add_argument(
        '--nodes',
        nargs='*',
        default=['obb_to_hbb', 'chip_extractor', 'downlink'],
        metavar='NODE',
        help=f'which nodes to run, of {", ".join(PAYLOAD_NODES)}; default: the first three',
    )
    options, unknown = parser.parse_known_args(arguments)
    if unknown:
        raise StartError(
            f'unknown arguments: {" ".join(unknown)}; parameters and remaps follow --ros-args'
        )
    names: list[str] = options.nodes
    if strange := [name for name in names if name not in PAYLOAD_NODES]:
        raise StartError(f'--nodes: {", ".join(strange)} is none of {", ".join(PAYLOAD_NODES)}')
    if not names or len({*names}) < len(names):
        raise StartError('--nodes: name at least one node, and each of them once')
    return names
