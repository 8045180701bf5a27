# SPDX-License-Identifier: Apache-2.0
"""Speed and course over ground: right, no surer than the places are, and nothing where unsure."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from obbhbb_ros.tracking.ground_track import GroundTrack


def track_of(times, places, variance):
    """Make a track from times (s), places east and north (m) and their variance."""
    track = GroundTrack()
    for time, (east, north) in zip(times, places, strict=True):
        track.add(float(time), float(east), float(north), variance)
    return track


@given(st.floats(1.0, 20.0), st.floats(0.0, 359.0), st.floats(-1e4, 1e4), st.integers(3, 40))
def test_a_straight_way_gives_its_speed_and_course(speed, course, start, views) -> None:
    times = np.linspace(0.0, 10.0, views)
    ahead = np.array([np.sin(np.radians(course)), np.cos(np.radians(course))])
    velocity = track_of(times, start + speed * times[:, None] * ahead, 0.01).velocity()
    assert velocity.speed == pytest.approx(speed, rel=1e-6)
    assert (velocity.course - course + 180) % 360 - 180 == pytest.approx(0.0, abs=1e-4)


@pytest.mark.parametrize('variance', [0.25, None])
def test_the_stated_sigma_is_that_of_many_tracks(variance) -> None:
    random, times = np.random.default_rng(5), np.arange(4.0)
    way = times[:, None] * [6.0, 8.0]
    found = [
        track_of(times, way + random.normal(0.0, 0.5, way.shape), variance).velocity()
        for _ in range(2000)
    ]
    speeds = np.array([velocity.speed for velocity in found])
    courses = np.array([velocity.course for velocity in found])
    assert speeds.mean() == pytest.approx(10.0, abs=0.05)
    stated = np.mean([velocity.speed_sigma for velocity in found])
    assert speeds.std() == pytest.approx(stated, rel=0.15)
    assert courses.std() == pytest.approx(np.mean([v.course_sigma for v in found]), rel=0.15)


@pytest.mark.parametrize('memory', [0.5, 5.0, 30.0])
@pytest.mark.parametrize('variance', [9.0, None])
def test_errors_that_follow_each_other_alike_are_no_way(memory, variance) -> None:
    # Of fixes and attitudes: at 10 Hz each differs from the one before it by a little.
    random, share = np.random.default_rng(8), np.exp(-0.1 / memory)
    given = 0
    for _ in range(200):
        steps = random.normal(0.0, 3.0 * np.sqrt(1.0 - share**2), (600, 2))
        errors = [random.normal(0.0, 3.0, 2)]
        for step in steps:
            errors.append(share * errors[-1] + step)
        given += track_of(np.arange(601) / 10, errors, variance).velocity() is not None
    assert given <= 0.03 * 200


def test_a_ship_that_may_lie_still_has_no_speed() -> None:
    random, times = np.random.default_rng(6), np.arange(6.0)
    tracks = [track_of(times, random.normal(0.0, 5.0, (6, 2)), 25.0) for _ in range(300)]
    # Three standard deviations in the plane are exceeded in 1.1 % of the cases.
    assert np.mean([track.velocity() is not None for track in tracks]) < 0.03


@pytest.mark.parametrize(
    ('times', 'places'),
    [
        ([0.0], [(0.0, 0.0)]),
        ([0.0, 1.0], [(0.0, 0.0), (9.0, 0.0)]),
        ([5.0] * 4, [(0.0, 0.0), (9.0, 0.0), (2.0, 1.0), (7.0, 7.0)]),
        ([0.0, 1.0, 2.0], [(0.0, 0.0), (90.0, 0.0), (180.0, 0.0)]),
    ],
    ids=['one view', 'two views', 'one moment', 'faster than a ship'],
)
def test_what_is_no_way_of_a_ship_has_no_speed(times, places) -> None:
    assert track_of(times, places, 0.01).velocity() is None


def test_places_without_uncertainty_that_hardly_differ_are_no_way() -> None:
    times = np.arange(20.0)
    places = 1e-6 * times[:, None] * [1.0, 1.0]
    assert track_of(times, places, None).velocity() is None


@pytest.mark.parametrize('views', [3, 4, 6, 20])
@pytest.mark.parametrize('variance', [None, 4.0])
def test_one_in_a_hundred_ships_that_lie_still_gets_a_speed(
    views: int, variance: float | None
) -> None:
    random = np.random.default_rng(views)
    given = 0
    for _ in range(2000):
        track = GroundTrack()
        for second, (east, north) in enumerate(random.normal(0.0, 2.0, (views, 2)).tolist()):
            track.add(float(second), east, north, variance)
        given += track.velocity() is not None
    assert given <= 0.025 * 2000
