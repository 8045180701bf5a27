# SPDX-License-Identifier: Apache-2.0
"""The commands of `obbhbb`: their options, what they run and what they print."""

from __future__ import annotations

import argparse
import gc
import json
import math
import shlex
import shutil
import sys
from collections.abc import Callable
from collections.abc import Mapping
from collections.abc import Sequence
from pathlib import Path
from typing import Any
from typing import TypeAlias

import numpy as np

from obbhbb_ros import labels
from obbhbb_ros.downlink import chips
from obbhbb_ros.downlink.crops import CropSettings
from obbhbb_ros.files import write_bytes
from obbhbb_ros.files import write_text
from obbhbb_ros.geometry import converter
from obbhbb_ros.geometry.methods import METHODS
from obbhbb_ros.labels import FORMATS
from obbhbb_ros.labels import images
from obbhbb_ros.labels.axis_aligned import convert_file
from obbhbb_ros.labels.records import BOW_SOURCES
from obbhbb_ros.spool.spool import Spool
from obbhbb_ros.spool.spool import intact_chips
from obbhbb_ros.study import calibration
from obbhbb_ros.study import chip_costs
from obbhbb_ros.study import cross_validation
from obbhbb_ros.study import evaluation
from obbhbb_ros.study import rules
from obbhbb_ros.study import spools
from obbhbb_ros.study import tables
from obbhbb_ros.study.grid_search import GRIDS
from obbhbb_ros.study.harbour import harbour
from obbhbb_ros.study.harbour import passing
from obbhbb_ros.study.hulls import synthetic_ships
from obbhbb_ros.study.metrics import PROTOCOLS
from obbhbb_ros.study.parameter_file import yaml_text
from obbhbb_ros.study.progress import note
from obbhbb_ros.study.progress import track
from obbhbb_ros.study.ships import BOWS
from obbhbb_ros.study.ships import Ships
from obbhbb_ros.study.ships import read_ships

PARAMETERS = {
    'q': 'shape exponent, 1 to inf',
    'f': f'fullness, above 0, up to {converter.F_RANGE[1]:g}',
    's': f'shrink factor, above 0, up to {converter.S_RANGE[1]:g}',
}
_DEMO_IMAGES = 8
_Options: TypeAlias = argparse.Namespace
# The method `add_argument` of a parser.
_Add: TypeAlias = Callable[..., Any]


def command_line() -> argparse.ArgumentParser:
    """Describe the commands and their options."""
    parser = argparse.ArgumentParser(
        prog='obbhbb', description='Convert oriented boxes to axis-aligned ones, offline.'
    )
    parsers = parser.add_subparsers(required=True, metavar='COMMAND', dest='command')
    for name, (add_options, command) in COMMANDS.items():
        add_options(parsers.add_parser(name, help=command.__doc__).add_argument)
    return parser


def run(arguments: Sequence[str]) -> int:
    """Parse a command line, without the program's name, and run it; return the exit code."""
    options = command_line().parse_args(arguments, argparse.Namespace(given=list(arguments)))
    _, command = COMMANDS[options.command]
    return command(options)


def _demo_options(add: _Add) -> None:
    add('--picture', type=Path, default=Path('out/harbour.png'), help='default: %(default)s')
    add(
        '--bag',
        type=Path,
        help='bag (rosbag2, MCAP) to write; default: harbour_bag beside the picture, where it is '
        'replaced',
    )


def _demo(options: _Options) -> int:
    """Send a synthetic harbour through the real nodes; print a table, draw it, record a bag."""
    from obbhbb_ros.nodes.demo import boxes_by_method
    from obbhbb_ros.study import drawing

    if options.bag and options.bag.exists():
        raise ValueError(f'{options.bag} exists already')
    ships = harbour()
    boxes = boxes_by_method(ships)
    print(f'{len(ships.class_ids)} ships of a synthetic harbour, converted by the node over DDS\n')
    print(tables.scene_table(ships, boxes))
    drawing.save(drawing.scene_figure(ships, boxes), options.picture, dpi=100)
    print(f'\npicture: {options.picture}')
    _record_demo(ships, options.bag, options.picture.parent)
    return 0


def _record_demo(ships: labels.ImageLabels, bag: Path | None, folder: Path) -> None:
    """Record the nodes at work over a harbour, and keep what they saw; or say what that needs."""
    from obbhbb_ros.nodes import demo

    try:
        from obbhbb_ros.bags.recording import write_bag

        frames = [(each, chip_costs.render(each)) for each in passing(ships, _DEMO_IMAGES)]
    except ImportError as error:
        print(f'no bag, no overlay: {error}; they need the extras `bags` and `chips`')
        return
    messages = demo.record_chain(frames)
    write_bytes(folder / 'overlay.jpg', demo.last_overlay(messages))
    print(f'overlay: {folder / "overlay.jpg"}, the last picture of the node overlay')
    for each, pixels in frames:
        image = folder / 'frames' / f'{each.image}.jpg'
        write_bytes(image, chips.encode(pixels, chips.CodecSettings('jpeg', quality=90)))
    labels.write_labels(folder / 'frames' / 'labels.csv', [each for each, _ in frames])
    print(f'frames:  {folder / "frames"}, {len(frames)} images and their labels')
    if bag is None:
        bag = folder / 'harbour_bag'
        shutil.rmtree(bag, ignore_errors=True)
    write_bag(bag, demo.RECORDED_TOPICS, messages)
    print(f'bag:     {bag}, {len(messages)} messages on {len(demo.RECORDED_TOPICS)} topics')


def _convert_options(add: _Add) -> None:
    rule = converter.HullRule()
    written = [name for name, each in FORMATS.items() if each.write_boxes is not None]
    add('source', metavar='IN', type=Path, help='label file or folder to read')
    add('target', metavar='OUT', type=Path, help='file or folder to write')
    add(
        '--from',
        dest='source_format',
        metavar='FORMAT',
        help=f'format of IN: {", ".join(FORMATS)}; default: detected',
    )
    add(
        '--to',
        dest='target_format',
        metavar='FORMAT',
        help=f'format of OUT: {", ".join(written)}; default: by the suffix of OUT',
    )
    add('--method', default=rule.method, help=f'{", ".join(METHODS)}; default: %(default)s')
    _add_numbers(add, rule, PARAMETERS)
    _add_ends(add)
    add(
        '--bow',
        choices=BOW_SOURCES,
        default='none',
        help='where the bow is known: labels: as the labels say (head points of hrsc); first-edge: '
        'the first two corners of every box are its bow end; default: %(default)s',
    )
    add('--max-length', type=float, help='maximum of the longer side, pixels')
    add('--max-width', type=float, help='maximum of the shorter side, pixels')
    add(
        '--diagnostics',
        action='store_true',
        help='also write length, width, theta, t_x, t_y and capped of each box',
    )
    add(
        '--image-size',
        type=int,
        nargs=2,
        metavar=('W', 'H'),
        help='size of every image, pixels; default: from labels or images',
    )
    add(
        '--strict',
        action='store_true',
        help='exit with 1 if any record was malformed or could not be converted',
    )


def _convert(options: _Options) -> int:
    """Convert label files of oriented boxes to label files of axis-aligned boxes."""
    # Conversion makes many objects, and garbage collection would take a fifth of its time.
    ends = {'q_bow': options.q_bow, 'q_stern': options.q_stern}
    _warn_of_ends(options)
    gc.disable()
    try:
        tally = convert_file(
            options.source,
            options.target,
            converter.HullRule(options.method, options.q, options.f, options.s, **ends),
            converter.Caps(options.max_length, options.max_width),
            source_format=options.source_format,
            target_format=options.target_format,
            image_size=options.image_size,
            diagnostics=options.diagnostics,
            bow=options.bow,
            report=note,
            progress=lambda images, total: track(images, 'converting', total),
        )
    finally:
        gc.enable()
    print(tally)
    if not tally.readable:
        print(f'obbhbb: nothing to convert in {options.source}', file=sys.stderr)
        return 1
    return 1 if options.strict and not tally.complete else 0


def _evaluate_options(add: _Add) -> None:
    _add_labels(add, '+')
    add('--methods', nargs='+', metavar='METHOD', help=f'{", ".join(METHODS)}; default: all')
    meanings = '; '.join(f'{name}: {meaning}' for name, meaning in PROTOCOLS.items())
    add(
        '--protocol',
        choices=(*PROTOCOLS, 'both'),
        default='both',
        help=f'{meanings}; default: %(default)s',
    )
    for name, meaning in PARAMETERS.items():
        add(
            f'--{name}',
            type=float,
            help=f'{meaning}, of the tunable methods; default: that of each method',
        )
    _add_ends(add)
    _add_numbers(
        add,
        evaluation.DEFAULT_SETTINGS,
        {
            'threshold': 'lowest IoU of a match',
            'keep': 'share of the reference box that a box must contain to count as kept',
            'bootstrap': 'bootstrap samples for the confidence intervals, 0 for none',
            'seed': 'seed of the bootstrap samples',
        },
    )
    add('--json', type=Path, help='JSON file to write the scores to')
    add('--csv', type=Path, help='CSV file to write the scores to')
    add('--plot', type=Path, help='picture file for a chart of mean IoU by angle (extra `plots`)')


def _evaluate(options: _Options) -> int:
    """Score methods on labelled ships, by angle, aspect ratio and class."""
    settings = evaluation.Settings(options.threshold, options.keep, options.bootstrap, options.seed)
    _warn_of_ends(options)
    chosen = rules.choose_rules(
        options.methods, options.q, options.f, options.s, options.q_bow, options.q_stern
    )
    ships = _read_ships(options)
    protocols = tuple(PROTOCOLS) if options.protocol == 'both' else (options.protocol,)
    if options.protocol == 'both' and not ships.with_reference.any():
        print('no reference boxes: protocol obb only\n', file=sys.stderr)
        protocols = ('obb',)
    scores = evaluation.evaluate(ships, chosen, protocols, settings)
    found = evaluation.offsets(ships, chosen, settings) if 'hbb' in protocols else []
    print(tables.score_tables(scores, settings, found))
    if options.json:
        evaluation.write_json(options.json, scores, settings, found)
    if options.csv:
        evaluation.write_csv(options.csv, scores)
    if options.plot:
        from obbhbb_ros.study import drawing

        drawing.save(drawing.angle_figure(scores), options.plot)
    return 0


def _calibrate_options(add: _Add) -> None:
    plan = calibration.DEFAULT_PLAN
    _add_labels(add, '*')
    add('--synthetic', action='store_true', help="the paper's synthetic hulls instead of labels")
    add(
        '--method',
        choices=rules.TUNABLE_METHODS,
        default=plan.method,
        help='method to calibrate; default: %(default)s',
    )
    aims = '; '.join(f'{name}: {each.summary}' for name, each in calibration.OBJECTIVES.items())
    add(
        '--objective',
        choices=tuple(calibration.OBJECTIVES),
        default=plan.objective,
        help=f'{aims}; default: %(default)s',
    )
    add(
        '--grid',
        choices=tuple(GRIDS),
        default='paper',
        help='settings to search; default: %(default)s',
    )
    add(
        '--refine',
        action=argparse.BooleanOptionalAction,
        default=plan.refine,
        help='refine the best setting of the grid (default); --no-refine is Algorithm 2',
    )
    add(
        '--fit',
        choices=calibration.FITS,
        default=plan.fit,
        help='whether to fit f and s beside q: auto: if they gain '
        f'{calibration.LEAST_GAIN:g} or more on held-out images; default: %(default)s',
    )
    _add_numbers(
        add,
        plan,
        {
            'keep': 'objective coverage: share of the reference box that a box must contain',
            'share': 'objective coverage: share of ships whose box must contain that much',
            'seed': 'seed of all random splits',
        },
    )
    add(
        '--exchangeable',
        choices=('ships', 'images'),
        default='ships',
        help='objective coverage: what the guarantee assumes to be exchangeable; use images if '
        'the ships of an image are alike; default: %(default)s',
    )
    add(
        '--folds',
        type=int,
        default=5,
        help='folds of the cross-validation by image, 0 for none; default: %(default)s',
    )
    add('--per-class', action='store_true', help='try a rule for each class')
    add('--by-aspect', action='store_true', help='try a rule for each band of aspect ratio')
    add('-o', '--output', type=Path, help='parameter file to write')


def _calibrate(options: _Options) -> int:
    """Find q, f and s for labelled ships; write a parameter file for the node."""
    if options.synthetic == bool(options.labels):
        raise ValueError('give either label files or --synthetic')
    if options.synthetic:
        if options.bow not in ('none', 'hull'):
            raise ValueError(f'synthetic ships have no labels: --bow hull, not {options.bow}')
        ships = synthetic_ships(seed=options.seed)
        ships = ships.heading_by_hull() if options.bow == 'hull' else ships
    else:
        ships = evaluation.ships_for(_read_ships(options), 'hbb')
    by_image = options.exchangeable == 'images'
    plan = calibration.Plan(
        method=options.method,
        objective=options.objective,
        grid=GRIDS[options.grid],
        refine=options.refine,
        fit=options.fit,
        keep=options.keep,
        share=options.share,
        per_image=int(np.bincount(ships.image_of).max()) if by_image else 1,
        seed=options.seed,
    )
    outcome = cross_validation.run(
        ships,
        plan,
        options.folds,
        per_class=options.per_class,
        by_aspect=options.by_aspect,
        seed=options.seed,
    )
    text = tables.outcome_text(outcome)
    print(text)
    if options.output:
        notes = [f'Written by: obbhbb {shlex.join(options.given)}', *text.splitlines()]
        # The class names of synthetic ships are not those of any detector.
        own = {} if options.synthetic else outcome.rule_of_class
        write_text(options.output, yaml_text(outcome.rule, own, notes))
        print(f'\nwritten: {options.output}')
    return 0


def _report_options(add: _Add) -> None:
    _add_labels(add, '+')
    add('-o', '--output', type=Path, default=Path('out/report.html'), help='default: %(default)s')
    add(
        '--gallery',
        type=int,
        default=24,
        metavar='N',
        help='maximum number of ships to draw, the worst first; default: %(default)s',
    )
    _add_numbers(add, evaluation.DEFAULT_SETTINGS, {'seed': 'seed of all random numbers'})


def _report(options: _Options) -> int:
    """Write tables, curves and a gallery of labelled ships to one HTML page."""
    from obbhbb_ros.study.report import report_page

    ships = _read_ships(options)
    title = ', '.join(path.name for path in options.labels)
    page = report_page(ships, title, gallery=options.gallery, seed=options.seed)
    write_text(options.output, page)
    print(f'written: {options.output}')
    return 0


def _chips_options(add: _Add) -> None:
    add(
        'labels',
        type=Path,
        nargs='?',
        help='label file or folder with the images beside it; default: a synthetic harbour',
    )
    _add_numbers(add, CropSettings(), {'padding': 'fraction of the box to add on each side'})
    add('--picture', type=Path, help='picture file for the first image and the costs')


def _chips(options: _Options) -> int:
    """Compare the size of the chips of each method: pixels, and bytes by codec."""
    if options.labels is None:
        what, source = 'a synthetic harbour (no real pixels)', harbour()
        pictures = [(source, chip_costs.render(source))]
    else:
        found = list(labels.read_labels(options.labels))
        pictures = [
            (each, np.atleast_3d(images.load_image(path)[1]))
            for each, path in zip(found, images.find_images(found), strict=True)
            if path is not None
        ]
        what = f'{options.labels}, {len(pictures)} of {len(found)} images found'
    if not pictures:
        raise ValueError(f'no image found for the labels in {options.labels}')
    costs = chip_costs.chip_costs(pictures, CropSettings(padding=options.padding))
    print(f'chips of {what}; difference from outer in brackets\n')
    print(tables.cost_table(costs))
    if options.picture:
        from obbhbb_ros.study import drawing

        drawing.save(drawing.cost_figure(costs, *pictures[0], what), options.picture, dpi=75)
        print(f'\npicture: {options.picture}')
    return 0


def _bag_options(add: _Add) -> None:
    add('source', metavar='IN', type=Path, help='bag (rosbag2) or storage file of one to read')
    add('target', metavar='OUT', type=Path, help='bag to write')
    add(
        '--params-file',
        type=Path,
        metavar='FILE',
        help='ROS parameter file of the node; default: the defaults of the node',
    )
    add(
        '--node',
        metavar='NAME',
        default='',
        help='full name of the node in FILE; default: obb_to_hbb in the namespace of the topic',
    )
    add('--topic', default='', help='topic of the detections; default: the only one there is')
    add(
        '--camera-info',
        metavar='TOPIC',
        default='',
        help='topic that the image size is taken from; default: camera_info beside the detections',
    )
    add('--replace', action='store_true', help='leave out the boxes and crop regions of IN')
    add('--storage', choices=('mcap', 'sqlite3'), default='', help='storage of OUT; default: as IN')
    add(
        '--compression',
        choices=('none', 'file', 'message', 'storage'),
        default='',
        help='what is compressed with zstd in OUT: nothing, the file as a whole, each message, or '
        'the chunks of mcap; default: as IN',
    )
    add(
        '--strict',
        action='store_true',
        help='exit with 1 if anything was lost, unreadable or could not be converted',
    )


def _bag(options: _Options) -> int:
    """Write a recorded bag with the boxes and crop regions that the node would have sent."""
    from obbhbb_ros.bags import replay

    gc.disable()
    try:
        tally = replay.add_boxes(
            options.source,
            options.target,
            replay.Options(
                topic=options.topic,
                camera_info=options.camera_info,
                params_file=options.params_file,
                node=options.node,
                storage=options.storage,
                compression=options.compression,
                replace=options.replace,
            ),
            report=lambda text: note(f'obbhbb: {text}'),
            progress=lambda messages, total: track(messages, 'converting', total, 'messages'),
        )
    finally:
        gc.enable()
    print(f'{tally}\nwritten: {options.target}')
    return 1 if options.strict and not tally.complete else 0


def _gallery_options(add: _Add) -> None:
    add('outbox', type=Path, metavar='OUTBOX', help='outbox, or folder that received its files')
    add('-o', '--output', type=Path, default=Path('out/gallery.html'), help='default: %(default)s')
    add(
        '--limit',
        type=int,
        default=0,
        metavar='N',
        help='maximum number of chips to show, the most valuable first; default: 0, all',
    )


def _gallery(options: _Options) -> int:
    """Show what came down: the chips of an outbox, most valuable first, on one HTML page."""
    from obbhbb_ros.study.gallery import gallery_page
    from obbhbb_ros.study.gallery import read_received

    # Resolved, as links from one to the other do not lead through symbolic links.
    outbox, beside = options.outbox.resolve(), options.output.resolve().parent
    received = read_received(outbox)
    if not received.chips and not received.problems:
        raise ValueError(f'{options.outbox}: no chips found')
    page = gallery_page(received, beside, outbox.name, options.limit)
    write_text(options.output, page)
    for problem in received.problems:
        note(f'obbhbb: {problem}')
    print(f'chips: {len(received.chips)}, problems: {len(received.problems)}')
    print(f'written: {options.output}')
    return 0


_CHIPS_LISTED, _EXPORTED = 20, Path('out/chips')
# Options of `obbhbb spool` that one action takes.
_OF_ONE_ACTION = {
    'limit': 'list',
    'json': 'list',
    'to': 'revalue',
    'by': 'revalue',
    'output': 'export',
}


def _spool_options(add: _Add) -> None:
    add(
        'spool',
        type=Path,
        metavar='PATH',
        help='folder of the spool; for export also a damaged catalogue, chips_*.sqlite3',
    )
    add(
        'action',
        nargs='?',
        default='list',
        choices=tuple(SPOOL_ACTIONS),
        help=' '.join(f'{name}: {each.__doc__}' for name, each in SPOOL_ACTIONS.items())
        + ' Default: %(default)s',
    )
    add(
        '--class',
        dest='class_ids',
        nargs='+',
        default=(),
        metavar='CLASS',
        help='only chips of these classes',
    )
    add('--id', dest='ids', nargs='+', default=(), metavar='ID', help='only these chips')
    add(
        '--min-value',
        type=float,
        default=-math.inf,
        metavar='V',
        help='only chips of this value or more',
    )
    add(
        '--max-value',
        type=float,
        default=math.inf,
        metavar='V',
        help='only chips of this value or less',
    )
    add('--all', action='store_true', help='delete or revalue all chips, without a condition')
    add(
        '--limit',
        type=int,
        metavar='N',
        help=f'list: maximum number of chips (0: all); default: {_CHIPS_LISTED}',
    )
    add('--json', action='store_true', help='list: print JSON')
    add('--to', type=float, metavar='V', help='revalue: the new value')
    add('--by', type=float, metavar='F', help='revalue: factor on the value, 0 or more')
    add('-o', '--output', type=Path, help=f'export: folder to write to; default: {_EXPORTED}')


def _spool(options: _Options) -> int:
    """List, check, revalue, delete or export the chips of a spool."""
    for name, action in _OF_ONE_ACTION.items():
        given = getattr(options, name)
        if action != options.action and given is not None and given is not False:
            raise ValueError(f'{options.action}: takes no --{name}, it is for {action}')
    condition = spools.Condition(
        options.class_ids, options.ids, options.min_value, options.max_value
    )
    if options.spool.is_file() and options.action == 'export':
        chips = (each for each in intact_chips(options.spool) if condition.matches(each[0]))
        print(f'{spools.export(chips, options.output or _EXPORTED)} chips exported')
        return 0
    if options.action in ('delete', 'revalue') and condition.is_any and not options.all:
        raise ValueError(f'{options.action}: which chips? Give a condition, or --all')
    if options.action in ('check', 'forget-outbox') and not condition.is_any:
        raise ValueError(f'{options.action}: takes no condition, it is for the whole spool')
    spool = spools.open_spool(options.spool)
    try:
        return SPOOL_ACTIONS[options.action](spool, condition, options)
    finally:
        spool.close()


def _list_spool(spool: Spool, condition: spools.Condition, options: _Options) -> int:
    """Show the books, and the chips that are released next."""
    limit = _CHIPS_LISTED if options.limit is None else options.limit or -1
    chips, status = spool.select(*condition.sql(), limit), spool.status()
    if options.json:
        print(json.dumps(spools.as_json(status, chips), indent=1, ensure_ascii=False))
    else:
        print(spools.status_text(status) + '\n\n' + spools.chip_table(chips))
    return 0


def _check_spool(spool: Spool, condition: spools.Condition, options: _Options) -> int:
    """Check catalogue, books and files."""
    wrong = list(spools.wrong_with(spool))
    print('\n'.join(wrong) or f'{options.spool} is in order')
    return 1 if wrong else 0


def _revalue_spool(spool: Spool, condition: spools.Condition, options: _Options) -> int:
    """Give waiting chips another value, and so another place in the order."""
    if (options.to is None) == (options.by is None):
        raise ValueError('revalue: give either --to or --by')
    factor, addend = (0.0, options.to) if options.by is None else (options.by, 0.0)
    if not math.isfinite(factor + addend):
        raise ValueError('revalue: the value must be finite')
    if factor < 0.0:
        raise ValueError('revalue: --by must be 0 or more: less would turn the order round')
    print(f'{spool.revalue(*condition.sql(), factor, addend)} chips revalued')
    return 0


def _delete_from_spool(spool: Spool, condition: spools.Condition, options: _Options) -> int:
    """Delete waiting chips."""
    print(f'{spool.delete(*condition.sql())} chips deleted')
    return 0


def _export_spool(spool: Spool, condition: spools.Condition, options: _Options) -> int:
    """Write chips and their JSON to a folder, and leave them in the spool."""
    chips = spools.files_of(spool, spool.select(*condition.sql()))
    print(f'{spools.export(chips, options.output or _EXPORTED)} chips exported')
    return 0


def _forget_outbox(spool: Spool, condition: spools.Condition, options: _Options) -> int:
    """Count the chips in a lost outbox as evicted, so that another one is used."""
    print(f'{spool.forget_outbox()} chips counted as evicted')
    return 0


# The docstring of the function that carries out an action is its help.
SPOOL_ACTIONS: dict[str, Callable[[Spool, spools.Condition, _Options], int]] = {
    'list': _list_spool,
    'check': _check_spool,
    'revalue': _revalue_spool,
    'delete': _delete_from_spool,
    'export': _export_spool,
    'forget-outbox': _forget_outbox,
}


# The docstring of the function that runs a command is its help.
COMMANDS: dict[str, tuple[Callable[[_Add], None], Callable[[_Options], int]]] = {
    'demo': (_demo_options, _demo),
    'convert': (_convert_options, _convert),
    'evaluate': (_evaluate_options, _evaluate),
    'calibrate': (_calibrate_options, _calibrate),
    'report': (_report_options, _report),
    'chips': (_chips_options, _chips),
    'bag': (_bag_options, _bag),
    'gallery': (_gallery_options, _gallery),
    'spool': (_spool_options, _spool),
}


def _add_labels(add: _Add, count: str) -> None:
    """Add the options that select the ships to read."""
    add('labels', type=Path, nargs=count, metavar='LABELS', help='label files or folders')
    add('--format', help=f'{", ".join(FORMATS)}; default: detected')
    add(
        '--reference',
        type=Path,
        metavar='FILE',
        help='labels with the reference boxes, matched by image and overlap',
    )
    add(
        '--image-size',
        type=int,
        nargs=2,
        metavar=('W', 'H'),
        help='size of every image, pixels, for normalised formats without images',
    )
    add(
        '--bow',
        choices=BOWS,
        default='none',
        help='where the bow is known: labels: as the labels say (head points of hrsc); first-edge: '
        'the first two corners of every box are its bow end; hull: the end of the hull with less '
        'area; default: %(default)s',
    )


def _add_ends(add: _Add) -> None:
    """Add the options for hulls whose bow is known."""
    for end in ('bow', 'stern'):
        add(
            f'--q-{end}',
            type=float,
            help=f'shape exponent of the {end} where the bow is known, 1 to inf; default: q',
        )


def _warn_of_ends(options: _Options) -> None:
    """Say it if q_bow or q_stern is given, but no bow is known."""
    if options.bow == 'none' and not options.q_bow is options.q_stern is None:
        note('obbhbb: --q-bow and --q-stern have no effect without --bow')


def _add_numbers(add: _Add, defaults: object, meanings: Mapping[str, str]) -> None:
    """Add options for numbers whose names, types and defaults are those of an object."""
    for name, meaning in meanings.items():
        default = getattr(defaults, name)
        add(f'--{name}', type=type(default), default=default, help=f'{meaning}; default: {default}')


def _read_ships(options: _Options) -> Ships:
    """Read the ships; report malformed records, count them and leave them out."""
    errors: list[labels.LabelError] = []

    def report(error: labels.LabelError) -> None:
        errors.append(error)
        note(f'obbhbb: left out: {error}')

    size = tuple(options.image_size) if options.image_size else None
    ships = read_ships(
        options.labels,
        options.format,
        reference=options.reference,
        image_size=size,
        bow=options.bow,
        on_error=report,
    )
    if options.reference:
        found = int(ships.with_reference.sum())
        note(f'obbhbb: {found} of {len(ships)} ships have a box in {options.reference}')
    if options.bow != 'none':
        note(f'obbhbb: the bow of {int(ships.with_bow.sum())} of {len(ships)} ships is known')
    if errors or ships.skipped:
        note(
            f'obbhbb: {len(errors)} malformed records and {ships.skipped} boxes without area left '
            f'out, {len(ships)} ships read'
        )
    return ships
