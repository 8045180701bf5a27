# SPDX-License-Identifier: Apache-2.0
"""Place the ships of an image on Earth: boxes, camera and poses in, places and reasons out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from obbhbb_ros.earth.pinhole import Pinhole
from obbhbb_ros.earth.placement import Placement
from obbhbb_ros.earth.placement import Unplaced
from obbhbb_ros.earth.placement import place
from obbhbb_ros.earth.pose import CameraPose
from obbhbb_ros.earth.pose_source import EARTH
from obbhbb_ros.earth.pose_source import PoseSource
from obbhbb_ros.earth.pose_sweep import PoseSweep
from obbhbb_ros.earth.pose_sweep import swept_pose
from obbhbb_ros.earth.reported import reported_covariances
from obbhbb_ros.earth.reprojection import Viewpoint
from obbhbb_ros.geometry.boxes import OrientedBoxes
from obbhbb_ros.settings.ship_tracker import PlaceSettings
from obbhbb_ros.wire.camera import WireCamera
from obbhbb_ros.wire.detections import Detections
from obbhbb_ros.wire.poses import WirePose
from obbhbb_ros.wire.poses import pose_bytes
from obbhbb_ros.wire.positions import WirePositions
from obbhbb_ros.wire.stamp import Stamp
from obbhbb_ros.wire.stamp import later
from obbhbb_ros.wire.stamp import stamp_text

_REASONS = {
    Unplaced.NO_BOX: ('invalid', 'the box is invalid'),
    Unplaced.NO_RAY: ('lens', 'the distortion of the lens has no inverse at the box'),
    Unplaced.BELOW_SURFACE: ('below_surface', 'the camera is below surface_height'),
    Unplaced.ABOVE_HORIZON: ('above_horizon', 'part of the ship is above the horizon'),
    Unplaced.LOW: ('low', 'seen from the ship, the camera stands lower than min_elevation'),
}


@dataclass(frozen=True, eq=False)
class PlacedShips:
    """
    The ships of an image, with their places.

    Attributes
    ----------
    stamp : Stamp
        Stamp of the image.
    placement : Placement
        Where they are; NaN where they have no place.
    viewpoint : Viewpoint or None
        The camera of the image and its pose, if both are known and the same for all lines.
    pose : CameraPose, PoseSweep or None
        The pose of the camera, if that is known.
    age : float
        Seconds between the image and the nearest sample of the pose; 0 without one.
    counts, complaints : dict
        By key of the diagnostics, and what went wrong, by kind.
    """

    stamp: Stamp
    placement: Placement
    viewpoint: Viewpoint | None
    pose: CameraPose | PoseSweep | None
    age: float
    counts: dict[str, int]
    complaints: dict[str, str]

    def within(self, lengths: tuple[float, float]) -> NDArray[np.bool_]:
        """Tell which ships have a length within limits, metres, or have no place."""
        low, high = lengths
        with np.errstate(invalid='ignore'):
            others = (self.placement.length < low) | (self.placement.length > high)
        return ~others

    def message(self, detections: Detections, ids: Sequence[str], rows: NDArray[np.intp]) -> bytes:
        """
        Write where ships are, as `vision_msgs/Detection3DArray`.

        Parameters
        ----------
        detections : Detections
            The detections.
        ids : sequence of str
            M ids.
        rows : ndarray of int, shape (M,)
            The detections that are passed on.
        """
        ships, classes = self.placement, detections.class_ids()
        own = later(self.stamp, -self.age)
        return WirePositions(
            stamp=self.stamp,
            frame_id=EARTH,
            ids=ids,
            class_ids=[classes[row] for row in rows.tolist()],
            scores=detections.scores()[rows],
            points=ships.points[rows],
            attitudes=ships.attitudes[rows],
            sizes=np.stack((ships.length, ships.width), axis=-1)[rows],
            covariances=reported_covariances(ships)[rows],
            own_stamps=[own] * len(ids),
        ).to_bytes()

    def pose_message(self) -> bytes | None:
        """Write the pose of the image, as `geometry_msgs/PoseWithCovarianceStamped`."""
        if self.pose is None:
            return None
        spread = self.pose.covariance
        return pose_bytes(
            WirePose(
                self.stamp,
                EARTH,
                tuple(self.pose.position.tolist()),
                tuple(self.pose.attitude.tolist()),
                () if spread is None else tuple(spread.ravel().tolist()),
            )
        )


class ShipPlacer:
    """
    Places the ships of image after image.

    Parameters
    ----------
    poses : PoseSource
        Knows where the camera is.
    """

    def __init__(self, poses: PoseSource) -> None:
        self._poses = poses
        self._known: tuple[WireCamera, Pinhole | str] | None = None

    def place(
        self,
        boxes: OrientedBoxes,
        stamp: Stamp,
        camera: WireCamera | None,
        settings: PlaceSettings,
    ) -> PlacedShips:
        """
        Place the ships of an image.

        Parameters
        ----------
        boxes : OrientedBoxes
            N boxes, pixels of the image.
        stamp : Stamp
            Stamp of the image.
        camera : WireCamera or None
            Its camera, if that is known.
        settings : PlaceSettings
            The settings.
        """
        pinhole = self._pinhole(camera)
        height = camera.image_size[1] if camera else 0
        pose, age = self._pose(stamp, height, settings)
        if isinstance(pinhole, str):
            reason = ('no_camera', pinhole)
        elif pose is None:
            why = self._poses.why_not(stamp)
            reason = ('no_pose', f'no poses before and after it within pose_max_age: {why}')
        else:
            heights = settings.surface_height, settings.min_elevation
            ships = place(boxes, pinhole, pose, *heights)
            counts, complaints = _findings(ships.unplaced, stamp)
            view = None
            if isinstance(pose, CameraPose):
                view = Viewpoint(pinhole, pose, settings.surface_height)
            return PlacedShips(stamp, ships, view, pose, age, counts, complaints)
        key, why = reason
        counts = {f'ships_unplaced.{key}': len(boxes)} if len(boxes) else {}
        text = f'the ships at stamp {stamp_text(stamp)} get no place: {why}'
        nowhere = Placement.nowhere(len(boxes))
        return PlacedShips(stamp, nowhere, None, pose, age, counts, {key: text})

    def _pose(
        self, stamp: Stamp, height: int, settings: PlaceSettings
    ) -> tuple[CameraPose | PoseSweep | None, float]:
        """Return the pose of an image, None if it is not known, and its age in seconds."""
        mount = np.array(settings.mount)
        middle = later(stamp, settings.readout / 2)
        found = self._poses.at(middle, settings.pose_max_age, mount)
        if found is None:
            return None, 0.0
        if not settings.readout or not height:
            return found

        def pose_after(seconds: float) -> CameraPose | None:
            at_line = self._poses.at(later(stamp, seconds), settings.pose_max_age, mount)
            return None if at_line is None else at_line.pose

        return swept_pose(pose_after, settings.readout, height), found.age

    def _pinhole(self, camera: WireCamera | None) -> Pinhole | str:
        """Return the camera of an image, or why there is none."""
        if camera is None:
            return 'no camera_info has come: publish it, or remap camera_info to its topic'
        if self._known is None or not _is_alike(self._known[0], camera):
            try:
                pinhole = Pinhole(camera.k, camera.d, camera.model, camera.roi[:2], camera.binning)
            except ValueError as error:
                self._known = camera, f'camera_info: {error}'
            else:
                self._known = camera, pinhole
        return self._known[1]


def _is_alike(camera: WireCamera, other: WireCamera) -> bool:
    """Tell whether two messages describe the same camera, window and binning."""
    return (camera.k, camera.d, camera.model, camera.roi, camera.binning) == (
        (other.k, other.d, other.model, other.roi, other.binning)
    )


def _findings(unplaced: NDArray[np.uint8], stamp: Stamp) -> tuple[dict[str, int], dict[str, str]]:
    """Count the ships without a place by reason, and complain by kind."""
    counts, complaints = {}, {}
    for reason, (key, text) in _REASONS.items():
        if number := int((unplaced == reason).sum()):
            counts[f'ships_unplaced.{key}'] = number
            if reason is not Unplaced.NO_BOX:
                complaints[key] = (
                    f'{number} of {len(unplaced)} ships at stamp {stamp_text(stamp)} get no place: '
                    f'{text}'
                )
    return counts, complaints
