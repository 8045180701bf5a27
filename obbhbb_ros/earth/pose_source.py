# SPDX-License-Identifier: Apache-2.0
"""The pose of the camera at the time of an image, from the messages that have come."""

from __future__ import annotations

from typing import NamedTuple
from typing import Protocol

from obbhbb_ros.earth.pose import Attitude
from obbhbb_ros.earth.pose import CameraPose
from obbhbb_ros.earth.pose import Fix
from obbhbb_ros.earth.pose import PoseError
from obbhbb_ros.earth.pose_track import SampleTrack
from obbhbb_ros.geometry.boxes import FloatArray
from obbhbb_ros.wire.poses import WireAttitude
from obbhbb_ros.wire.poses import WireFix
from obbhbb_ros.wire.poses import WirePose
from obbhbb_ros.wire.stamp import Stamp

__all__ = ['EARTH', 'CameraPoses', 'PoseAt', 'PoseSource', 'VehiclePoses']

EARTH = 'earth'
"""The frame of poses and positions: ECEF, by REP-105."""


class PoseAt(NamedTuple):
    """
    A pose of the camera at a stamp.

    Attributes
    ----------
    pose : CameraPose
        The pose.
    age : float
        Seconds between the stamp and the sample that is nearest to it.
    """

    pose: CameraPose
    age: float


class PoseSource(Protocol):
    """Knows the pose of the camera."""

    def has_reached(self, stamp: Stamp) -> bool:
        """Tell whether everything has come that the pose at a stamp needs, so that waiting ends."""

    def at(self, stamp: Stamp, max_age: float, mount: FloatArray) -> PoseAt | None:
        """
        Interpolate the pose at a stamp.

        Parameters
        ----------
        stamp : Stamp
            Seconds and nanoseconds.
        max_age : float
            How far from it samples may be, seconds.
        mount : ndarray, shape (4,)
            How the camera is mounted on its vehicle, as in `CameraPose.from_parts`.
        """

    def why_not(self, stamp: Stamp) -> str:
        """Say how far the samples are from a stamp that has no pose."""

    def clear(self) -> None:
        """Forget all samples."""


class CameraPoses:
    """
    Poses of the camera itself.

    Examples
    --------
    >>> poses = CameraPoses()
    >>> down = (0.5, 0.5, -0.5, -0.5)
    >>> poses.add(WirePose((10, 0), 'earth', (6878137.0, 0.0, 0.0), down, ()))
    >>> poses.add(WirePose((10, 500_000_000), 'earth', (6878137.0, 3500.0, 0.0), down, ()))
    >>> found = poses.at((10, 100_000_000), 1.0, None)
    >>> found.pose.position.round(3).tolist(), round(found.age, 3)
    ([6878137.0, 700.0, 0.0], 0.1)
    """

    def __init__(self) -> None:
        self._track = SampleTrack[CameraPose]()

    def add(self, pose: WirePose) -> None:
        """
        Add a pose.

        Raises
        ------
        PoseError
            If it is not in frame `earth`, or not a pose.
        """
        if pose.frame_id.lstrip('/') != EARTH:
            raise PoseError(f"it is in frame '{pose.frame_id}', not '{EARTH}'")
        covariance = pose.covariance or None
        self._track.add(
            pose.stamp, CameraPose.from_message(pose.position, pose.orientation, covariance)
        )

    def has_reached(self, stamp: Stamp) -> bool:
        """Tell whether a pose has come that is as late as a stamp."""
        return self._track.has_reached(stamp)

    def at(self, stamp: Stamp, max_age: float, mount: FloatArray | None = None) -> PoseAt | None:
        """Interpolate the pose at a stamp; the mount is in the poses already."""
        found = self._track.at(stamp, max_age)
        return None if found is None else PoseAt(*found)

    def why_not(self, stamp: Stamp) -> str:
        """Say how far the nearest pose is from a stamp."""
        return _gap_text('pose', self._track.gap(stamp))

    def clear(self) -> None:
        """Forget all poses."""
        self._track.clear()


class VehiclePoses:
    """Places and attitudes of the vehicle that carries the camera."""

    def __init__(self) -> None:
        self._fixes, self._attitudes = SampleTrack[Fix](), SampleTrack[Attitude]()

    def add_fix(self, fix: WireFix) -> None:
        """Add a place; PoseError if it is not one."""
        self._fixes.add(
            fix.stamp,
            Fix.from_message(
                *fix.place,
                status=fix.status,
                covariance=fix.covariance,
                covariance_type=fix.covariance_type,
            ),
        )

    def add_attitude(self, attitude: WireAttitude) -> None:
        """Add an attitude; PoseError if it is not one."""
        self._attitudes.add(
            attitude.stamp, Attitude.from_message(attitude.orientation, attitude.covariance)
        )

    def has_reached(self, stamp: Stamp) -> bool:
        """Tell whether a place and an attitude have come that are as late as a stamp."""
        return self._fixes.has_reached(stamp) and self._attitudes.has_reached(stamp)

    def at(self, stamp: Stamp, max_age: float, mount: FloatArray) -> PoseAt | None:
        """Interpolate place and attitude at a stamp, and mount the camera."""
        fix, attitude = self._fixes.at(stamp, max_age), self._attitudes.at(stamp, max_age)
        if fix is None or attitude is None:
            return None
        pose = CameraPose.from_parts(fix.sample, attitude.sample, mount)
        return PoseAt(pose, max(fix.age, attitude.age))

    def why_not(self, stamp: Stamp) -> str:
        """Say how far the nearest place and the nearest attitude are from a stamp."""
        fix, attitude = self._fixes.gap(stamp), self._attitudes.gap(stamp)
        return f'{_gap_text("fix", fix)}, {_gap_text("attitude", attitude)}'

    def clear(self) -> None:
        """Forget all samples."""
        self._fixes.clear()
        self._attitudes.clear()


def _gap_text(what: str, gap: float | None) -> str:
    """Say how far the nearest sample is."""
    if gap is None:
        return f'no {what} has come'
    return f'the nearest {what} is {abs(gap):.3g} s {"later" if gap > 0.0 else "earlier"}'
