# SPDX-License-Identifier: Apache-2.0
"""The command line `obbhbb`."""

from __future__ import annotations

import argparse
import gc
import os
import signal
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from obbhbb_ros.labels import LabelError
    from obbhbb_ros.study.ships import Ships


# What a shell adds to the number of the signal that ended a command.
_BY_SIGNAL = 128


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
    for name in ('stdout', 'stderr'):
        if getattr(sys, name) is None:
            # Closed by whoever started the command; what it prints goes nowhere.
            setattr(sys, name, open(os.devnull, 'w', encoding='utf-8'))  # noqa: SIM115
    given = list(sys.argv[1:] if arguments is None else arguments)
    options = _parser().parse_args(given, argparse.Namespace(given=given))
    try:
        code: int = options.run(options)
        # Here rather than when Python ends, where nothing can be said any more.
        sys.stdout.flush()
    except KeyboardInterrupt:
        return _BY_SIGNAL + signal.SIGINT
    except BrokenPipeError:
        # Whoever read the output, `head` for one, has seen enough.
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
        return _BY_SIGNAL + signal.SIGPIPE
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
    _add_evaluate(commands)
    _add_calibrate(commands)
    _add_report(commands)
    _add_chips(commands)
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
    draw_scene(labels, boxes, options.picture)
    print(f'\npicture: {options.picture}')
    return 0


def _add_chips(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Describe `obbhbb chips`."""
    parser = commands.add_parser(
        'chips', help='what the chips of each method cost: pixels and bytes by codec'
    )
    parser.add_argument(
        'labels', type=Path, nargs='?',
        help='label file or folder with the images beside it; default: a synthetic harbour',
    )
    parser.add_argument('--padding', type=float, default=0.0, help='fraction of the box a side')
    parser.add_argument('--picture', type=Path, help='draw the first image and the costs')
    parser.set_defaults(run=_chips)


def _chips(options: argparse.Namespace) -> int:
    """Tell what the chips of each method cost."""
    import numpy as np

    from obbhbb_ros.downlink.crops import CropSettings
    from obbhbb_ros.labels import read_labels
    from obbhbb_ros.labels.images import find_images
    from obbhbb_ros.labels.images import load_image
    from obbhbb_ros.study.chip_costs import chip_costs
    from obbhbb_ros.study.chip_costs import cost_table
    from obbhbb_ros.study.chip_costs import draw_costs
    from obbhbb_ros.study.chip_costs import render
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
        draw_costs(costs, *images[0], options.picture, what)
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

    # Conversion fills tables: looking through them for garbage takes a fifth of its time.
    gc.disable()
    try:
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
    finally:
        gc.enable()
    print(tally)
    if not tally.readable:
        print(f'obbhbb: nothing to convert in {options.source}', file=sys.stderr)
        return 1
    return 1 if options.strict and not tally.complete else 0


def _add_evaluate(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Describe `obbhbb evaluate`."""
    parser = commands.add_parser(
        'evaluate', help='score all methods on labelled ships, by angle, aspect ratio and class'
    )
    _add_labels(parser, '+')
    parser.add_argument('--methods', nargs='+', metavar='METHOD', help='default: all')
    parser.add_argument(
        '--protocol', choices=('obb', 'hbb', 'both'), default='both',
        help='compare with the oriented box itself, with the reference box, or both (default)',
    )
    for name, meaning in (('q', 'shape exponent'), ('f', 'fullness'), ('s', 'shrink factor')):
        parser.add_argument(
            f'--{name}', type=float,
            help=f'{meaning} of the tunable methods; default: that of each method',
        )
    parser.add_argument(
        '--threshold', type=float, default=0.5, help='IoU that counts as a match (%(default)s)'
    )
    parser.add_argument(
        '--keep', type=float, default=0.95,
        help='part of the reference that a box has to keep to be counted (%(default)s)',
    )
    parser.add_argument(
        '--bootstrap', type=int, default=1000, help='samples for the intervals (%(default)s)'
    )
    parser.add_argument('--seed', type=int, default=0, help='seed of the samples (%(default)s)')
    parser.add_argument('--json', type=Path, help='write the scores here')
    parser.add_argument('--csv', type=Path, help='write the scores here')
    parser.add_argument('--plot', type=Path, help='draw mean IoU by angle here (extra `plots`)')
    parser.set_defaults(run=_evaluate)


def _evaluate(options: argparse.Namespace) -> int:
    """Score the methods."""
    from obbhbb_ros.study import evaluation

    settings = evaluation.Settings(
        options.threshold, options.keep, options.bootstrap, options.seed
    )
    rules = evaluation.choose_rules(options.methods, options.q, options.f, options.s)
    ships = _read_ships(options)
    protocols = ('obb', 'hbb') if options.protocol == 'both' else (options.protocol,)
    if options.protocol == 'both' and not ships.with_reference.any():
        print('no reference boxes: protocol obb only\n', file=sys.stderr)
        protocols = ('obb',)
    scores = evaluation.evaluate(ships, rules, protocols, settings)
    print(evaluation.score_tables(scores, settings))
    if options.json:
        evaluation.write_json(options.json, scores, settings)
    if options.csv:
        evaluation.write_csv(options.csv, scores)
    if options.plot:
        from obbhbb_ros.study import charts

        charts.save(charts.angle_figure(scores), options.plot)
    return 0


def _add_calibrate(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Describe `obbhbb calibrate`."""
    parser = commands.add_parser(
        'calibrate', help='find q, f and s on labelled ships; a parameter file for the node'
    )
    _add_labels(parser, '*')
    parser.add_argument(
        '--synthetic', action='store_true', help="the paper's synthetic hulls instead of labels"
    )
    parser.add_argument(
        '--method', choices=('superellipse', 'shape_aware'), default='superellipse',
        help='default: %(default)s',
    )
    parser.add_argument(
        '--objective', choices=('mean_iou', 'match50', 'coverage'), default='mean_iou',
        help='default: %(default)s; coverage: the smallest boxes of which SHARE keep KEEP',
    )
    parser.add_argument(
        '--grid', choices=('paper', 'wide'), default='paper', help='default: %(default)s'
    )
    parser.add_argument(
        '--refine', action=argparse.BooleanOptionalAction, default=True,
        help='go on from the best setting of the grid (default); without, it is Algorithm 2',
    )
    parser.add_argument(
        '--keep', type=float, default=0.95, help='part of the reference box (%(default)s)'
    )
    parser.add_argument('--share', type=float, default=0.95, help='share of ships (%(default)s)')
    parser.add_argument(
        '--exchangeable', choices=('ships', 'images'), default='ships',
        help='what coverage is guaranteed for: images takes the ships of an image as alike',
    )
    parser.add_argument(
        '--folds', type=int, default=5, help='of the cross-validation by image, 0 for none (5)'
    )
    parser.add_argument('--per-class', action='store_true', help='try a rule for each class')
    parser.add_argument(
        '--by-aspect', action='store_true', help='try rules for bands of aspect ratio'
    )
    parser.add_argument('--seed', type=int, default=0, help='seed of all splits (%(default)s)')
    parser.add_argument('-o', '--output', type=Path, help='parameter file to write')
    parser.set_defaults(run=_calibrate)


def _calibrate(options: argparse.Namespace) -> int:
    """Find a rule, say how good it is, write it for the node."""
    import shlex

    import numpy as np

    from obbhbb_ros.files import write_text
    from obbhbb_ros.study import calibration
    from obbhbb_ros.study import outcome

    ships = _ships_to_learn_from(options)
    plan = calibration.Plan(
        options.method, options.objective, calibration.GRIDS[options.grid], options.refine,
        options.keep, options.share,
        1 if options.exchangeable == 'ships' else int(np.bincount(ships.image_of).max()),
        options.seed,
    )
    found = outcome.run(
        ships, plan, options.folds,
        per_class=options.per_class, by_aspect=options.by_aspect, seed=options.seed,
    )
    text = outcome.outcome_text(found)
    print(text)
    if options.output:
        notes = [f'Written by: obbhbb {shlex.join(options.given)}', *text.splitlines()]
        # No detector calls its ships by the names of synthetic families.
        own = {} if options.synthetic else found.rule_of_class
        write_text(options.output, outcome.yaml_text(found.rule, own, notes))
        print(f'\nwritten: {options.output}')
    return 0


def _ships_to_learn_from(options: argparse.Namespace) -> Ships:
    """Draw or read ships that have reference boxes."""
    from obbhbb_ros.study.evaluation import ships_for
    from obbhbb_ros.study.hulls import synthetic_ships

    if options.synthetic == bool(options.labels):
        raise ValueError('give either label files or --synthetic')
    if options.synthetic:
        return synthetic_ships(seed=options.seed)
    return ships_for(_read_ships(options), 'hbb')


def _add_report(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Describe `obbhbb report`."""
    parser = commands.add_parser(
        'report', help='tables, curves and a gallery of labelled ships as one HTML page'
    )
    _add_labels(parser, '+')
    parser.add_argument(
        '-o', '--output', type=Path, default=Path('out/report.html'), help='default: %(default)s'
    )
    parser.add_argument(
        '--gallery', type=int, default=24, metavar='N',
        help='ships to draw, the worst first (%(default)s)',
    )
    parser.add_argument('--seed', type=int, default=0, help='seed of all samples (%(default)s)')
    parser.set_defaults(run=_report)


def _report(options: argparse.Namespace) -> int:
    """Write the page."""
    from obbhbb_ros.files import write_text
    from obbhbb_ros.study.report import report_page

    ships = _read_ships(options)
    title = ', '.join(path.name for path in options.labels)
    page = report_page(ships, title, gallery=options.gallery, seed=options.seed)
    write_text(options.output, page)
    print(f'written: {options.output}')
    return 0


def _add_labels(parser: argparse.ArgumentParser, count: str) -> None:
    """Describe the options that say which ships."""
    parser.add_argument(
        'labels', type=Path, nargs=count, metavar='LABELS', help='label files or folders'
    )
    parser.add_argument('--format', help='format of the labels; default: detected')
    parser.add_argument(
        '--reference', type=Path, metavar='FILE',
        help='labels with the reference boxes, matched by image and overlap',
    )
    parser.add_argument(
        '--image-size', type=int, nargs=2, metavar=('W', 'H'),
        help='pixels, for formats of normalised coordinates without images',
    )


def _read_ships(options: argparse.Namespace) -> Ships:
    """Read the ships; malformed records are reported, counted and left out."""
    from obbhbb_ros.study.progress import note
    from obbhbb_ros.study.ships import read_ships

    errors: list[LabelError] = []

    def report(error: LabelError) -> None:
        errors.append(error)
        note(f'obbhbb: left out: {error}')

    size = tuple(options.image_size) if options.image_size else None
    ships = read_ships(
        options.labels, options.format,
        reference=options.reference, image_size=size, on_error=report,
    )
    if options.reference:
        found = int(ships.with_reference.sum())
        note(f'obbhbb: {found} of {len(ships)} ships have a box in {options.reference}')
    if errors or ships.skipped:
        note(
            f'obbhbb: {len(errors)} malformed records and {ships.skipped} boxes without area left '
            f'out, {len(ships)} ships read'
        )
    return ships


if __name__ == '__main__':
    sys.exit(main())
