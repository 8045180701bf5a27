"""The command line `obbhbb`."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path


def main(arguments: Sequence[str] | None = None) -> int:
    """
    Run a command.

    Parameters
    ----------
    arguments : sequence of str, optional
        Command line without the program's name; `sys.argv` by default.

    Returns
    -------
    int
        Exit code.
    """
    options = _parser().parse_args(arguments)
    try:
        code: int = options.run(options)
    except ModuleNotFoundError as error:
        print(f'obbhbb: {error}; see the extras in the README', file=sys.stderr)
        return 1
    except (OSError, ValueError) as error:
        print(f'obbhbb: {error}', file=sys.stderr)
        return 1
    return code


def _parser() -> argparse.ArgumentParser:
    """Describe the commands."""
    parser = argparse.ArgumentParser(
        prog='obbhbb', description='Axis-aligned boxes from oriented ones, offline.'
    )
    commands = parser.add_subparsers(required=True, metavar='COMMAND')
    demo = commands.add_parser(
        'demo', help='convert a synthetic harbour with the real node; a table and a picture'
    )
    demo.add_argument(
        '--picture', type=Path, default=Path('out/harbour.png'), help='default: %(default)s'
    )
    demo.set_defaults(run=_demo)
    return parser


def _demo(options: argparse.Namespace) -> int:
    """Run the node on the harbour, once with each method."""
    from obbhbb_ros.nodes.demo import boxes_by_method
    from obbhbb_ros.study.harbour import harbour
    from obbhbb_ros.study.plots import draw_scene
    from obbhbb_ros.study.summary import scene_table

    labels = harbour()
    boxes = boxes_by_method(labels)
    print(f'{len(labels.class_ids)} ships of a synthetic harbour, converted by the node over DDS\n')
    print(scene_table(labels, boxes))
    options.picture.parent.mkdir(parents=True, exist_ok=True)
    draw_scene(labels, boxes, options.picture)
    print(f'\npicture: {options.picture}')
    return 0


if __name__ == '__main__':
    sys.exit(main())
