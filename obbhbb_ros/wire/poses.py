# SPDX-License-Identifier: Apache-2.0
"""Poses, fixes and attitudes, read from the bytes of their messages."""

from __future__ import annotations

import math
import struct
from collections.abc import Sequence
from typing import Any
from typing import NamedTuple

from obbhbb_ros.wire.buffer import LITTLE_ENDIAN
from obbhbb_ros.wire.layouts import IMU
from obbhbb_ros.wire.layouts import NAV_SAT_FIX
from obbhbb_ros.wire.layouts import ODOMETRY
from obbhbb_ros.wire.layouts import POSE_STAMPED
from obbhbb_ros.wire.layouts import POSE_WITH_COVARIANCE_STAMPED
from obbhbb_ros.wire.stamp import Stamp
from obbhbb_ros.wire.walk import Step
from obbhbb_ros.wire.walk import read_struct
from obbhbb_ros.wire.writing import header_bytes
from obbhbb_ros.wire.writing import padding

_POSE_NUMBERS = 7
# Of an `Odometry` alone.
_CHILD = 'child_frame_id'
_LAYOUTS: dict[str, tuple[Sequence[Step], str, int]] = {
    'PoseStamped': (POSE_STAMPED, 'pose.position', 0),
    'PoseWithCovarianceStamped': (POSE_WITH_COVARIANCE_STAMPED, 'pose.pose.position', 36),
    'Odometry': (ODOMETRY, 'pose.pose.position', 36),
}
POSE_MESSAGES = tuple(_LAYOUTS)
"""Names of the messages of `geometry_msgs` and `nav_msgs` that `read_pose` takes."""


class WirePose(NamedTuple):
    """
    A pose as its message states it.

    Attributes
    ----------
    stamp : Stamp
        The header's stamp.
    frame_id : str
        The frame that the pose is given in.
    position : tuple of float
        x, y and z, metres.
    orientation : tuple of float
        x, y, z and w.
    covariance : tuple of float
        36 numbers row by row; none if the message has none.
    child_frame_id : str
        The frame whose pose it is; empty if the message does not say.
    """

    stamp: Stamp
    frame_id: str
    position: tuple[float, ...]
    orientation: tuple[float, ...]
    covariance: tuple[float, ...]
    child_frame_id: str = ''


class WireFix(NamedTuple):
    """
    A `sensor_msgs/NavSatFix`, its fields named and measured as there.

    Attributes
    ----------
    stamp : Stamp
        The header's stamp.
    status : int
        -1: no fix.
    place : tuple of float
        Latitude and longitude (degrees), altitude above the ellipsoid (metres).
    covariance : tuple of float
        Nine numbers, of east, north and up, m².
    covariance_type : int
        0: the covariance is not known.
    """

    stamp: Stamp
    status: int
    place: tuple[float, ...]
    covariance: tuple[float, ...]
    covariance_type: int


class WireAttitude(NamedTuple):
    """
    The orientation of a `sensor_msgs/Imu`.

    Attributes
    ----------
    stamp : Stamp
        The header's stamp.
    orientation : tuple of float
        x, y, z and w.
    covariance : tuple of float
        Nine numbers, rad².
    """

    stamp: Stamp
    orientation: tuple[float, ...]
    covariance: tuple[float, ...]


def read_pose(data: bytes, name: str) -> WirePose:
    """
    Read a pose.

    Parameters
    ----------
    data : bytes
        The serialized message.
    name : str
        Its type, one of `POSE_MESSAGES`.

    Raises
    ------
    obbhbb_ros.wire.buffer.WireError
        If the bytes are no such message.
    """
    steps, path, variances = _LAYOUTS[name]
    buffer, places = read_struct(data, steps)
    numbers: tuple[Any, ...] = buffer.numbers(places[path], f'{_POSE_NUMBERS + variances}d')
    position, orientation, covariance = numbers[:3], numbers[3:_POSE_NUMBERS], numbers[7:]
    child = buffer.text(places[_CHILD]) if _CHILD in places else ''
    return WirePose(buffer.stamp, buffer.frame_id, position, orientation, covariance, child)


def read_fix(data: bytes) -> WireFix:
    """
    Read a serialized `sensor_msgs/NavSatFix`.

    Raises
    ------
    obbhbb_ros.wire.buffer.WireError
        If the bytes are no such message.
    """
    buffer, places = read_struct(data, NAV_SAT_FIX)
    (status,) = buffer.numbers(places['status.status'], 'b')
    numbers = buffer.numbers(places['latitude'], '12d')
    (known,) = buffer.numbers(places['position_covariance_type'], 'B')
    return WireFix(buffer.stamp, status, numbers[:3], numbers[3:], known)


def read_attitude(data: bytes) -> WireAttitude:
    """
    Read the orientation of a serialized `sensor_msgs/Imu`.

    Raises
    ------
    obbhbb_ros.wire.buffer.WireError
        If the bytes are no such message.
    """
    buffer, places = read_struct(data, IMU)
    numbers = buffer.numbers(places['orientation'], '13d')
    return WireAttitude(buffer.stamp, numbers[:4], numbers[4:])


def pose_bytes(pose: WirePose) -> bytes:
    """Write a `geometry_msgs/PoseWithCovarianceStamped`, little-endian, with its encapsulation."""
    numbers = (*pose.position, *pose.orientation, *(pose.covariance or 36 * (math.nan,)))
    body = header_bytes(pose.stamp, pose.frame_id)
    return LITTLE_ENDIAN + body + padding(len(body)) + struct.pack('<43d', *numbers)
