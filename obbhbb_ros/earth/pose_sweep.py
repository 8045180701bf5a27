# SPDX-License-Identifier: Apache-2.0
"""The poses of a camera that reads its lines one after the other."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from obbhbb_ros.earth.pose import CameraPose
from obbhbb_ros.earth.quaternions import matrices_of
from obbhbb_ros.geometry.boxes import FloatArray

__all__ = ['PoseSweep', 'swept_pose']

# Seconds between two poses that a line joins, and the maximum number of poses. In orbit the path
# leaves such a line by 1 m in a second, and by 1 cm in a tenth of it.
_SPACING = 0.1
_MAX_POSES = 64


@dataclass(frozen=True, eq=False)
class PoseSweep:
    """
    The poses of a camera from the first line of an image to the last one.

    It replaces a `CameraPose` for a pushbroom camera or a rolling shutter. Make it with
    `swept_pose`.

    Attributes
    ----------
    poses : tuple of CameraPose
        At even steps, the first one at the first line.
    line_count : float
        Height of the image, pixels.
    """

    poses: tuple[CameraPose, ...]
    line_count: float

    @property
    def _middle(self) -> CameraPose:
        """The pose in the middle of the image."""
        return self.poses[len(self.poses) // 2]

    @property
    def position(self) -> FloatArray:
        """Where the camera is in the middle of the image, (3,), ECEF, metres."""
        return self._middle.position

    @property
    def attitude(self) -> FloatArray:
        """The attitude in the middle of the image, (4,)."""
        return self._middle.attitude

    @property
    def covariance(self) -> FloatArray | None:
        """The covariance in the middle of the image, (6, 6), or None."""
        return self._middle.covariance

    def origins(self, lines: FloatArray) -> FloatArray:
        """Tell where the camera was at lines, (M,), pixels from the first one: (M, 3), ECEF."""
        before, part = self._steps(lines)
        positions = np.array([pose.position for pose in self.poses])
        steps: FloatArray = positions[before + 1] - positions[before]
        return positions[before] + part[:, None] * steps

    def turned(self, rays: FloatArray, lines: FloatArray) -> FloatArray:
        """Turn rays, (M, 3), of the optical frame into ECEF, by the lines that saw them, (M,)."""
        before, part = self._steps(lines)
        attitudes = np.array([pose.attitude for pose in self.poses])
        first, second = attitudes[before], attitudes[before + 1]
        # A quaternion and its negative are the same attitude; between close ones a line is enough.
        second = np.where((first * second).sum(axis=1, keepdims=True) < 0.0, -second, second)
        mixed = first + part[:, None] * (second - first)
        mixed /= np.sqrt((mixed * mixed).sum(axis=1, keepdims=True))
        return np.einsum('mij,mj->mi', matrices_of(mixed), rays)

    def _steps(self, lines: FloatArray) -> tuple[np.ndarray, FloatArray]:
        """Find the pose before each line, and the fraction of the way to the next pose."""
        count = len(self.poses) - 1
        along = np.nan_to_num(lines / self.line_count, nan=0.0) * count
        before = np.clip(np.floor(along), 0, count - 1).astype(np.int64)
        return before, along - before


def swept_pose(
    pose_after: Callable[[float], CameraPose | None], readout: float, line_count: float
) -> PoseSweep | None:
    """
    Collect the poses of an image that is read line by line.

    Parameters
    ----------
    pose_after : callable
        Returns the pose some seconds after the stamp of the image, None if it is not known.
    readout : float
        Seconds from the first line to the last one.
    line_count : float
        Height of the image, pixels.

    Returns
    -------
    PoseSweep or None
        None if one of the poses is not known.

    Examples
    --------
    >>> pose = CameraPose.from_message([6878137, 0, 0], [0.5, 0.5, -0.5, -0.5])
    >>> later = CameraPose.from_message([6878137, 7000, 0], [0.5, 0.5, -0.5, -0.5])
    >>> sweep = swept_pose(lambda seconds: pose.toward(later, seconds), 0.5, 1000)
    >>> sweep.origins(np.array([0.0, 500.0, 1000.0]))[:, 1].round(6).tolist()
    [0.0, 1750.0, 3500.0]
    """
    count = min(max(math.ceil(readout / _SPACING), 1), _MAX_POSES - 1)
    poses = [pose_after(readout * step / count) for step in range(count + 1)]
    known = tuple(pose for pose in poses if pose is not None)
    return PoseSweep(known, line_count) if len(known) == len(poses) else None
