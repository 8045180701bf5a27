# SPDX-License-Identifier: Apache-2.0
"""Parameters and settings of the node `ship_tracker`."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from obbhbb_ros.earth.quaternions import unit_quaternion
from obbhbb_ros.geometry.input_frame import InputFrame
from obbhbb_ros.limits import Choices
from obbhbb_ros.limits import Range
from obbhbb_ros.reports.ship_message import MIN_MESSAGE_BYTES
from obbhbb_ros.settings.common import COMMON_WITH_INPUT
from obbhbb_ros.settings.common import IMAGE_SIZE
from obbhbb_ros.settings.common import folder_of
from obbhbb_ros.settings.detection_input import DETECTION_INPUT
from obbhbb_ros.settings.detection_input import input_frame
from obbhbb_ros.settings.parameters import Parameter
from obbhbb_ros.settings.parameters import ParameterTable
from obbhbb_ros.wire.poses import POSE_MESSAGES

NO_POSE = 'none'
VEHICLE = 'NavSatFix'
POSE_TYPES = (NO_POSE, *POSE_MESSAGES, VEHICLE)
"""What tells where the camera is."""


@dataclass(frozen=True)
class PlaceSettings:
    """
    How ships are placed on Earth.

    Attributes
    ----------
    pose_max_age : float
        How far from an image the poses before and after it may be, seconds.
    surface_height : float
        Height of the water above the ellipsoid, metres.
    min_elevation : float
        How high the camera must stand above a ship's horizon, degrees.
    readout : float
        Seconds from the first line of an image to the last.
    mount : tuple of float
        Quaternion from the camera's optical frame to the body of its vehicle.
    lengths : tuple of float
        Minimum and maximum length of the ships that are passed on, metres.
    """

    pose_max_age: float
    surface_height: float
    min_elevation: float
    readout: float
    mount: tuple[float, ...]
    lengths: tuple[float, float]


@dataclass(frozen=True)
class ReportSettings:
    """
    Ship lists.

    Attributes
    ----------
    period : float
        Seconds between two lists; 0: none.
    max_bytes : int
        Maximum size of a message; 0: lists are GeoJSON.
    spool_path : str
        Folder of the spool.
    """

    period: float
    max_bytes: int
    spool_path: str


@dataclass(frozen=True)
class TrackerSettings:
    """
    How detections get the ids of ships.

    Attributes
    ----------
    keeps_ids : bool
        Whether ids of the input are kept.
    memory : float
        How long the node remembers a ship that it does not see, seconds.
    image_size : tuple of int
        Width and height from the parameters, pixels; 0 where `camera_info` decides.
    input_frame : InputFrame
        Coordinates of the input.
    has_bow : bool
        Whether the angles of the input point to the bow.
    place : PlaceSettings or None
        How ships are placed on Earth; None if they are not.
    reports : ReportSettings
        How ships are listed.
    """

    keeps_ids: bool
    memory: float
    image_size: tuple[int, int]
    input_frame: InputFrame
    has_bow: bool
    place: PlaceSettings | None
    reports: ReportSettings


def _tracker_settings(values: Mapping[str, Any]) -> TrackerSettings:
    """Make settings for `ship_tracker`."""
    if values['pose_type'] == NO_POSE:
        for name in ('min_length', 'max_length', 'report_period'):
            if values[name]:
                raise ValueError(f'{name} needs a pose of the camera: set pose_type')
    return TrackerSettings(
        keeps_ids=values['ids'] == 'keep',
        memory=values['memory'],
        image_size=(values['image_width'], values['image_height']),
        input_frame=input_frame(values),
        has_bow=values['heading'] == 'theta',
        place=None if values['pose_type'] == NO_POSE else _place_settings(values),
        reports=_report_settings(values),
    )


def _report_settings(values: Mapping[str, Any]) -> ReportSettings:
    """Make settings for ship lists."""
    period, max_bytes = values['report_period'], values['report_max_bytes']
    spool = folder_of(values, 'spool.path')
    if period and not spool:
        raise ValueError('report_period needs spool.path: name the folder of the spool')
    if 0 < max_bytes < MIN_MESSAGE_BYTES:
        raise ValueError(
            f'report_max_bytes must be 0 or at least {MIN_MESSAGE_BYTES}, not {max_bytes}'
        )
    return ReportSettings(period, max_bytes, spool)


def _place_settings(values: Mapping[str, Any]) -> PlaceSettings:
    """Make settings for the places of ships."""
    mount = tuple(values['camera_mount'])
    if values['pose_type'] == VEHICLE:
        if not any(mount):
            raise ValueError(
                f'camera_mount is missing: {VEHICLE} needs x, y, z and w of the rotation from the '
                'optical frame to the body of the vehicle'
            )
        try:
            mount = tuple(unit_quaternion(mount).tolist())
        except ValueError as error:
            raise ValueError(
                f'camera_mount must be x, y, z and w of the rotation from the optical frame to the '
                f'body of the vehicle: {error}'
            ) from None
    low, high = values['min_length'], values['max_length']
    if 0.0 < high < low:
        raise ValueError(f'min_length must be at most max_length, {high}, not {low}')
    return PlaceSettings(
        pose_max_age=values['pose_max_age'],
        surface_height=values['surface_height'],
        min_elevation=values['min_elevation'],
        readout=values['readout'],
        mount=mount,
        lengths=(low, high or math.inf),
    )


SHIP_TRACKER = ParameterTable(
    (
        *COMMON_WITH_INPUT,
        *DETECTION_INPUT,
        Parameter(
            'ids',
            'keep',
            'What to do with the ids of the input: `keep` them, and give ids only to detections '
            'without one; or `assign` new ids to all detections.',
            Choices(('keep', 'assign')),
        ),
        Parameter(
            'memory',
            30.0,
            'How long a ship keeps its id while no image shows it, seconds.',
            Range(0.0, 1e6),
        ),
        *IMAGE_SIZE,
        Parameter(
            'heading',
            'none',
            "`theta`: theta is the ship's heading (full circle). `none`: the course of a ship may "
            'be off by 180 degrees.',
            Choices(('none', 'theta')),
        ),
        Parameter(
            'pose_type',
            NO_POSE,
            'How the node learns where the camera is: the message type on `camera_pose`, or '
            '`NavSatFix` for messages on `fix` and `attitude`. `none`: it does not place ships on '
            'Earth.',
            Choices(POSE_TYPES),
            read_only=True,
        ),
        Parameter(
            'camera_mount',
            [0.0, 0.0, 0.0, 0.0],
            'Required with `NavSatFix`: x, y, z, w of the rotation from the optical frame of the '
            'camera to the body of its vehicle.',
        ),
        Parameter(
            'pose_max_age',
            1.0,
            'How far from an image the poses before and after it may be, seconds.',
            Range(0.0, 60.0),
        ),
        Parameter(
            'readout',
            0.0,
            'Seconds from the first line of an image, which has the time of the stamp, to the last '
            'line.',
            Range(0.0, 3600.0),
        ),
        Parameter(
            'surface_height',
            0.0,
            'Height of the water above the ellipsoid WGS84, metres: at sea, the undulation of the '
            'geoid.',
            Range(-1000.0, 9000.0),
        ),
        Parameter(
            'min_elevation',
            5.0,
            'How high the camera must stand above the horizon as seen from a ship, degrees. The '
            'node does not place ships that see it lower.',
            Range(0.0, 90.0),
        ),
        *(
            Parameter(
                f'{end}_length',
                0.0,
                f'{end.capitalize()}imum length of a ship, metres; the node does not pass on '
                f'{others} ones. 0: any length. Needs a pose.',
                Range(0.0, 1e6),
            )
            for end, others in (('min', 'shorter'), ('max', 'longer'))
        ),
        Parameter(
            'report_period',
            0.0,
            'Seconds between two ship lists; a list has the ships seen since the last one. 0: no '
            'lists. Needs a pose and `spool.path`.',
            Range(0.0, 1e6),
            read_only=True,
        ),
        Parameter(
            'report_max_bytes',
            0,
            'Maximum size of a list, bytes. A list is then a binary message with the most valuable '
            'ships, and the others go into the next one. 340 suits a short-burst message. 0: one '
            'GeoJSON file of all ships.',
            Range(0, 1_000_000),
        ),
        Parameter(
            'spool.path',
            '',
            'Folder of the spool for ship lists; as a rule that of chip_extractor.',
            read_only=True,
        ),
    ),
    _tracker_settings,
)
"""Parameters of the node `ship_tracker`."""
