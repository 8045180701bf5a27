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
    except ImportError as error:
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
    _add_convert(commands)
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


def _add_convert(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Describe `convert`."""
    parser = commands.add_parser(
        'convert', help='label files of oriented boxes to label files of axis-aligned ones'
    )
    parser.add_argument('source', metavar='IN', type=Path, help='label file, or folder of them')
    parser.add_argument('target', metavar='OUT', type=Path, help='file or folder to write')
    parser.add_argument(
        '--from', dest='source_format', metavar='FORMAT', help='format of IN; default: detected'
    )
    parser.add_argument(
        '--to', dest='target_format', metavar='FORMAT',
        help='yolo, coco, voc, geojson, csv or shapefile; default: by the suffix of OUT',
    )
    parser.add_argument('--method', default='superellipse', help='default: %(default)s')
    parser.add_argument('--q', type=float, default=3.0, help='shape exponent, 1 to inf; 3')
    parser.add_argument('--f', type=float, default=1.0, help='fullness, above 0 to 2; 1')
    parser.add_argument('--s', type=float, default=1.0, help='shrink factor, above 0 to 2; 1')
    parser.add_argument('--max-length', type=float, help='cap of the longer side, pixels')
    parser.add_argument('--max-width', type=float, help='cap of the shorter side, pixels')
    parser.add_argument(
        '--diagnostics', action='store_true',
        help='also write length, width, theta, t_x, t_y and capped of each box',
    )
    parser.add_argument(
        '--image-size', type=int, nargs=2, metavar=('W', 'H'),
        help='of every image, pixels; default: from labels or images',
    )
    parser.add_argument(
        '--strict', action='store_true', help='exit with 1 if any record was skipped or left out'
    )
    parser.set_defaults(run=_convert)


def _convert(options: argparse.Namespace) -> int:
    """Convert files, and sum up."""
    from obbhbb_ros.converter import Caps
    from obbhbb_ros.converter import HullRule
    from obbhbb_ros.study.convert import convert_file
    from obbhbb_ros.study.progress import note

    tally = convert_file(
        options.source,
        options.target,
        HullRule(options.method, options.q, options.f, options.s),
        Caps(options.max_length, options.max_width),
        source_format=options.source_format,
        target_format=options.target_format,
        image_size=options.image_size,
        diagnostics=options.diagnostics,
        report=note,
    )
    print(tally)
    if not tally.readable:
        print(f'obbhbb: nothing to convert in {options.source}', file=sys.stderr)
        return 1
    return 1 if options.strict and not tally.complete else 0


if __name__ == '__main__':
    sys.exit(main())
