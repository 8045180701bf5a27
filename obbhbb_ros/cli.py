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
    chips = commands.add_parser(
        'chips', help='what the chips of each method cost: pixels and bytes by codec'
    )
    chips.add_argument(
        'labels', type=Path, nargs='?',
        help='label file or folder with the images beside it; default: a synthetic harbour',
    )
    chips.add_argument('--padding', type=float, default=0.0, help='fraction of the box a side')
    chips.add_argument('--picture', type=Path, help='draw the first image and the costs')
    chips.set_defaults(run=_chips)
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


def _chips(options: argparse.Namespace) -> int:
    """Tell what the chips of each method cost."""
    import numpy as np

    from obbhbb_ros.crops import CropSettings
    from obbhbb_ros.labels import read_labels
    from obbhbb_ros.labels.images import find_images
    from obbhbb_ros.labels.images import load_image
    from obbhbb_ros.study.chips import chip_costs
    from obbhbb_ros.study.chips import cost_table
    from obbhbb_ros.study.chips import draw_costs
    from obbhbb_ros.study.chips import render
    from obbhbb_ros.study.harbour import harbour

    if options.labels is None:
        what, images = 'a synthetic harbour, no pixel of it real', [(harbour(), render(harbour()))]
    else:
        labels = list(read_labels(options.labels))
        found = zip(labels, find_images(labels), strict=True)
        pairs = [(each, load_image(path)[1]) for each, path in found if path is not None]
        images = [(each, np.atleast_3d(pixels)) for each, pixels in pairs]
        what = f'{options.labels}, {len(images)} of {len(labels)} images found'
    if not images:
        raise ValueError(f'no image found for the labels in {options.labels}')
    costs = chip_costs(images, CropSettings(padding=options.padding))
    print(f'chips of {what}; in brackets the difference to outer\n')
    print(cost_table(costs))
    if options.picture:
        options.picture.parent.mkdir(parents=True, exist_ok=True)
        draw_costs(costs, *images[0], options.picture, what)
        print(f'\npicture: {options.picture}')
    return 0


if __name__ == '__main__':
    sys.exit(main())
