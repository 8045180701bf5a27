# SPDX-License-Identifier: Apache-2.0
"""Of every ship the best view, all of its views counted, and its way if it has one."""

from dataclasses import replace

import numpy as np
import pytest

from obbhbb_ros import OrientedBoxes
from obbhbb_ros.earth.pinhole import Pinhole
from obbhbb_ros.earth.placement import place
from obbhbb_ros.earth.pose import CameraPose
from obbhbb_ros.reports.seen_ships import ShipCollector
from obbhbb_ros.reports.ship_report import MAX_SHIPS
from obbhbb_ros.reports.ship_report import joined_reports

# 500 km above the equator, image up to the north, 1.5 m a pixel.
CAMERA = Pinhole([1e6 / 3, 0, 511.5, 0, 1e6 / 3, 511.5, 0, 0, 1])
SECOND = 1_000_000_000


def places_of(rows, sigma=5.0, bow=False):
    """Place boxes; the pose is known to some metres."""
    spread = np.diag([sigma**2] * 3 + [1e-16] * 3) if sigma else None
    pose = CameraPose.from_message([6878137, 0, 0], [0.5, 0.5, -0.5, -0.5], spread)
    return place(OrientedBoxes.from_xywhr(rows, bow=bow), CAMERA, pose)


def note(collector, second, rows, ids, scores=None, whole=None, classes=None, **kwargs):
    """Note an image."""
    count = len(ids)
    return collector.note(
        second * SECOND,
        ids,
        classes or ['ship'] * count,
        np.array([0.5] * count if scores is None else scores),
        np.ones(count, bool) if whole is None else np.array(whole),
        places_of(rows, **kwargs),
    )


def test_the_view_with_the_smallest_uncertainty_tells_where_a_ship_is() -> None:
    collector = ShipCollector()
    for second, (x, sigma) in enumerate([(300, 9.0), (310, 4.0), (320, 7.0)]):
        note(collector, second, [[x, 500, 60, 10, 0.0]], ['s-1'], sigma=sigma)
    (ship,) = collector.take()
    expected = places_of([[310, 500, 60, 10, 0.0]])
    assert ship.longitude == expected.longitude[0]
    assert ship.length_m == pytest.approx(90.0, abs=0.1)
    assert ship.sigma_m[0] == pytest.approx(4.0, rel=0.1)
    assert (ship.first, ship.last, ship.views) == (0, 2 * SECOND, 3)
    assert len(collector) == 0
    assert collector.take() == []


@pytest.mark.parametrize('sigma', [None, 3.0])
def test_of_alike_views_the_last_tells_where_a_ship_under_way_is(sigma) -> None:
    collector = ShipCollector()
    for second in range(20):
        # From the middle of the image to its border; the places are known a little worse there.
        rows = [[500 + 20 * second, 500, 60, 10, 0.0]]
        note(collector, second, rows, ['s-1'], sigma=sigma and sigma + 0.01 * second)
    (ship,) = collector.take()
    assert ship.longitude == places_of(rows).longitude[0]


def test_views_that_are_a_little_worse_each_are_not_alike_in_the_end() -> None:
    collector = ShipCollector()
    for second in range(20):
        note(collector, second, [[300 + second, 500, 60, 10, 0.0]], ['s-1'], sigma=3.0 + second / 8)
    note(collector, 1, [[100, 500, 60, 10, 0.0]], ['s-1'], sigma=3.0)
    (ship,) = collector.take()
    assert ship.longitude == places_of([[302, 500, 60, 10, 0.0]]).longitude[0]


def test_a_whole_ship_comes_before_one_that_the_border_cuts() -> None:
    collector = ShipCollector()
    note(collector, 0, [[20, 500, 40, 10, 0.0]], ['s-1'], whole=[False], sigma=1.0)
    note(collector, 1, [[60, 500, 60, 10, 0.0]], ['s-1'], whole=[True], sigma=9.0)
    note(collector, 2, [[20, 500, 30, 10, 0.0]], ['s-1'], whole=[False], sigma=2.0)
    (ship,) = collector.take()
    assert ship.length_m == pytest.approx(90.0, abs=0.1)


def test_class_and_score_are_the_most_certain_ones() -> None:
    collector, row = ShipCollector(), [[300, 500, 60, 10, 0.0]]
    for second, (name, score) in enumerate(
        [('boat', np.nan), ('tug', 0.4), ('ferry', 0.9), ('boat', 0.7)]
    ):
        note(collector, second, row, ['s-1'], classes=[name], scores=[score])
    (ship,) = collector.take()
    assert (ship.class_id, ship.score) == ('ferry', 0.9)
    note(collector, 9, row, ['s-1'], classes=['boat'], scores=[np.nan])
    (ship,) = collector.take()
    assert (ship.class_id, ship.score) == ('boat', None)


@pytest.mark.parametrize('step', [-8.0, 8.0])
def test_a_ship_under_way_has_speed_and_course_and_its_bow_is_known(step) -> None:
    collector = ShipCollector()
    for second in range(12):
        note(collector, second, [[500 + step * second, 500, 60, 10, 0.02]], ['s-1'], sigma=2.0)
    (ship,) = collector.take()
    assert ship.speed == pytest.approx(12.0, rel=0.01)
    assert 3 * ship.speed_sigma < ship.speed
    east = 90.0 if step > 0 else 270.0
    assert ship.course_over_ground == pytest.approx(east, abs=0.5)
    assert not ship.course_ambiguous
    assert ship.course == pytest.approx(east + np.degrees(0.02), abs=0.1)


def test_a_ship_that_drifts_across_has_a_way_but_no_known_bow() -> None:
    collector = ShipCollector()
    for second in range(12):
        note(collector, second, [[500 + 8 * second, 500, 60, 10, 1.5]], ['s-1'], sigma=2.0)
    (ship,) = collector.take()
    assert ship.speed == pytest.approx(12.0, rel=0.01)
    assert ship.course_ambiguous


def test_a_ship_at_rest_has_no_speed() -> None:
    collector = ShipCollector()
    for second in range(12):
        note(collector, second, [[500, 500, 60, 10, 0.3]], ['s-1'])
    (ship,) = collector.take()
    assert ship.speed is ship.course_over_ground is None


def test_ships_without_a_place_or_an_id_are_not_listed_and_the_latter_counted() -> None:
    collector = ShipCollector()
    rows = [[300, 500, 60, 10, 0.0], [1e9, 500, 60, 10, 0.0], [600, 500, 60, 10, 0.0]]
    assert note(collector, 0, rows, ['s-1', 's-2', '']) == 1
    assert [ship.id for ship in collector.take()] == ['s-1']


def test_long_ids_are_not_listed_and_long_classes_are_cut() -> None:
    collector, row = ShipCollector(), [[300, 500, 60, 10, 0.0]]
    assert note(collector, 0, row, ['s' * 65]) == 1
    assert note(collector, 0, row, ['s' * 64], classes=['c' * 100_000]) == 0
    (ship,) = collector.take()
    assert (ship.id, ship.class_id) == ('s' * 64, 'c' * 64)


def test_memory_is_bounded() -> None:
    collector = ShipCollector()
    rows = [[300, 500, 60, 10, 0.0]] * (MAX_SHIPS + 5)
    assert note(collector, 0, rows, [f's-{i}' for i in range(len(rows))], sigma=None) == 5
    assert len(collector) == MAX_SHIPS
    # Those that are known are noted all the same.
    assert note(collector, 1, rows[:3], ['s-0', 's-1', 'new'], sigma=None) == 1


def test_two_lists_of_one_ship_are_joined() -> None:
    collector = ShipCollector()
    note(collector, 0, [[300, 500, 60, 10, 0.0]], ['s-1'], scores=[0.9], sigma=3.0)
    (early,) = collector.take()
    note(collector, 9, [[340, 500, 60, 10, 0.0]], ['s-1'], scores=[0.4], sigma=6.0)
    (late,) = collector.take()
    both = joined_reports(early, late)
    assert both == replace(early, last=late.last, views=2)
    assert joined_reports(replace(early, sigma_m=None), late).sigma_m == late.sigma_m


@pytest.mark.parametrize('sigma', [None, 3.0])
@pytest.mark.parametrize('views', [1, 2, 5])
def test_a_ship_under_way_is_where_it_was_last_however_many_lists_are_joined(sigma, views) -> None:
    collector, reports = ShipCollector(), []
    for second in range(6 * views):
        note(collector, second, [[200 + 20 * second, 500, 60, 10, 0.0]], ['s-1'], sigma=sigma)
        if second % views == views - 1:
            reports += collector.take()
    places = [ship.longitude for ship in reports]
    # One after the other, as they wait in a spool, and all at once, as they came down.
    waiting = reports[0]
    for report in reports[1:]:
        waiting = joined_reports(waiting, report)
    for ship in (waiting, joined_reports(*reports)):
        assert ship.longitude == places[-1]
        assert ship.views == 6 * views


def test_of_two_lists_with_like_uncertainty_the_one_with_the_whole_ship_counts() -> None:
    collector = ShipCollector()
    for second in range(3):
        note(collector, second, [[300, 500, 60, 10, 0.0]], ['s-1'], sigma=3.0)
    (many,) = collector.take()
    note(collector, 9, [[300, 500, 30, 10, 0.0]], ['s-1'], whole=[False], sigma=3.0)
    (cut,) = collector.take()
    for both in (joined_reports(many, cut), joined_reports(cut, many)):
        assert both.length_m == many.length_m
        assert both.views == 4
