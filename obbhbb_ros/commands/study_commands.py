# SPDX-License-Identifier: Apache-2.0
"""The commands `obbhbb evaluate`, `calibrate` and `report`."""

from __future__ import annotations

import argparse
import sys
from argparse import ArgumentParser
from argparse import Namespace
from pathlib import Path

import numpy as np

from obbhbb_ros.commands.shared_options import PARAMETERS
from obbhbb_ros.commands.shared_options import add_choice_option
from obbhbb_ros.commands.shared_options import add_end_options
from obbhbb_ros.commands.shared_options import add_label_options
from obbhbb_ros.commands.shared_options import add_number_options
from obbhbb_ros.commands.shared_options import read_labelled_ships
from obbhbb_ros.commands.shared_options import warn_of_ends
from obbhbb_ros.files import write_text
from obbhbb_ros.geometry.methods import METHODS
from obbhbb_ros.study import calibration
from obbhbb_ros.study import cross_validation
from obbhbb_ros.study import evaluation
from obbhbb_ros.study import rules
from obbhbb_ros.study import tables
from obbhbb_ros.study.cautions import cautions
from obbhbb_ros.study.coverage import Coverage
from obbhbb_ros.study.grid_search import GRIDS
from obbhbb_ros.study.hulls import synthetic_ships
from obbhbb_ros.study.metrics import PROTOCOLS
from obbhbb_ros.study.rule_file import yaml_text

_FITS = {'auto': calibration.Fit.AUTO, 'all': calibration.Fit.ALWAYS, 'q': calibration.Fit.NEVER}


def add_evaluate_options(parser: ArgumentParser) -> None:
    """Add the options of `obbhbb evaluate`."""
    add = parser.add_argument
    add_label_options(parser, '+')
    add('--methods', nargs='+', metavar='METHOD', help=f'{", ".join(METHODS)}; default: all')
    meanings = '; '.join(f'{name}: {meaning}' for name, meaning in PROTOCOLS.items())
    add_choice_option(parser, 'protocol', (*PROTOCOLS, 'both'), 'both', meanings)
    for name, meaning in PARAMETERS.items():
        add(
            f'--{name}',
            type=float,
            help=f'{meaning}, of the tunable methods; default: that of each method',
        )
    add_end_options(parser)
    add_number_options(
        parser,
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


def run_evaluate(options: Namespace) -> None:
    """Score methods on labelled ships, by angle, aspect ratio and class."""
    settings = evaluation.EvaluationSettings(
        options.threshold, options.keep, options.bootstrap, options.seed
    )
    warn_of_ends(options)
    chosen = rules.choose_rules(
        options.methods, options.q, options.f, options.s, options.q_bow, options.q_stern
    )
    ships = read_labelled_ships(options)
    protocols = tuple(PROTOCOLS) if options.protocol == 'both' else (options.protocol,)
    if options.protocol == 'both' and not ships.with_reference.any():
        print('no reference boxes: protocol obb only\n', file=sys.stderr)
        protocols = ('obb',)
    scores = evaluation.evaluate(ships, chosen, protocols, settings)
    offsets = evaluation.offsets(ships, chosen, settings) if 'hbb' in protocols else []
    print(tables.score_tables(scores, settings, offsets, cautions(ships)))
    if options.json:
        evaluation.write_json(options.json, scores, settings, offsets)
    if options.csv:
        evaluation.write_csv(options.csv, scores)
    if options.plot:
        from obbhbb_ros.study import figures

        figures.save(figures.angle_figure(scores), options.plot)


def add_calibrate_options(parser: ArgumentParser) -> None:
    """Add the options of `obbhbb calibrate`."""
    add = parser.add_argument
    plan = calibration.DEFAULT_PLAN
    add_label_options(parser, '*')
    add('--synthetic', action='store_true', help="the paper's synthetic hulls instead of labels")
    add_choice_option(parser, 'method', rules.TUNABLE_METHODS, plan.method, 'method to calibrate')
    aims = '; '.join(f'{name}: {aim.summary}' for name, aim in calibration.OBJECTIVES.items())
    add_choice_option(parser, 'objective', calibration.OBJECTIVES, plan.objective.name, aims)
    add_choice_option(parser, 'grid', GRIDS, 'paper', 'settings to search')
    add(
        '--refine',
        action=argparse.BooleanOptionalAction,
        default=plan.refine,
        help='refine the best setting of the grid (default); --no-refine is Algorithm 2',
    )
    gain = f'{calibration.MIN_GAIN:g} or more on held-out images'
    fits = f'whether to fit f and s beside q: auto: if they gain {gain}'
    add_choice_option(parser, 'fit', _FITS, 'auto', fits)
    add_number_options(
        parser,
        Coverage(),
        {
            'keep': 'objective coverage: share of the reference box that a box must contain',
            'share': 'objective coverage: share of ships whose box must contain that much',
        },
    )
    add_number_options(parser, plan, {'seed': 'seed of all random splits'})
    exchangeable = (
        'objective coverage: what the guarantee assumes to be exchangeable; use images if '
        'the ships of an image are alike'
    )
    add_choice_option(parser, 'exchangeable', ('ships', 'images'), 'ships', exchangeable)
    add(
        '--folds',
        type=int,
        default=5,
        help='folds of the cross-validation by image, 0 for none; default: %(default)s',
    )
    add('--per-class', action='store_true', help='try a rule for each class')
    add('--by-aspect', action='store_true', help='try a rule for each band of aspect ratio')
    add('-o', '--output', type=Path, help='parameter file to write')


def run_calibrate(options: Namespace) -> None:
    """Find q, f and s for labelled ships; write a parameter file for the node."""
    if options.synthetic == bool(options.labels):
        raise ValueError('give either label files or --synthetic')
    if options.synthetic:
        if options.bow not in ('none', 'hull'):
            raise ValueError(f'synthetic ships have no labels: --bow hull, not {options.bow}')
        ships = synthetic_ships(seed=options.seed)
        ships = ships.heading_by_hull() if options.bow == 'hull' else ships
    else:
        ships = evaluation.ships_for(read_labelled_ships(options), 'hbb')
    by_image = options.exchangeable == 'images'
    plan = calibration.CalibrationPlan(
        method=options.method,
        objective=calibration.make_objective(
            options.objective,
            keep=options.keep,
            share=options.share,
            per_image=int(np.bincount(ships.image_of).max()) if by_image else 1,
        ),
        grid=GRIDS[options.grid],
        refine=options.refine,
        f_and_s=_FITS[options.fit],
        seed=options.seed,
    )
    result = cross_validation.run(
        ships, plan, options.folds, per_class=options.per_class, by_aspect=options.by_aspect
    )
    text = tables.calibration_text(result)
    print(text)
    if options.output:
        notes = [f'Written by: {options.invocation}', *text.splitlines()]
        # The class names of synthetic ships are not those of any detector.
        rule_of_class = {} if options.synthetic else result.rule_of_class
        write_text(options.output, yaml_text(result.rule, rule_of_class, notes))
        print(f'\nwritten: {options.output}')


def add_report_options(parser: ArgumentParser) -> None:
    """Add the options of `obbhbb report`."""
    add = parser.add_argument
    add_label_options(parser, '+')
    add('-o', '--output', type=Path, default=Path('out/report.html'), help='default: %(default)s')
    add(
        '--gallery',
        type=int,
        default=24,
        metavar='N',
        help='maximum number of ships to draw, the worst first; default: %(default)s',
    )
    add_number_options(parser, evaluation.DEFAULT_SETTINGS, {'seed': 'seed of all random numbers'})


def run_report(options: Namespace) -> None:
    """Write tables, curves and a gallery of labelled ships to one HTML page."""
    from obbhbb_ros.study.report import report_page

    ships = read_labelled_ships(options)
    title = ', '.join(path.name for path in options.labels)
    page = report_page(
        ships, title, gallery=options.gallery, seed=options.seed, command=options.invocation
    )
    write_text(options.output, page)
    print(f'written: {options.output}')
