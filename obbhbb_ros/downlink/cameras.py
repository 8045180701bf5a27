# SPDX-License-Identifier: Apache-2.0
"""What belongs to an image, such as its camera: that with its stamp, or else the latest."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from typing import Generic
from typing import NamedTuple
from typing import TypeVar

from obbhbb_ros.downlink.joiner import StampCache
from obbhbb_ros.wire.stamp import ZERO_STAMP
from obbhbb_ros.wire.stamp import Stamp

Camera = TypeVar('Camera')

_MAX_COUNT = 1000
_MAX_MISSED = 100
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

    Or whatever else belongs to images and comes by itself.

    Parameters
    ----------
    max_bytes : float
        Bytes of what is remembered; the oldest is forgotten first.
    size_of : callable, optional
        Returns the bytes of one.

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

    def __init__(
        self, max_bytes: float = math.inf, size_of: Callable[[Camera], int] = lambda _: 0
    ) -> None:
        self._max_bytes = max_bytes
        self._by_stamp = StampCache[Camera](lambda reason, _: None, size_of)
        # Stamps of images that were cut without their camera.
        self._missed: deque[Stamp] = deque(maxlen=_MAX_MISSED)
        self.clear()

    def clear(self) -> None:
        """Forget all cameras."""
        self._by_stamp.clear()
        self._missed.clear()
        self._latest: Camera | None = None
        self._latest_stamp = ZERO_STAMP
        # Whether cameras have the stamps of images, None as long as nobody knows.
        self._match: bool | None = None

    def add(self, stamp: Stamp, camera: Camera, now: float) -> None:
        """Add a camera that was received at `now`, seconds of a monotonic clock."""
        self._latest, self._latest_stamp = camera, stamp
        self._by_stamp.expire(now, _MAX_AGE)
        if stamp != ZERO_STAMP:
            self._by_stamp.put(stamp, camera, now, _MAX_COUNT, self._max_bytes)
        if stamp in self._missed:
            self._match = True

    def choice(self, stamp: Stamp) -> CameraChoice[Camera] | None:
        """Return the camera with a stamp, or else the latest; None if there is none yet."""
        if stamp in self._by_stamp:
            self._match = True
            return CameraChoice(self._by_stamp[stamp], has_stamp=True)
        if self.is_coming(stamp):
            # It was waited for long enough.
            self._match = False
        if stamp != ZERO_STAMP:
            self._missed.append(stamp)
        return None if self._latest is None else CameraChoice(self._latest, has_stamp=False)

    def is_coming(self, stamp: Stamp) -> bool:
        """
        Return whether the camera with a stamp is likely to be on its way.

        It is if no later one has come, and cameras have the stamps of images, or may have: several
        have come, and none was waited for in vain.
        """
        is_later = self._latest_stamp != ZERO_STAMP and self._latest_stamp < stamp
        may_match = len(self._by_stamp) > 1 if self._match is None else self._match
        return is_later and may_match and stamp not in self._by_stamp
