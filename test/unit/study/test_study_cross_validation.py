# SPDX-License-Identifier: Apache-2.0
"""What a calibration comes to: what groups earn, and the parameter file."""

from dataclasses import replace

import numpy as np
import pytest
import yaml
from fleets import REAL
from fleets import fleet

from obbhbb_ros import OrientedBoxes
from obbhbb_ros.geometry.converter import HullRule
from obbhbb_ros.geometry.converter import convert_by_rule
from obbhbb_ros.study.calibration import CalibrationPlan
from obbhbb_ros.study.calibration import Fit
from obbhbb_ros.study.calibration import calibrate
from obbhbb_ros.study.coverage import Coverage
from obbhbb_ros.study.cross_validation import CALIBRATED
from obbhbb_ros.study.cross_validation import Gain
from obbhbb_ros.study.cross_validation import fit_margin
from obbhbb_ros.study.cross_validation import run
from obbhbb_ros.study.grid_search import GRIDS
from obbhbb_ros.study.rule_file import yaml_text
from obbhbb_ros.study.ships import read_ships
from obbhbb_ros.study.tables import calibration_text


@pytest.fixture(scope='module')
def real():
    return read_ships([REAL])


def two_classes(first, second, count=60):
    """Ships of two classes, the references of each made by a rule of its own."""
    random = np.random.default_rng(5)
    length = random.uniform(40, 120, 2 * count)
    rows = np.stack(
        (
            random.uniform(0, 500, 2 * count),
            random.uniform(0, 500, 2 * count),
            length,
            length / random.uniform(2, 9, 2 * count),
            random.uniform(-2, 2, 2 * count),
        ),
        axis=1,
    )
    boxes = OrientedBoxes.from_xywhr(rows)
    reference = np.concatenate(
        (
            convert_by_rule(boxes[:count], first),
            convert_by_rule(boxes[count:], second),
        )
    )
    return fleet(rows, reference, ['yacht'] * count + ['barge'] * count, range(2 * count))


def parameters(text):
    return yaml.safe_load(text)['/**']['ros__parameters']


def test_the_rule_is_that_of_all_ships_and_the_figures_are_held_out(real) -> None:
    result = run(real, CalibrationPlan(), folds=4)
    assert result.rule == calibrate(real, CalibrationPlan())
    fitted = convert_by_rule(real.boxes, result.rule)
    seen = np.mean(overlap_of(fitted, real))
    assert result.held_out[CALIBRATED]['iou'].mean() < seen
    assert result.held_out['paper']['iou'].mean() == pytest.approx(0.82121, abs=5e-5)
    assert result.held_out['outer']['iou'].mean() == pytest.approx(0.80998, abs=5e-5)


def overlap_of(xyxy, ships):
    low = np.maximum(xyxy[:, :2], ships.reference[:, :2])
    high = np.minimum(xyxy[:, 2:], ships.reference[:, 2:])
    shared = np.prod(np.clip(high - low, 0, None), axis=1)
    areas = [np.prod(b[:, 2:] - b[:, :2], axis=1) for b in (xyxy, ships.reference)]
    return shared / (areas[0] + areas[1] - shared)


def test_a_class_that_one_rule_for_all_does_not_fit_earns_its_own() -> None:
    # Mean IoU sides with the many, so the rule of all is that of the first class.
    ships = two_classes(HullRule('superellipse', 1.5), HullRule('superellipse', 9.0))
    rows = np.r_[0:60, 60:105]
    result = run(ships.take(rows), CalibrationPlan(), folds=4, per_class=True)
    by_class, barge, yacht = result.gains
    assert (by_class.earned, barge.earned, yacht.earned) == (True, True, False)
    mine = ships.take(rows[60:])
    assert result.rule_of_class == {'barge': calibrate(mine, CalibrationPlan())}


def test_classes_of_the_same_hull_earn_none() -> None:
    rule = HullRule('superellipse', 3.0)
    result = run(
        two_classes(rule, rule), CalibrationPlan(grid=GRIDS['wide']), folds=2, per_class=True
    )
    assert result.rule_of_class == {}
    assert 'not clearly better than one rule' in calibration_text(result)


def test_one_class_is_nothing_to_do(real) -> None:
    result = run(real, CalibrationPlan(), folds=2, per_class=True)
    assert result.rule_of_class == {}
    assert 'per class: nothing to do: needs two or more classes (here 1)' in calibration_text(
        result
    )


def test_bands_of_aspect_ratio_cover_every_ship(real) -> None:
    result = run(real, CalibrationPlan(), folds=2, by_aspect=True)
    # 13 ships a band are too few for a rule, so every ship has that of all, and nothing is gained.
    assert not result.rule_of_aspect
    (gain,) = result.gains
    assert (gain.mean, gain.earned) == (0.0, False)
    ships = two_classes(HullRule(), HullRule())
    bands = run(ships, CalibrationPlan(), folds=2, by_aspect=True).rule_of_aspect
    assert bands[0][0] == 1.0
    assert bands[-1][1] == np.inf
    assert [high for _, high, _ in bands[:-1]] == [low for low, _, _ in bands[1:]]


@pytest.mark.parametrize(('low', 'earned'), [(0.001, True), (0.0, False), (-0.2, False)])
def test_a_gain_is_earned_if_its_interval_is_above_zero(low, earned) -> None:
    gain = Gain('by class', 0.1, low, 0.3)
    assert gain.earned is earned
    assert ('not clearly better' in str(gain)) is not earned


def test_groups_are_not_judged_without_folds(real) -> None:
    with pytest.raises(ValueError, match='give folds'):
        run(real, CalibrationPlan(), folds=0, per_class=True)
    assert run(real, CalibrationPlan(), folds=0).held_out == {}


@pytest.mark.parametrize(
    ('per_image', 'unit'), [(1, 'new ships are exchangeable'), (4, 'images of at most 4 ships')]
)
def test_coverage_says_what_it_guarantees_and_on_what_condition(per_image, unit) -> None:
    ships = two_classes(HullRule(), HullRule(), count=200)
    plan = CalibrationPlan(objective=Coverage(share=0.9, per_image=per_image))
    text = calibration_text(run(ships, plan, folds=2))
    assert 'keeps 95% of its reference box with a probability of at least 90%' in text
    assert unit in text


def test_ships_that_are_too_few_only_without_a_fold_still_give_a_rule() -> None:
    # Half of 44 ships is enough for 95 %, half of 33 is not: it takes 19.
    ships = two_classes(HullRule(), HullRule(), count=22)
    result = run(ships, CalibrationPlan(objective=Coverage()), folds=4)
    assert result.held_out == {}
    assert (
        'No held-out figures: without one of 4 folds there are too few ships'
        in calibration_text(result)
    )


def test_the_file_holds_the_rule_as_the_node_reads_it() -> None:
    text = yaml_text(HullRule('shape_aware', 2.0, 1.0, 1.05), {}, ['first', 'second\nthird'])
    assert text.startswith('# first\n# second\n# third\n/**:\n')
    values = parameters(text)
    assert values == {'method': 'shape_aware', 'q': 2.0, 'f': 1.0, 's': 1.05}
    # ROS takes `2` for an integer and refuses it for a double.
    assert all(type(values[name]) is float for name in 'qfs')


def test_an_infinite_exponent_is_written_as_yaml_has_it() -> None:
    assert parameters(yaml_text(HullRule('superellipse', np.inf), {}))['q'] == np.inf


@pytest.mark.parametrize('class_id', ['tug', '0', 'no', 'oil tanker', 'Schlepper "Süd"', 'a.b'])
def test_class_rules_stand_under_their_class(class_id) -> None:
    own = HullRule('superellipse', 4.5, 0.9, 1.0)
    values = parameters(yaml_text(HullRule(), {class_id: own}))
    assert values['class_ids'] == [class_id]
    assert values['classes'] == {class_id: {'method': 'superellipse', 'q': 4.5, 'f': 0.9, 's': 1.0}}


@pytest.mark.parametrize(
    ('rules', 'message'),
    [
        ((HullRule('gaussian_published'), {}), 'does not offer the method gaussian_published'),
        ((HullRule(), {'two\nlines': HullRule()}), 'cannot be part of a parameter name'),
    ],
)
def test_what_the_node_cannot_read_is_not_written(rules, message) -> None:
    with pytest.raises(ValueError, match=message):
        yaml_text(*rules)


@pytest.mark.parametrize(
    ('mean', 'said', 'earned'),
    [(0.0019, 'gain none, +0.0019', False), (0.002, 'gain +0.0020', True)],
)
def test_a_gain_below_two_thousandths_is_called_none(mean, said, earned) -> None:
    gain = Gain('by class', mean, 0.001, 0.003)
    assert said in str(gain)
    assert gain.earned is earned


def test_the_result_says_what_f_and_s_gain_and_whether_they_are_fitted() -> None:
    same = run(two_classes(HullRule(), HullRule()), CalibrationPlan(), folds=2)
    assert 'f and s over q alone: gain none (' in calibration_text(same)
    assert 'below 0.002), not fitted' in calibration_text(same)
    large = HullRule(s=1.1)
    text = calibration_text(run(two_classes(large, large), CalibrationPlan(), folds=2))
    assert 'of held-out mean IoU, fitted' in text


def test_coverage_states_its_scatter_over_images() -> None:
    ships = two_classes(HullRule(), HullRule(), count=200)
    result = run(ships, CalibrationPlan(objective=Coverage(share=0.9)), folds=2)
    low, high = result.scatter
    text = calibration_text(result)
    assert f'lands between {low:.1%} and {high:.1%}' in text
    low, high = result.interval(CALIBRATED, 'kept')
    assert f'({low:.1%} to {high:.1%}, 95 % interval over images)' in text


def with_margin(margin, scale):
    """Ships whose references are a margin larger than their default boxes."""
    ships = two_classes(HullRule(), HullRule(), count=100)
    boxes = replace(
        ships.boxes,
        first=ships.boxes.long_axis * scale,
        second=ships.boxes.short_axis * scale,
        regular=False,
    )
    reference = convert_by_rule(boxes, HullRule()) + margin * np.array([-1, -1, 1, 1])
    return replace(ships, boxes=boxes, reference=reference)


def test_the_margin_that_made_the_references_is_found() -> None:
    ships = with_margin(0.65, 0.3)
    assert fit_margin(ships, convert_by_rule(ships.boxes, HullRule())) == 0.65


def test_a_margin_is_reported_where_small_ships_gain_by_it() -> None:
    text = calibration_text(run(with_margin(1.0, 0.3), CalibrationPlan(f_and_s=Fit.NEVER), folds=2))
    assert 'px on each side, for ships of L W below 32 x 32 px: better than none' in text


@pytest.mark.parametrize(('margin', 'scale'), [(0.0, 0.3), (1.0, 3.0)], ids=['none', 'large ships'])
def test_a_margin_that_gains_nothing_is_not_mentioned(margin, scale) -> None:
    assert 'px on each side' not in calibration_text(
        run(with_margin(margin, scale), CalibrationPlan(), folds=2)
    )


def test_the_ends_of_a_rule_are_written_if_it_has_them() -> None:
    values = parameters(yaml_text(HullRule(q_bow=2.0, q_stern=np.inf), {}))
    assert (values['q_bow'], values['q_stern']) == (2.0, np.inf)
    assert type(values['q_bow']) is float
