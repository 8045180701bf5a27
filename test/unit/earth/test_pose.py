# SPDX-License-Identifier: Apache-2.0
"""Poses from the fields of messages, and between two of them."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from obbhbb_ros.earth.ellipsoid import east_north_up
from obbhbb_ros.earth.ellipsoid import to_ecef
from obbhbb_ros.earth.pose import Attitude
from obbhbb_ros.earth.pose import CameraPose
from obbhbb_ros.earth.pose import Fix
from obbhbb_ros.earth.pose import PoseError
from obbhbb_ros.earth.pose_track import SampleTrack
from obbhbb_ros.earth.quaternions import enu_quaternion
from obbhbb_ros.earth.quaternions import matrices_of_vectors
from obbhbb_ros.earth.quaternions import matrix_of
from obbhbb_ros.earth.quaternions import product
from obbhbb_ros.earth.quaternions import slerp
from obbhbb_ros.earth.quaternions import unit_quaternion

NUMBER = st.floats(-1.0, 1.0)
QUATERNION = (
    st.tuples(NUMBER, NUMBER, NUMBER, NUMBER)
    .filter(lambda q: np.linalg.norm(q) > 0.1)
    .map(lambda q: unit_quaternion(np.array(q) / np.linalg.norm(q)))
)
FRACTION = st.floats(0.0, 1.0)
PLACE = (6878137.0, 0.0, 0.0)
LEVEL = (0.0, 0.0, 0.0, 1.0)
# Of a camera that looks down, image up to the front of the body.
DOWN = unit_quaternion([0.5**0.5, -(0.5**0.5), 0.0, 0.0])


@given(QUATERNION, QUATERNION)
def test_products_are_those_of_the_matrices(left, right) -> None:
    both = matrix_of(product(left, right))
    np.testing.assert_allclose(both, matrix_of(left) @ matrix_of(right), atol=1e-12)
    np.testing.assert_allclose(both @ both.T, np.eye(3), atol=1e-12)


@given(st.floats(-90, 90), st.floats(-180, 180))
def test_east_north_up_is_the_same_as_matrix_and_quaternion(latitude, longitude) -> None:
    quaternion = enu_quaternion(latitude, longitude)
    axes = east_north_up(latitude, longitude)
    np.testing.assert_allclose(matrix_of(quaternion), axes.T, atol=1e-12)


@given(QUATERNION, QUATERNION, FRACTION)
def test_slerp_turns_evenly_by_the_shorter_way(before, after, fraction) -> None:
    middle = slerp(before, after, fraction)
    assert np.linalg.norm(middle) == pytest.approx(1.0)

    def angle(left, right):
        cosine = (np.trace(matrix_of(left).T @ matrix_of(right)) - 1) / 2
        return np.arccos(np.clip(cosine, -1, 1))

    whole = angle(before, after)
    assert angle(before, middle) == pytest.approx(fraction * whole, abs=1e-6)
    assert angle(middle, after) == pytest.approx((1 - fraction) * whole, abs=1e-6)
    same = matrix_of(slerp(before, -after, fraction))
    if abs(before @ after) > 1e-6:
        np.testing.assert_allclose(same, matrix_of(middle), atol=1e-6)


@given(st.lists(st.floats(-2.0, 2.0), min_size=3, max_size=3))
def test_rotation_vectors_turn_about_themselves_by_their_length(vector) -> None:
    (matrix,) = matrices_of_vectors([vector])
    np.testing.assert_allclose(matrix @ vector, vector, atol=1e-12)
    angle = np.linalg.norm(vector)
    assert np.trace(matrix) == pytest.approx(1 + 2 * np.cos(angle))
    tiny = 1e-9 * np.array(vector)
    x, y, z = tiny
    np.testing.assert_allclose(
        matrices_of_vectors([tiny])[0] - np.eye(3), [[0, -z, y], [z, 0, -x], [-y, x, 0]], atol=1e-15
    )


@pytest.mark.parametrize(
    ('position', 'attitude', 'reason'),
    [
        ((np.nan, 0, 0), LEVEL, 'position'),
        ((1e12, 0, 0), LEVEL, 'position'),
        ((0, 0), LEVEL, 'position'),
        (PLACE, (0, 0, 0, 0), 'length 0'),
        (PLACE, (0, 0, 0, np.nan), 'length nan'),
        (PLACE, (0, 0, 0, 1.1), 'length 1.1'),
        (PLACE, (0, 0, 1), 'four numbers'),
    ],
)
def test_what_is_no_pose_is_refused_with_the_reason(position, attitude, reason) -> None:
    with pytest.raises(PoseError, match=reason):
        CameraPose.from_message(position, attitude)


@pytest.mark.parametrize(
    'covariance',
    [None, [0.0] * 36, [np.nan] * 36, [-1.0] + [0.0] * 35, [1e300] * 36, [1.0] * 9, []],
)
def test_what_is_no_covariance_is_not_known(covariance) -> None:
    assert CameraPose.from_message(PLACE, LEVEL, covariance).covariance is None


def test_a_covariance_is_taken_row_by_row_and_made_symmetric() -> None:
    numbers = np.diag([1.0, 2.0, 3.0, 4.0, 5.0, 6.0])
    numbers[0, 5] = 0.5
    covariance = CameraPose.from_message(PLACE, LEVEL, numbers.ravel()).covariance
    assert covariance.shape == (6, 6)
    assert covariance[0, 5] == covariance[5, 0] == 0.25
    assert np.diagonal(covariance).tolist() == [1, 2, 3, 4, 5, 6]


def test_a_vehicle_with_its_camera_down_looks_at_the_place_below_it() -> None:
    fix = Fix.from_message(54.0, 12.0, 120.0)
    # Its front to the east, level; and to the north.
    east = CameraPose.from_parts(fix, Attitude.from_message(LEVEL), DOWN)
    axes = east_north_up(54.0, 12.0)
    np.testing.assert_allclose(axes @ east.matrix @ (0, 0, 1), (0, 0, -1), atol=1e-12)
    np.testing.assert_allclose(axes @ east.matrix @ (0, -1, 0), (1, 0, 0), atol=1e-12)
    to_north = Attitude.from_message((0, 0, 0.5**0.5, 0.5**0.5))
    north = CameraPose.from_parts(fix, to_north, DOWN)
    np.testing.assert_allclose(axes @ north.matrix @ (0, -1, 0), (0, 1, 0), atol=1e-12)
    np.testing.assert_allclose(east.position, to_ecef(54.0, 12.0, 120.0))


def test_the_uncertainty_of_a_vehicle_is_turned_to_the_earth() -> None:
    fix = Fix.from_message(
        54.0, 12.0, 120.0, covariance=np.diag([1.0, 4.0, 9.0]).ravel(), covariance_type=2
    )
    attitude = Attitude.from_message(LEVEL, np.diag([0.01, 0.02, 0.03]).ravel())
    covariance = CameraPose.from_parts(fix, attitude, DOWN).covariance
    axes = np.kron(np.eye(2), east_north_up(54.0, 12.0))
    back = axes @ covariance @ axes.T
    np.testing.assert_allclose(back, np.diag([1, 4, 9, 0.01, 0.02, 0.03]), atol=1e-12)
    unknown = Fix.from_message(54.0, 12.0, 120.0, covariance=[1.0] * 9, covariance_type=0)
    assert unknown.covariance is None
    assert CameraPose.from_parts(unknown, attitude, DOWN).covariance is None


@pytest.mark.parametrize(
    ('numbers', 'status', 'reason'),
    [
        ((54.0, 12.0, 9.0), -1, 'no fix'),
        ((91.0, 12.0, 9.0), 0, 'not degrees'),
        ((54.0, np.nan, 9.0), 0, 'not degrees'),
        ((54.0, 12.0, np.nan), 0, 'position'),
    ],
)
def test_what_is_no_fix_is_refused_with_the_reason(numbers, status, reason) -> None:
    with pytest.raises(PoseError, match=reason):
        Fix.from_message(*numbers, status=status)


def test_an_imu_without_orientation_is_refused() -> None:
    with pytest.raises(PoseError, match='has no orientation'):
        Attitude.from_message(LEVEL, [-1.0] + [0.0] * 8)
    with pytest.raises(PoseError, match='length 0'):
        Attitude.from_message([0.0] * 4, [0.0] * 9)


def pose_at(x, turn=0.0):
    """Make a pose on a line that turns evenly."""
    return CameraPose.from_message(
        (7e6, x, 0), (0, 0, np.sin(turn / 2), np.cos(turn / 2)), np.eye(6) * (1 + x)
    )


def test_a_pose_between_two_moves_along_a_line_and_turns_evenly() -> None:
    pose = pose_at(0.0).toward(pose_at(8.0, 0.4), 0.25)
    assert pose.position.tolist() == [7e6, 2.0, 0.0]
    assert 2 * np.arcsin(pose.attitude[2]) == pytest.approx(0.1)
    np.testing.assert_allclose(pose.covariance, np.eye(6) * 3)
    assert pose_at(0.0).toward(CameraPose.from_message(PLACE, LEVEL), 0.5).covariance is None


def test_a_fix_between_two_crosses_the_antimeridian() -> None:
    middle = Fix.from_message(0, 179.9, 0).toward(Fix.from_message(0, -179.9, 0), 0.5)
    assert abs(middle.longitude) == pytest.approx(180.0)


def test_a_track_gives_what_lies_between_and_never_beyond() -> None:
    track = SampleTrack()
    assert track.at((1, 0), 1.0) is None
    for second in (10, 12, 11):
        track.add((second, 0), pose_at(float(second)))
    assert track.at((11, 0), 0.0).sample.position[1] == 11
    sample, age = track.at((10, 250_000_000), 1.0)
    assert (sample.position[1], age) == (10.25, 0.25)
    assert track.at((10, 250_000_000), 0.7) is None
    for stamp in ((9, 999_999_999), (12, 1)):
        assert track.at(stamp, 10.0) is None


def test_a_track_says_when_no_earlier_sample_is_to_be_waited_for() -> None:
    track = SampleTrack()
    assert not track.has_reached((0, 0))
    track.add((12, 0), pose_at(0.0))
    assert track.has_reached((12, 0))
    assert not track.has_reached((12, 1))
    track.clear()
    assert not track.has_reached((0, 0))


def test_a_track_is_bounded() -> None:
    track = SampleTrack()
    for second in range(5_000):
        track.add((second, 0), pose_at(0.0))
        assert len(track) <= 2000
    assert track.at((4_990, 500_000_000), 1.0) is not None
    assert track.at((2_990, 0), 1.0) is None


def test_samples_of_a_clock_that_was_set_back_are_not_mixed_with_those_before() -> None:
    track = SampleTrack()
    for second in (10, 11, 12, 13):
        track.add((second, 0), pose_at(0.0))
    track.add((10, 500_000_000), pose_at(7.0))
    assert len(track) == 1
    assert not track.has_reached((11, 0))
    track.add((11, 500_000_000), pose_at(8.0))
    assert track.at((11, 0), 1.0).sample.position[1] == 7.5


def test_a_sample_of_the_far_future_ends_no_waiting_for_others() -> None:
    track = SampleTrack()
    for second in (10, 2**31 - 1, 11):
        track.add((second, 0), pose_at(0.0))
    assert not track.has_reached((12, 0))


def test_a_sample_with_the_stamp_of_another_replaces_it() -> None:
    track = SampleTrack()
    for x in (1.0, 2.0):
        track.add((5, 0), pose_at(x))
    assert len(track) == 1
    assert track.at((5, 0), 1.0).sample.position[1] == 2.0


@pytest.mark.parametrize(
    ('mount', 'looks', 'up'),
    [
        ((-0.5, 0.5, -0.5, 0.5), (1, 0, 0), (0, 0, 1)),
        ((-0.6533, 0.6533, -0.2706, 0.2706), (0.7071, 0, -0.7071), (0.7071, 0, 0.7071)),
        ((-0.7071, 0.7071, 0, 0), (0, 0, -1), (1, 0, 0)),
    ],
)
def test_the_mounts_of_the_page_look_where_it_says(mount, looks, up) -> None:
    matrix = matrix_of(unit_quaternion(mount))
    np.testing.assert_allclose(matrix @ (0, 0, 1), looks, atol=1e-3)
    np.testing.assert_allclose(matrix @ (0, -1, 0), up, atol=1e-3)


@given(QUATERNION)
def test_the_attitude_of_px4_is_turned_as_the_page_says(quaternion) -> None:
    turned = product(product((0.5**0.5, 0.5**0.5, 0, 0), quaternion), (1, 0, 0, 0))
    # Forward is the same axis of the body; north and east change places, and up is not down.
    north, east, down = matrix_of(quaternion) @ (1, 0, 0)
    np.testing.assert_allclose(matrix_of(turned) @ (1, 0, 0), (east, north, -down), atol=1e-12)
    north, east, down = matrix_of(quaternion) @ (0, 0, 1)
    np.testing.assert_allclose(matrix_of(turned) @ (0, 0, -1), (east, north, -down), atol=1e-12)
