# SPDX-License-Identifier: Apache-2.0
"""obbhbb evaluate, calibrate, report: the whole way from files to files."""

import json
import re

import numpy as np
import pytest
import yaml
from fleets import REAL
from fleets import labels

from obbhbb_ros import convert
from obbhbb_ros.cli import main
from obbhbb_ros.labels import write_labels
from obbhbb_ros.study.__main__ import main as print_comparison
from obbhbb_ros.study.metrics import iou
from obbhbb_ros.study.ships import read_ships

SIGNATURES = {'.png': b'\x89PNG', '.svg': b'<?xml', '.pdf': b'%PDF'}


def test_evaluate_prints_tables_and_writes_files(tmp_path, capsys) -> None:
    files = [tmp_path / 'new' / name for name in ('a.json', 'b.csv')]
    code = main(
        [
            'evaluate',
            str(REAL),
            '--bootstrap',
            '20',
            '--methods',
            'superellipse',
            'outer',
            '--json',
            str(files[0]),
            '--csv',
            str(files[1]),
        ]
    )
    out = capsys.readouterr().out
    assert code == 0
    assert 'protocol obb: against the oriented box itself, 40 ships in' in out
    assert re.search(r'^superellipse +3 / 1 / 1 +0\.9200 ', out, re.MULTILINE)
    scores = json.loads(files[0].read_text(encoding='utf-8'))['scores']
    assert {score['method'] for score in scores} == {'superellipse', 'outer'}
    assert len(files[1].read_text(encoding='utf-8').splitlines()) == len(scores) + 1


def test_parameters_given_to_evaluate_are_those_it_scores(capsys) -> None:
    arguments = ['--methods', 'superellipse', '--protocol', 'hbb', '--bootstrap', '0']
    assert main(['evaluate', str(REAL), *arguments, '--q', '4', '--f', '0.9', '--s', '1.02']) == 0
    ships = read_ships([REAL])
    expected = iou(convert(ships.boxes, q=4.0, f=0.9, s=1.02), ships.reference).mean()
    assert f'4 / 0.9 / 1.02    {expected:.4f}' in capsys.readouterr().out


@pytest.mark.parametrize('suffix', SIGNATURES)
def test_evaluate_draws_the_angle_curves(tmp_path, suffix) -> None:
    pytest.importorskip('matplotlib')
    picture = tmp_path / 'new' / f'angles{suffix}'
    assert main(['evaluate', str(REAL), '--bootstrap', '0', '--plot', str(picture)]) == 0
    assert picture.read_bytes().startswith(SIGNATURES[suffix])


def test_without_reference_boxes_the_oriented_boxes_are_compared_with(tmp_path, capsys) -> None:
    write_labels(tmp_path / 'ships.csv', [labels('a', [[0, 0, 20, 10]])])
    assert main(['evaluate', str(tmp_path / 'ships.csv')]) == 0
    printed = capsys.readouterr()
    assert 'no reference boxes: protocol obb only' in printed.err
    assert 'protocol hbb' not in printed.out
    assert main(['evaluate', str(tmp_path / 'ships.csv'), '--protocol', 'hbb']) == 1
    assert 'no ship has a reference box' in capsys.readouterr().err


def test_reference_boxes_of_another_file_are_matched(tmp_path, capsys) -> None:
    write_labels(tmp_path / 'ships.csv', [labels('a', [[0, 0, 20, 10]])])
    drawn = [[0.0, 0.0, 20.0, 8.0]]
    write_labels(tmp_path / 'drawn.csv', [labels('a', drawn, drawn)])
    code = main(
        [
            'evaluate',
            str(tmp_path / 'ships.csv'),
            '--reference',
            str(tmp_path / 'drawn.csv'),
            '--protocol',
            'hbb',
            '--methods',
            'outer',
            '--bootstrap',
            '0',
        ]
    )
    assert code == 0
    printed = capsys.readouterr()
    assert re.search(r'^outer +0\.8000 ', printed.out, re.MULTILINE)
    assert '1 of 1 ships have a box in' in printed.err


def test_a_malformed_record_is_reported_counted_and_left_out(tmp_path, capsys) -> None:
    path = tmp_path / 'ships.csv'
    path.write_text(REAL.read_text(encoding='utf-8') + 'x,1,ship,1,2,three\n', encoding='utf-8')
    assert main(['evaluate', str(path), '--bootstrap', '0']) == 0
    error = capsys.readouterr().err
    assert f'left out: {path}:42: ' in error
    assert '1 malformed records and 0 boxes without area left out, 40 ships read' in error


def test_calibrate_writes_the_parameters_that_it_prints(tmp_path, capsys) -> None:
    path = tmp_path / 'new' / 'params.yaml'
    assert main(['calibrate', str(REAL), '--folds', '3', '-o', str(path)]) == 0
    out = capsys.readouterr().out
    values = yaml.safe_load(path.read_text(encoding='utf-8'))['/**']['ros__parameters']
    assert values['method'] == 'superellipse'
    assert f'# Written by: obbhbb calibrate {REAL} --folds 3 -o' in path.read_text('utf-8')
    assert 'q {q:.4g}, f {f:.4g}, s {s:.4g}'.format(**values) in out
    assert 'protocol hbb, held out' in out
    ships = read_ships([REAL])
    assert iou(convert(ships.boxes, **values), ships.reference).mean() > 0.92


def test_without_refinement_a_setting_of_the_grid_is_written(tmp_path) -> None:
    path = tmp_path / 'params.yaml'
    arguments = ['--method', 'shape_aware', '--no-refine', '--folds', '0', '-o', str(path)]
    assert main(['calibrate', '--synthetic', *arguments]) == 0
    values = yaml.safe_load(path.read_text(encoding='utf-8'))['/**']['ros__parameters']
    # The paper reports 2.2 / 0.9 / 1.0; see doc/reproduction.md.
    assert values == {'method': 'shape_aware', 'q': 2.6, 'f': 0.9, 's': 1.1}


@pytest.mark.parametrize(
    ('arguments', 'message'),
    [
        ([], 'give either label files or --synthetic'),
        ([str(REAL), '--synthetic'], 'give either label files or --synthetic'),
        ([str(REAL), '--objective', 'coverage', '--share', '0.99'], 'ships are too few'),
        ([str(REAL), '--folds', '500'], 'images cannot be split into 500 folds'),
        (['no/such/file.csv'], 'no/such/file.csv'),
    ],
)
def test_calibrate_says_what_is_wrong(arguments, message, capsys) -> None:
    assert main(['calibrate', *arguments]) == 1
    assert message in capsys.readouterr().err


def test_coverage_holds_on_the_ships_it_was_calibrated_for(tmp_path) -> None:
    path = tmp_path / 'params.yaml'
    arguments = ['--objective', 'coverage', '--keep', '0.9', '--share', '0.8', '--folds', '0']
    assert main(['calibrate', str(REAL), *arguments, '-o', str(path)]) == 0
    values = yaml.safe_load(path.read_text(encoding='utf-8'))['/**']['ros__parameters']
    ships = read_ships([REAL])
    box = convert(ships.boxes, **values)
    sides = np.minimum(box[:, 2:], ships.reference[:, 2:]) - np.maximum(
        box[:, :2], ships.reference[:, :2]
    )
    reference_sides = ships.reference[:, 2:] - ships.reference[:, :2]
    assert np.mean(sides.prod(axis=1) >= 0.9 * reference_sides.prod(axis=1)) >= 0.75


def test_the_comparison_with_table_1_is_printed_and_the_hulls_drawn(tmp_path, capsys) -> None:
    pytest.importorskip('matplotlib')
    print_comparison([str(tmp_path / 'hulls.png')])
    out = capsys.readouterr().out
    assert re.search(r'^1\.00 N +0\.000  0\.000  fitted', out, re.MULTILINE)
    assert 'M (midpoint): mean absolute deviation 0.00' in out
    assert (tmp_path / 'hulls.png').read_bytes().startswith(SIGNATURES['.png'])


def test_a_negative_gallery_is_refused(capsys) -> None:
    assert main(['report', str(REAL), '--gallery', '-1']) == 1
    assert 'gallery must be 0 or more' in capsys.readouterr().err
