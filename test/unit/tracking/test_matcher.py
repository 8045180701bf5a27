# SPDX-License-Identifier: Apache-2.0
"""Boxes of one ship get one number, however the camera moves; memory and time are bounded."""

import warnings
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from seas import HOVERING
from seas import Sea
from seas import frames
from seas import quality

from obbhbb_ros.tracking.assignment import index_pairs
from obbhbb_ros.tracking.known_ships import MAX_OBJECTS
from obbhbb_ros.tracking.matcher import MAX_BOXES
from obbhbb_ros.tracking.matcher import ShipMatcher
from obbhbb_ros.tracking.shift import fitted

SIZE = 4000 + 3000j
SPARSE = Sea(ships=20, berthed=0.0, strip=15e3)
FLOATS = st.floats(allow_nan=True, allow_infinity=True)
ROWS = st.lists(st.tuples(FLOATS, FLOATS, FLOATS, FLOATS), max_size=12)


def tracked(sea, seed=1, matcher=None):
    """Return quality of the numbers of a sea."""
    matcher = matcher or ShipMatcher()
    seen = [*frames(sea, seed)]
    numbers = [matcher.track(*frame[:4], sea.size) for frame in seen]
    return quality([frame.truth for frame in seen], numbers)


def followed_by_pose(sea, seed, error):
    """Follow the ships of a sea by poses that are off, metres; how good the numbers are."""
    matcher, truth, numbers, last = ShipMatcher(), [], [], None
    errors = np.random.default_rng(seed).normal(0.0, 1.0, (1000, 2)) @ [error, 1j * error]
    for number, frame in enumerate(frames(sea, seed)):
        off = errors[number] - errors[number - 1]
        carry = None if last is None else frame.carry_from(last, off)
        numbers.append(matcher.track(*frame[:4], sea.size, carry))
        truth.append(frame.truth)
        last = frame
    return quality(truth, numbers)


def still_fleet(seed, count=12):
    """Make up boxes that are far from each other and from the border."""
    random = np.random.default_rng(seed)
    cells = random.permutation(30)[:count]
    place = 800 + 400 * (cells % 6) + 1j * (700 + 300 * (cells // 6))
    place = place + random.uniform(-90, 90, count) + 1j * random.uniform(-90, 90, count)
    return place, random.uniform(20, 120, count), random.uniform(-3, 3, count)


@pytest.mark.parametrize(
    'sea',
    [
        Sea(ships=300, strip=15e3),
        SPARSE,
        Sea(ships=200, berthed=0.0, strip=15e3, turn=5.0),
        Sea(ships=200, berthed=0.0, strip=15e3, zoom=0.05),
        Sea(ships=200, strip=15e3, wobble=1.0),
        Sea(ships=200, strip=15e3, misses=0.3, false_alarms=0.3),
        Sea(ships=200, strip=15e3, dropped=(9, 10, 20)),
    ],
    ids=['rows', 'sparse', 'turn', 'zoom', 'wobble', 'noise', 'dropped'],
)
def test_a_ship_keeps_its_number_while_the_camera_passes(sea) -> None:
    found = [tracked(sea, seed) for seed in (1, 2, 3)]
    assert np.median([one.ids_per_ship for one in found]) <= 1.07
    assert np.median([one.merged for one in found]) <= 0.03


@pytest.mark.parametrize('cut', ['frame', 'axis'])
def test_large_ships_at_the_border_of_a_hovering_camera_keep_their_number(cut) -> None:
    sea = replace(HOVERING, ships=100, hover=15.0, rate=10.0, cut=cut)
    found = [tracked(sea, seed) for seed in (1, 2, 3)]
    assert np.median([one.ids_per_ship for one in found]) <= 1.1
    assert np.median([one.merged for one in found]) <= 0.05


def test_a_ship_that_was_not_seen_for_too_long_is_another_one() -> None:
    place, length, angle = still_fleet(1)
    matcher = ShipMatcher(memory=5.0)
    first = matcher.track(0.0, place, length, angle, SIZE)
    assert (matcher.track(4.0, place, length, angle, SIZE) == first).all()
    assert matcher.track(20.0, place, length, angle, SIZE).min() > first.max()


def test_a_hint_finds_a_lone_ship_anywhere() -> None:
    matcher = ShipMatcher()
    length, angle = np.array([50.0]), np.array([0.3])
    for number in range(5):
        place = np.array([1000 + 1000j + 20 * number])
        (first,) = matcher.track(0.1 * number, place, length, angle, SIZE)
    place = np.array([2500 + 1900j])
    moved = place[0] - 1080 - 1000j
    assert matcher.track(0.5, place, length, angle, SIZE, lambda at: at + moved) == [first]


@pytest.mark.parametrize(('ships', 'error'), [(10, 0.0), (10, 20.0), (100, 0.0), (100, 20.0)])
@pytest.mark.parametrize('change', [{}, {'turn': 90.0, 'zoom': 0.3}])
def test_with_a_pose_ships_keep_their_number_whatever_the_camera_does(ships, error, change) -> None:
    sea = Sea(ships=ships, berthed=0.0, turns_at=20, **change)
    qualities = [followed_by_pose(sea, seed, error) for seed in range(1, 6)]
    assert np.median([one.ids_per_ship for one in qualities]) <= 1.03
    assert np.median([one.merged for one in qualities]) == 0.0


def test_a_ship_that_left_the_image_is_known_again_where_the_pose_says_that_it_is() -> None:
    matcher, length, angle = ShipMatcher(memory=100.0), np.array([50.0]), np.array([0.3])
    numbers, shift = [], 0.0
    for time, now in ((0.0, 0.0), (1.0, 9000.0), (2.0, -9000.0), (50.0, 200.0)):
        rows = slice(0, int(abs(now) < 1000))
        place, moved = np.array([500.0 + now + 500j]), now - shift
        carry = None if time == 0.0 else lambda at, moved=moved: at + moved
        numbers += matcher.track(time, place[rows], length[rows], angle[rows], SIZE, carry).tolist()
        shift = now
    assert numbers == [0, 0]


def test_where_the_pose_knows_nothing_the_boxes_alone_count() -> None:
    matcher, (place, length, angle) = ShipMatcher(), still_fleet(1)
    first = matcher.track(0.0, place, length, angle, SIZE)
    nothing = lambda at: np.full(len(at), complex(np.nan, np.nan))  # noqa: E731
    assert (matcher.track(0.1, place + 30, length, angle, SIZE, nothing) == first).all()


@given(st.integers(0, 1000), st.randoms(use_true_random=False))
def test_numbers_do_not_depend_on_the_order_of_the_boxes(seed, random) -> None:
    one, other = ShipMatcher(), ShipMatcher()
    for number, frame in zip(range(4), frames(SPARSE, seed), strict=False):
        numbers = one.track(*frame[:4], SPARSE.size)
        order = random.sample(range(len(numbers)), len(numbers))
        rows = [column[order] for column in frame[1:4]]
        again = other.track(frame.time, *rows, SPARSE.size)
        assert (again == numbers[order]).all(), number


@given(
    st.integers(0, 1000),
    st.integers(-300, 300),
    st.integers(-300, 300),
    st.sampled_from([0, 1, 2, 3]),
    st.floats(-0.2, 0.2),
)
def test_numbers_do_not_depend_on_where_and_how_the_camera_looks(
    seed, right, down, quarters, turn
) -> None:
    place, length, angle = still_fleet(seed)
    middle = SIZE / 2
    matcher = ShipMatcher()
    first = None
    for number, (shift, turned) in enumerate(
        [(0, 0.0), (right + 1j * down, 0.0), (right / 2, 0.0), (right / 2 + 1j * down, turn)]
    ):
        spin = np.exp(1j * (turned + quarters * np.pi / 2))
        size = SIZE if quarters % 2 == 0 else complex(SIZE.imag, SIZE.real)
        at = (place - middle) * spin + size / 2 + shift
        numbers = matcher.track(float(number), at, length, angle + np.angle(spin), size)
        first = numbers if first is None else first
        assert (numbers == first).all()


def test_the_same_frames_get_the_same_numbers() -> None:
    runs = []
    for _ in range(2):
        matcher = ShipMatcher()
        runs.append([matcher.track(*f[:4], SPARSE.size).tolist() for f in frames(SPARSE, 3)])
    assert runs[0] == runs[1]


@given(st.lists(st.tuples(st.floats(-1e9, 1e9), ROWS), max_size=5))
def test_no_two_boxes_of_a_frame_share_a_number_whatever_they_are(sequence) -> None:
    matcher = ShipMatcher()
    with warnings.catch_warnings():
        warnings.simplefilter('error')
        for time, rows in sequence:
            x, y, length, angle = np.array(rows, float).reshape(-1, 4).T
            place = np.empty(len(x), complex)
            place.real, place.imag = x, y
            numbers = matcher.track(time, place, length, angle, SIZE)
            given_ones = numbers[numbers >= 0]
            assert len(np.unique(given_ones)) == len(given_ones)
            is_finite = np.isfinite(np.column_stack((x, y, length, angle))).all(axis=1)
            assert not (numbers[~is_finite] >= 0).any()


@pytest.mark.parametrize('has_turned', [False, True])
def test_boxes_that_fall_on_one_spot_do_not_shrink_the_image_to_it(has_turned) -> None:
    start = np.arange(6.0) + 0j
    assert fitted(start, np.zeros(6) + 0j, 1.0, has_turned) == (1.0, -2.5)


def test_time_that_goes_back_a_little_loses_no_ship() -> None:
    place, length, angle = still_fleet(2)
    matcher = ShipMatcher()
    numbers = [
        matcher.track(time, place + 10 * time, length, angle, SIZE).tolist()
        for time in (0.0, 0.2, 0.1, 0.3, 0.3)
    ]
    assert all(one == numbers[0] for one in numbers)


def test_memory_is_bounded() -> None:
    random = np.random.default_rng(1)
    matcher = ShipMatcher()
    for number in range(8):
        place = random.uniform(0, 4000, MAX_BOXES) + 1j * random.uniform(0, 3000, MAX_BOXES)
        length = random.uniform(5, 300, MAX_BOXES)
        matcher.track(0.1 * number, place, length, length, SIZE)
        assert matcher.object_count <= MAX_OBJECTS + MAX_BOXES


def test_too_many_boxes_are_followed_in_part_the_longest() -> None:
    count = MAX_BOXES + 100
    length = np.linspace(10, 20, count)
    place = 10.0 * np.arange(count) % 4000 + 1j * np.linspace(100, 2900, count)
    numbers = ShipMatcher().track(0.0, place, length, np.zeros(count), SIZE)
    assert (numbers[:100] == -1).all()
    assert (numbers[100:] >= 0).all()


def test_boxes_on_one_spot_are_compared_with_some_objects_only() -> None:
    first, last = np.zeros(1000, int), np.full(1000, 1000)
    i, j = index_pairs(first, last, 50_000)
    assert len(i) == 50_000
    assert np.bincount(i).max() == np.bincount(i).min() == 50
    assert (j >= 0).all()
    assert (j < 1000).all()
    same = np.full(MAX_BOXES, 50 + 50j), np.full(MAX_BOXES, 20.0), np.zeros(MAX_BOXES)
    matcher = ShipMatcher()
    for number in range(3):
        numbers = matcher.track(0.1 * number, *same, SIZE)
        assert len(np.unique(numbers)) == MAX_BOXES
