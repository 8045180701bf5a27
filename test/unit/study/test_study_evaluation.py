# SPDX-License-Identifier: Apache-2.0
"""evaluate(): known figures of real ships, bands, intervals, what is written and refused."""

import csv
import json
from dataclasses import replace

import numpy as np
import pytest
from fleets import REAL
from fleets import fleet
from hypothesis import given
from hypothesis import strategies as st

from obbhbb_ros import convert
from obbhbb_ros.geometry.converter import HullRule
from obbhbb_ros.geometry.converter import centers_and_extents
from obbhbb_ros.geometry.converter import convert_by_rule
from obbhbb_ros.geometry.converter import to_xyxy
from obbhbb_ros.geometry.methods import METHODS
from obbhbb_ros.study.bootstrap import bootstrap_intervals
from obbhbb_ros.study.bootstrap import draws
from obbhbb_ros.study.bootstrap import median_intervals
from obbhbb_ros.study.cautions import cautions
from obbhbb_ros.study.cross_validation import class_groups
from obbhbb_ros.study.evaluation import ALL
from obbhbb_ros.study.evaluation import METRICS
from obbhbb_ros.study.evaluation import EvaluationSettings
from obbhbb_ros.study.evaluation import evaluate
from obbhbb_ros.study.evaluation import offsets
from obbhbb_ros.study.evaluation import strata
from obbhbb_ros.study.evaluation import write_csv
from obbhbb_ros.study.evaluation import write_json
from obbhbb_ros.study.metrics import hull_share
from obbhbb_ros.study.metrics import outlines
from obbhbb_ros.study.rules import choose_rules
from obbhbb_ros.study.ships import read_ships
from obbhbb_ros.study.tables import offset_notes
from obbhbb_ros.study.tables import score_tables

FAST = EvaluationSettings(bootstrap=0)
OUTER = choose_rules(['outer'])


@pytest.fixture(scope='module')
def real():
    return read_ships([REAL])


@pytest.fixture(scope='module')
def scores(real):
    return evaluate(real, settings=EvaluationSettings(bootstrap=50))


@pytest.mark.parametrize(
    ('method', 'mean_iou'),
    [
        ('superellipse', 0.92001),
        ('shape_aware', 0.82121),
        ('outer', 0.80998),
        ('midpoint', 0.80704),
        ('gaussian', 0.89033),
        ('gaussian_published', 0.38644),
        ('area_equivalent_published', 0.25658),
    ],
)
def test_mean_iou_with_drawn_boxes_of_real_ships(scores, method, mean_iou) -> None:
    (score,) = [s for s in scores if (s.protocol, s.stratum, s.method) == ('hbb', ALL, method)]
    assert score.iou == pytest.approx(mean_iou, abs=5e-5)
    assert score.iou_low < score.iou < score.iou_high


def test_methods_have_the_papers_parameters_or_ours_unless_told() -> None:
    rules = choose_rules()
    assert list(rules) == list(METHODS)
    assert rules['shape_aware'] == HullRule('shape_aware', 2.2, 0.9, 1.0)
    assert rules['superellipse'] == HullRule('superellipse', 3.0, 1.0, 1.0)
    told = choose_rules(['shape_aware', 'outer'], q=2.0, s=1.1)
    assert told['shape_aware'] == HullRule('shape_aware', 2.0, 0.9, 1.1)
    assert told['outer'] == HullRule('outer')


@pytest.mark.parametrize(
    ('arguments', 'message'),
    [
        ({'methods': ['outter']}, "no method 'outter'; there are superellipse"),
        ({'q': 0.5}, r'q must be 1 to inf'),
    ],
)
def test_rules_that_do_not_exist_are_refused(arguments, message) -> None:
    with pytest.raises(ValueError, match=message):
        choose_rules(**arguments)


def test_bands_of_tilt_split_all_ships_and_so_do_bands_of_aspect(real) -> None:
    found = strata(real)
    for prefix in ('tilt ', 'L/W '):
        members = [
            rows for name, rows in found.items() if name.startswith(prefix) and '> 10' not in name
        ]
        assert (np.sum(members, axis=0) == 1).all()


@pytest.mark.parametrize(
    ('degrees', 'band'),
    [(0, '0-15'), (14.9, '0-15'), (15.1, '15-30'), (30.1, '30-45'), (45, '30-45'), (75.1, '0-15')],
)
def test_a_ship_is_in_the_band_of_its_tilt(degrees, band) -> None:
    found = strata(fleet([[0, 0, 9, 2, np.radians(degrees)]]))
    assert f'tilt {band}°' in found
    assert sum('-' in name for name in found if name.startswith('tilt')) == 1


def test_tilted_ships_have_a_stratum_of_their_own() -> None:
    rows = [[0, 0, 9, 2, np.radians(degrees)] for degrees in (0, 9, 11, 44, 85)]
    assert strata(fleet(rows))['tilt > 10°'].tolist() == [False, False, True, True, False]


def test_classes_are_strata_where_there_are_several() -> None:
    rows = [[0, 0, 9, 2, 0.2]] * 3
    assert 'class ship' not in strata(fleet(rows))
    found = strata(fleet(rows, classes=['tug', 'ship', 'tug']))
    assert found['class tug'].tolist() == [True, False, True]


def test_ships_without_reference_are_left_out_of_the_protocol_that_needs_one() -> None:
    reference = [[0.0, 0, 9, 9], [np.nan] * 4]
    ships = fleet([[4, 4, 9, 3, 0.4], [30, 4, 9, 3, 0.1]], reference)
    counts = {s.protocol: s.ships for s in evaluate(ships, settings=FAST) if s.stratum == ALL}
    assert counts == {'obb': 2, 'hbb': 1}


@pytest.mark.parametrize(
    ('protocol', 'message'),
    [('hbb', 'no ship has a reference box'), ('iou', 'protocol must be one of obb, hbb')],
)
def test_a_protocol_that_cannot_be_scored_is_an_error(protocol, message) -> None:
    with pytest.raises(ValueError, match=message):
        evaluate(fleet([[4, 4, 9, 3, 0.4]]), protocols=[protocol])


def test_threshold_and_kept_part_count_ships() -> None:
    reference = [[0.0, 0.0, 10.0, 4.0], [0.0, 0.0, 10.0, 8.0]]
    ships = fleet([[5, 2, 10, 4, 0], [5, 4, 10, 4, 0]], reference)
    rules = choose_rules(['outer'])

    def overall(settings):
        return evaluate(ships, rules, ['hbb'], settings)[0]

    score = overall(EvaluationSettings(threshold=0.6, keep=0.4, bootstrap=0))
    assert (score.match, score.kept, score.coverage) == (0.5, 1.0, 0.75)
    assert overall(EvaluationSettings(threshold=0.5, keep=0.6, bootstrap=0)).match == 1.0
    assert score.area == 1.0
    assert np.isnan(score.iou_low)


@pytest.mark.parametrize('values', [{'threshold': 0}, {'keep': 1.1}, {'bootstrap': -1}])
def test_settings_out_of_range_are_refused(values) -> None:
    with pytest.raises(ValueError, match=next(iter(values))):
        EvaluationSettings(**values)


def of_images(values):
    """Draw values and the images that they are from, two or more."""
    pairs = st.lists(st.tuples(values, st.integers(0, 5)), min_size=2, max_size=30)
    return pairs.filter(lambda drawn: len({image for _, image in drawn}) > 1)


@given(of_images(st.floats(0, 1)))
def test_an_interval_lies_within_the_values_and_depends_on_the_seed_alone(pairs) -> None:
    values, images = (np.array(column) for column in zip(*pairs, strict=True))
    ((low, high),) = bootstrap_intervals([values], images, samples=30, seed=3)
    assert values.min() - 1e-12 <= low <= high <= values.max() + 1e-12
    assert bootstrap_intervals([values], images, samples=30, seed=3) == [(low, high)]


def test_images_are_drawn_as_a_whole() -> None:
    # Ten ships each of two images: by ship the mean would hardly move, by image it is 0, .5 or 1.
    values = np.repeat([0.0, 1.0], 10)
    assert bootstrap_intervals([values], values.astype(int), samples=200) == [(0.0, 1.0)]
    ((low, high),) = bootstrap_intervals([values], np.arange(20), samples=200)
    assert 0.2 < low < 0.5 < high < 0.8


def test_each_class_is_converted_under_its_own_rule() -> None:
    ships = fleet([[4, 4, 9, 3, 0.4]] * 2, classes=['tug', 'ship'])
    tug, other = HullRule('superellipse', 5.0), HullRule('outer')
    rule_of = class_groups(['tug', 'ship'], ships, ships)
    xyxy = to_xyxy(*centers_and_extents(ships.boxes, [tug, other], rule_of))
    np.testing.assert_array_equal(xyxy[:1], convert_by_rule(ships.boxes, tug)[:1])
    np.testing.assert_array_equal(xyxy[1:], convert_by_rule(ships.boxes, other)[1:])


def test_every_table_names_its_protocol(scores) -> None:
    tables = score_tables(scores).split('\n\n')
    assert [('protocol obb' in t, 'protocol hbb' in t) for t in tables] == [
        (True, False),
        (True, False),
        (False, True),
        (False, True),
    ]


def test_json_is_strict_and_complete(scores, tmp_path) -> None:
    write_json(tmp_path / 'scores.json', scores, EvaluationSettings(bootstrap=50))

    def refuse(name):
        raise AssertionError(name)

    text = (tmp_path / 'scores.json').read_text(encoding='utf-8')
    document = json.loads(text, parse_constant=refuse)
    assert len(document['scores']) == len(scores)
    assert document['scores'][0]['iou'] == scores[0].iou
    assert set(document['protocols']) == {'obb', 'hbb'}


def test_values_that_json_does_not_have_are_still_written(real, tmp_path) -> None:
    rules = {'superellipse': HullRule('superellipse', np.inf)}
    write_json(tmp_path / 'scores.json', evaluate(real, rules, ['hbb'], FAST), FAST)
    (first, *_) = json.loads((tmp_path / 'scores.json').read_text(encoding='utf-8'))['scores']
    assert (first['q'], first['iou_low']) == ('inf', None)


def test_csv_reads_back_as_the_scores(scores, tmp_path) -> None:
    write_csv(tmp_path / 'scores.csv', scores)
    with (tmp_path / 'scores.csv').open(encoding='utf-8', newline='') as file:
        rows = list(csv.DictReader(file))
    assert [float(row['iou']) for row in rows] == [score.iou for score in scores]
    assert [row['stratum'] for row in rows] == [score.stratum for score in scores]


# Figures worked out by hand -------------------------------------------------------------------


def overall(ships, rules=None, **options):
    """Scores over all ships, protocol hbb, by method."""
    found = evaluate(
        ships, rules or choose_rules(['outer']), ['hbb'], EvaluationSettings(**options)
    )
    return {score.method: score for score in found if score.stratum == ALL}


def test_recall_counts_ious_of_75_and_90_and_averages_over_ten_thresholds() -> None:
    # An upright box 100 long against references 100, 80 and 60 long: IoU 1, .8 and .6.
    reference = [[0.0, 0, 100, 10], [0, 0, 80, 10], [0, 0, 60, 10]]
    score = overall(fleet([[50, 5, 100, 10, 0]] * 3, reference), bootstrap=0)['outer']
    assert score.iou == pytest.approx(0.8)
    assert (score.match, score.match75, score.match90) == pytest.approx((1.0, 2 / 3, 1 / 3))
    # .50 to .95 are 10, to .80 are 7 and to .60 are 3 thresholds.
    assert score.match_average == pytest.approx((1.0 + 0.7 + 0.3) / 3)


@given(st.lists(st.floats(1.0, 100.0), min_size=1, max_size=9))
def test_recall_falls_with_the_threshold_and_its_average_lies_between(lengths) -> None:
    reference = [[0.0, 0.0, length, 10.0] for length in lengths]
    score = overall(fleet([[50, 5, 100, 10, 0]] * len(lengths), reference), bootstrap=0)['outer']
    assert score.match90 <= score.match75 <= score.match
    assert 0.3 * score.match75 <= score.match_average <= score.match + 1e-12


def with_hulls(ships, hulls):
    return replace(ships, hulls=tuple(None if hull is None else np.array(hull) for hull in hulls))


def test_a_hull_is_kept_from_99_percent_of_its_area_on() -> None:
    # Boxes 100 x 10; hulls that lie in them whole, but for 1 % and but for 2 %.
    hulls = [[(a, 0), (a + 100.0, 0), (a + 100.0, 10), (a, 10)] for a in (0.0, 1.0, 2.0)]
    ships = fleet([[50, 5, 100, 10, 0]] * 4, [[0.0, 0, 100, 10]] * 4)
    score = overall(with_hulls(ships, [*hulls, None]), bootstrap=0)['outer']
    # Of the three whose hull is known.
    assert score.hull_kept == pytest.approx(2 / 3)


def test_without_hulls_there_is_no_share_of_them_and_no_column(scores) -> None:
    assert all(np.isnan(score.hull_kept) for score in scores)
    assert 'hull 99%' not in score_tables(scores)
    ships = fleet([[50, 5, 100, 10, 0]], [[0.0, 0, 100, 10]])
    ships = with_hulls(ships, [[(0, 0), (9, 0), (9, 9)]])
    assert 'hull 99%' in score_tables(evaluate(ships, settings=FAST))


def test_a_mask_that_crosses_itself_still_has_an_area() -> None:
    # Two triangles of 25 that meet in a point, one of them inside the box.
    crossed = np.array([(0.0, 0), (10, 10), (10, 0), (0, 10)])
    hulls = outlines([crossed, None, crossed[:2]])
    share = hull_share(np.array([[0.0, 0.0, 5.0, 10.0]] * 3), hulls)
    assert share == pytest.approx([0.5, np.nan, np.nan], nan_ok=True)


def shifted(dx, dy, count=30):
    """Upright ships 100 x 10 whose references lie elsewhere, each in an image of its own."""
    rows = [[50.0 + 200.0 * i, 5.0, 100.0, 10.0, 0.0] for i in range(count)]
    offset = np.array([dx, dy, dx, dy])
    reference = [[200.0 * i, 0.0, 200.0 * i + 100.0, 10.0] for i in range(count)] - offset
    return fleet(rows, reference, images=range(count))


def test_a_constant_offset_is_measured_and_warned_of_in_one_line() -> None:
    (found,) = offsets(shifted(1.5, -0.25), choose_rules(['outer']))
    assert (found.x, found.y) == (1.5, -0.25)
    assert (found.x_interval, found.y_interval) == ((1.5, 1.5), (-0.25, -0.25))
    assert (found.left, found.top, found.right, found.bottom) == (1.5, -0.25, 1.5, -0.25)
    assert offset_notes([found]) == [
        'note: significant offset from the reference boxes: +1.50 px in x (+1.50 to +1.50) and '
        '-0.25 px in y (-0.25 to -0.25)'
    ]


@pytest.mark.parametrize(('dx', 'significant'), [(0.0, False), (1e-9, False), (0.02, True)])
def test_an_offset_that_cannot_be_seen_is_not_significant(dx, significant) -> None:
    (found,) = offsets(shifted(dx, 0.0), choose_rules(['outer']))
    assert list(found.significant_axes) == (['x'] if significant else [])
    assert bool(offset_notes([found])) is significant


def test_an_axis_whose_interval_contains_zero_is_not_called_significant() -> None:
    ships = shifted(1.5, 0.25)
    up_and_down = np.where(np.arange(30) % 2, 3.0, -3.0)[:, None] * [0, 1, 0, 1]
    (found,) = offsets(replace(ships, reference=ships.reference + up_and_down), OUTER)
    assert list(found.significant_axes) == ['x']
    assert offset_notes([found]) == [
        'note: significant offset from the reference boxes: +1.50 px in x (+1.50 to +1.50)'
    ]


def test_one_image_has_no_interval_and_nothing_significant() -> None:
    ships = replace(shifted(1.5, -0.25), image_of=np.zeros(30, int))
    (found,) = offsets(ships, OUTER)
    assert np.isnan([*found.x_interval, *found.y_interval]).all()
    assert offset_notes([found]) == []
    for score in evaluate(ships, OUTER):
        assert np.isnan([score.iou_low, score.iou_high]).all()
    assert any('one image' in note for note in cautions(ships))


TILTED_ROWS = [[100.0 * i, 50.0, 80.0, 15.0, 0.2 + 0.05 * i] for i in range(10)]


@pytest.mark.parametrize('rounded', [False, True])
@pytest.mark.parametrize(('outer_boxes', 'cautioned'), [(10, True), (6, True), (5, False)])
def test_references_that_are_outer_boxes_are_recognised(outer_boxes, cautioned, rounded) -> None:
    boxes = fleet(TILTED_ROWS).boxes
    outer, hulls = convert(boxes, method='outer'), convert(boxes)
    reference = np.where(np.arange(10)[:, None] < outer_boxes, outer, hulls)
    reference = np.round(reference) if rounded else reference
    notes = cautions(fleet(TILTED_ROWS, reference, images=range(10)))
    assert [f'{outer_boxes} of 10 reference boxes' in note for note in notes] == [True] * cautioned


def test_upright_boxes_that_are_their_own_references_are_recognised() -> None:
    assert any('they say nothing about hulls' in note for note in cautions(shifted(0.0, 0.0)))
    assert cautions(shifted(5.0, 0.0)) == []
    assert cautions(fleet([[50, 5, 100, 10, 0]] * 2, images=[0, 1])) == []


def test_one_upright_ship_does_not_speak_for_tilted_ones() -> None:
    rows = [[50.0, 5.0, 100.0, 10.0, 0.0]] * 9 + [[50.0, 50.0, 80.0, 15.0, 0.5]]
    reference = convert(fleet(rows).boxes)
    assert cautions(fleet(rows, reference, images=range(10))) == []


def test_offsets_to_both_sides_are_not_significant_and_neither_is_one_without_interval() -> None:
    ships = shifted(0.0, 0.0)
    reference = ships.reference + np.where(np.arange(30) % 2, 1.0, -1.0)[:, None]
    (found,) = offsets(replace(ships, reference=reference), choose_rules(['outer']))
    assert not found.significant_axes
    (found,) = offsets(shifted(3.0, 0.0), choose_rules(['outer']), FAST)
    assert (found.x, found.significant_axes) == (3.0, {})


def test_a_box_that_is_too_large_has_no_offset_of_its_centre_but_of_its_sides() -> None:
    ships = shifted(0.0, 0.0)
    inner = ships.reference + [2.0, 1.0, -2.0, -1.0]
    (found,) = offsets(replace(ships, reference=inner), choose_rules(['outer']))
    assert (found.x, found.y, found.significant_axes) == (0.0, 0.0, {})
    assert (found.left, found.top, found.right, found.bottom) == (-2.0, -1.0, 2.0, 1.0)


@given(of_images(st.integers(-9, 9)))
def test_the_interval_of_a_median_is_that_of_medians_of_drawn_images(pairs) -> None:
    values, images = (np.array(column) for column in zip(*pairs, strict=True))
    (found,) = median_intervals([values.astype(float)], images, samples=20, seed=4)
    _, index = np.unique(images, return_inverse=True)
    medians = [
        np.median(np.repeat(values, times[index].astype(int)))
        for batch in draws(index.max() + 1, 20, 4)
        for times in batch
    ]
    assert found == pytest.approx(tuple(np.quantile(medians, (0.025, 0.975))))


def test_every_figure_of_a_score_has_a_column_in_its_table(scores) -> None:
    table = score_tables(scores)
    for name, figure in METRICS.items():
        assert (figure.heading(EvaluationSettings()) in table) == (name != 'hull_kept'), name
