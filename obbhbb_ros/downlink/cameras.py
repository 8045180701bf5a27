# SPDX-License-Identifier: Apache-2.0
"""The camera info of an image: the one with its stamp, or else the latest."""

from __future__ import annotations

from typing import Generic
from typing import NamedTuple
from typing import TypeVar

from obbhbb_ros.downlink.joiner import ZERO_STAMP
from obbhbb_ros.downlink.joiner import StampCache
from obbhbb_ros.wire.stamp import Stamp

Camera = TypeVar('Camera')

_MAX_COUNT = 1000
# The maximum time that an image waits for its plan, seconds.
_MAX_AGE = 3600.0


class CameraChoice(NamedTuple, Generic[Camera]):
    """
    The camera of an image.

    Attributes
    ----------
    camera : Camera
        The camera.
    has_stamp : bool
        Whether it has the stamp of the image; it is the latest otherwise.
    """

    camera: Camera
    has_stamp: bool

    @property
    def key(self) -> str:
        """Key of the diagnostics under which the choice is counted."""
        return 'camera_info_by_stamp' if self.has_stamp else 'camera_info_latest'


class CameraMemory(Generic[Camera]):
    """
    The cameras of the last 1000 stamps, none older than an hour.

    Examples
    --------
    >>> cameras = CameraMemory[str]()
    >>> cameras.add((5, 0), 'wide', now=0.0)
    >>> cameras.add((6, 0), 'zoomed in', now=0.1)
    >>> cameras.choice((5, 0))
    CameraChoice(camera='wide', has_stamp=True)
    >>> cameras.choice((7, 0))
    CameraChoice(camera='zoomed in', has_stamp=False)
    """

    def __init__(self) -> None:
        self._by_stamp = StampCache[Camera](lambda reason, _: None)
        self._latest: Camera | None = None

    def add(self, stamp: Stamp, camera: Camera, now: float) -> None:
        """Add a camera that was received at `now`, seconds of a monotonic clock."""
        self._latest = camera
        self._by_stamp.expire(now, _MAX_AGE)
        if stamp != ZERO_STAMP:
            self._by_stamp.put(stamp, camera, now, _MAX_COUNT)

    def choice(self, stamp: Stamp) -> CameraChoice[Camera] | None:
        """Return the camera with a stamp, or else the latest; None if there is none yet."""
        if stamp in self._by_stamp:
            return CameraChoice(self._by_stamp[stamp], has_stamp=True)
        return None if self._latest is None else CameraChoice(self._latest, has_stamp=False)
