# SPDX-License-Identifier: Apache-2.0
"""The bow from the hull, and q_bow and q_stern from ships whose bow is known."""

from dataclasses import replace

import numpy as np
import pytest
import yaml
from fleets import fleet
from fleets import labels
from hypothesis import given
from hypothesis import strategies as st

from obbhbb_ros import OrientedBoxes
from obbhbb_ros.cli import main
from obbhbb_ros.geometry.converter import HullRule
from obbhbb_ros.geometry.converter import convert_by_rule
from obbhbb_ros.labels import write_labels
from obbhbb_ros.study.bows import bow_sides
from obbhbb_ros.study.bows import with_bows
from obbhbb_ros.study.calibration import CalibrationPlan
from obbhbb_ros.study.calibration import Fit
from obbhbb_ros.study.calibration import bow_gain
from obbhbb_ros.study.calibration import calibrate
from obbhbb_ros.study.calibration import decide
from obbhbb_ros.study.calibration import fit_bow_and_stern
from obbhbb_ros.study.coverage import Coverage
from obbhbb_ros.study.cross_validation import run
from obbhbb_ros.study.folds import split
from obbhbb_ros.study.harbour import harbour
from obbhbb_ros.study.hulls import FAMILIES
from obbhbb_ros.study.hulls import synthetic_ships
from obbhbb_ros.study.metrics import iou
from obbhbb_ros.study.objectives import MeanIou
from obbhbb_ros.study.ships import Ships
from obbhbb_ros.study.tables import calibration_text

# In the unit box, bow at +x.
POINTED = np.array([(-1.0, -1.0), (0.5, -1.0), (1.0, 0.0), (0.5, 1.0), (-1.0, 1.0)])
TWO_ENDS = HullRule(q=2.6, q_bow=1.8, q_stern=5.0)


def placed(x, y, length, width, theta):
    """Put the pointed hull on a ship that heads to theta."""
    turn = np.array([[np.cos(theta), np.sin(theta)], [-np.sin(theta), np.cos(theta)]])
    return POINTED * [length / 2, width / 2] @ turn + [x, y]


@given(
    x=st.floats(-1e3, 1e3),
    y=st.floats(-1e3, 1e3),
    length=st.floats(5.0, 200.0),
    slimness=st.floats(1.2, 9.0),
    theta=st.floats(-np.pi, np.pi),
)
def test_the_bow_is_where_the_hull_is_pointed_however_the_ship_lies(
    x, y, length, slimness, theta
) -> None:
    boxes = OrientedBoxes.from_xywhr([[x, y, length, length / slimness, theta]])
    sides = bow_sides(boxes, [placed(x, y, length, length / slimness, theta)])
    bow = with_bows(boxes, sides).first[0]
    assert bow == pytest.approx(np.array([np.cos(theta), np.sin(theta)]) * length / 2, abs=1e-6)


def test_without_a_hull_or_with_ends_alike_the_bow_is_not_known() -> None:
    boxes = OrientedBoxes.from_xywhr([[0, 0, 40, 10, 0.3]] * 2)
    known = with_bows(boxes, bow_sides(boxes, [None, boxes.corners[1]]))
    assert known.bow.tolist() == [False, False]


def test_the_end_with_less_area_in_the_outer_30_percent_counts() -> None:
    # A notch forward of amidships that ends short of the last 30 %, 4 px from the centre.
    boxes = OrientedBoxes.from_xywhr([[0.0, 0, 20, 4, 0]])
    amidships = np.array(
        [
            (-10, -2),
            (1, -2),
            (1, 0),
            (3.9, 0),
            (3.9, -2),
            (10, -2),
            (10, 2),
            (-10, 2.0),
        ]
    )
    forward = amidships.copy()
    forward[3:5, 0] = 4.5
    assert bow_sides(boxes, [amidships]).tolist() == [0]
    assert bow_sides(boxes, [forward]).tolist() == [1]


def test_boxes_with_bows_are_converted_to_the_same_boxes_by_one_q() -> None:
    random = np.random.default_rng(3)
    rows = np.column_stack(
        (
            random.uniform(0, 500, (200, 2)),
            random.uniform(2, 90, (200, 2)),
            random.uniform(-4, 4, 200),
        )
    )
    boxes = OrientedBoxes.from_xywhr(rows)
    known = with_bows(boxes, random.choice(np.array([-1, 0, 1], np.int8), 200))
    expected = convert_by_rule(boxes, HullRule(q=3.3))
    for rule in (HullRule(q=3.3), HullRule(q=3.3, q_bow=3.3, q_stern=3.3)):
        np.testing.assert_array_equal(convert_by_rule(known, rule), expected)


def heading(count=120, rule=TWO_ENDS, known=True, noise=0.0):
    """Ships that head anywhere, one an image; a rule makes their references."""
    random = np.random.default_rng(1)
    length = random.uniform(40, 120, count)
    rows = np.column_stack(
        (
            random.uniform(0, 500, (count, 2)),
            length,
            length / random.uniform(2, 6, count),
            random.uniform(-np.pi, np.pi, count),
        )
    )
    boxes = OrientedBoxes.from_xywhr(rows, bow=True)
    reference = convert_by_rule(boxes, rule) + noise * random.normal(size=(count, 4))
    ships = fleet(rows, reference, images=range(count))
    return replace(ships, boxes=boxes) if known else ships


def test_the_ends_that_made_the_references_are_found() -> None:
    ships = heading()
    rule = calibrate(ships)
    assert (rule.q_bow, rule.q_stern) == pytest.approx((1.8, 5.0), rel=0.02)
    assert (rule.f, rule.s) == (1.0, 1.0)
    assert iou(convert_by_rule(ships.boxes, rule), ships.reference).mean() > 0.999


@pytest.mark.parametrize(
    'ships',
    [heading(known=False), heading(rule=HullRule()), heading(20)],
    ids=['bow unknown', 'ends alike', 'too few'],
)
def test_ends_that_gain_nothing_are_not_fitted(ships) -> None:
    rule = calibrate(ships)
    assert (rule.q_bow, rule.q_stern) == (None, None)


@pytest.mark.parametrize(
    'values', [{'method': 'shape_aware'}, {'objective': Coverage()}, {'ends': Fit.NEVER}]
)
def test_only_what_has_ends_gets_them(values) -> None:
    rule = calibrate(heading(), CalibrationPlan(**values))
    assert (rule.q_bow, rule.q_stern) == (None, None)


def test_ends_are_refused_for_a_rule_without() -> None:
    with pytest.raises(ValueError, match='shape_aware has no q_bow and q_stern'):
        fit_bow_and_stern(heading(), HullRule('shape_aware'), MeanIou())


def test_ends_fitted_on_one_half_of_the_images_gain_on_the_other() -> None:
    ships = synthetic_ships([FAMILIES['bow_stern'], FAMILIES['tapered']], aspects=2, angles=40)
    ships = ships.heading_by_hull()
    # Tapered hulls are alike at both ends.
    assert 0.4 < ships.boxes.bow.mean() < 0.6
    known, new = split(ships.take(ships.boxes.bow))
    one, two = (
        iou(
            convert_by_rule(new.boxes, calibrate(known, CalibrationPlan(ends=ends))), new.reference
        ).mean()
        for ends in (Fit.NEVER, Fit.ALWAYS)
    )
    assert two - one > 0.01
    assert bow_gain(ships, decide(ships, CalibrationPlan())) > 0.01


def test_the_result_says_what_the_ends_gain() -> None:
    result = run(heading(noise=0.5), CalibrationPlan(), folds=3)
    text = calibration_text(result)
    assert 'q_bow and q_stern over q, 120 ships with a known bow: gain +0.0' in text
    assert f'q_bow {result.rule.q_bow:.4g}, q_stern {result.rule.q_stern:.4g}' in text
    assert 'known bow: gain none' in calibration_text(
        run(heading(rule=HullRule()), CalibrationPlan(), folds=3)
    )


def test_calibrate_writes_the_ends_that_it_fits_and_only_those(tmp_path, capsys) -> None:
    image = harbour()
    count = len(image.class_ids)
    pieces = [
        replace(
            image,
            image=name,
            corners=image.corners[rows],
            class_ids=image.class_ids[rows],
            ids=image.ids[rows],
            scores=image.scores[rows],
            reference=image.reference[rows],
            hulls=image.hulls[rows],
        )
        for name, rows in (('a', slice(0, count // 2)), ('b', slice(count // 2, None)))
    ]
    write_labels(tmp_path / 'ships.csv', pieces)
    path = tmp_path / 'params.yaml'
    written = {}
    for bow in ('none', 'hull'):
        command = ['calibrate', str(tmp_path / 'ships.csv'), '--bow', bow, '-o', str(path)]
        assert main([*command, '--folds', '2']) == 0
        written[bow] = yaml.safe_load(path.read_text('utf-8'))['/**']['ros__parameters']
    assert list(written['none']) == ['method', 'q', 'f', 's']
    assert list(written['hull']) == ['method', 'q', 'f', 's', 'q_bow', 'q_stern']
    assert written['hull']['q_bow'] < written['hull']['q_stern']
    assert 'ships is known' in capsys.readouterr().err


def test_groups_keep_the_ends_except_classes() -> None:
    ships = heading(300, noise=0.3)
    ships = replace(ships, class_ids=np.array(['tug', 'ship'] * 150))
    result = run(ships, CalibrationPlan(), folds=2, per_class=True, by_aspect=True)
    assert all(rule.q_bow is not None for _, _, rule in result.rule_of_aspect)
    assert result.rule_of_class == {}


def test_bows_of_synthetic_ships_come_from_their_hulls_only(capsys) -> None:
    assert main(['calibrate', '--synthetic', '--bow', 'labels']) == 1
    assert 'synthetic ships have no labels' in capsys.readouterr().err


def test_evaluate_scores_the_ends_it_is_given(tmp_path, capsys) -> None:
    # From the first edge: a ship that heads to +x, and its reference.
    corners = [[40.0, 0], [40, 20], [0, 20], [0, 0]]
    turned = np.array(corners) @ np.array([[1, 1], [-1, 1]]) / np.sqrt(2)
    image = replace(labels('a', [[0, 0, 40, 20]]), corners=turned[None])
    boxes = OrientedBoxes.from_corners(turned[None], bow=True)
    expected = convert_by_rule(boxes, HullRule(q_bow=2.0, q_stern=6.0))
    write_labels(tmp_path / 'ships.csv', [replace(image, reference=expected)])
    command = [
        'evaluate',
        str(tmp_path / 'ships.csv'),
        '--protocol',
        'hbb',
        '--bootstrap',
        '0',
        '--methods',
        'superellipse',
        'outer',
        '--q-bow',
        '2',
        '--q-stern',
        '6',
    ]
    assert main([*command, '--bow', 'first-edge']) == 0
    printed = capsys.readouterr()
    assert 'superellipse  3 / 1 / 1, bow 2, stern 6    1.0000' in printed.out
    assert 'the bow of 1 of 1 ships is known' in printed.err
    assert main(command) == 0
    assert '--q-bow and --q-stern have no effect without --bow' in capsys.readouterr().err


def test_a_bow_from_nowhere_is_refused() -> None:
    with pytest.raises(ValueError, match='bow must be one of none, labels, first-edge, hull'):
        Ships.from_labels([labels('a', [[0, 0, 9, 3]])], bow='stern')
