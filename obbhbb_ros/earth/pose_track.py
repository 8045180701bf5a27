# SPDX-License-Identifier: Apache-2.0
"""Samples by stamp, and their values at the stamp of an image."""

from __future__ import annotations

from bisect import bisect_left
from bisect import insort
from collections import deque
from typing import Generic
from typing import NamedTuple
from typing import Protocol
from typing import TypeVar

from obbhbb_ros.wire.stamp import Stamp
from obbhbb_ros.wire.stamp import nanoseconds_of

__all__ = ['SampleAt', 'SampleTrack']

# Ten seconds of an IMU at 200 Hz.
_MAX_COUNT = 2000
# Samples may arrive out of order within a second; an earlier one means that the clock was set back.
_MAX_DISORDER = 1_000_000_000


class _Interpolated(Protocol):
    """What lies between two samples."""

    def toward(self: T, later: T, fraction: float) -> T:
        """Interpolate; 0 is this sample, 1 the later one."""


T = TypeVar('T')
Sample = TypeVar('Sample', bound=_Interpolated)


class SampleAt(NamedTuple, Generic[Sample]):
    """
    A sample at a stamp.

    Attributes
    ----------
    sample : Sample
        The sample, or what lies between two.
    age : float
        Seconds to the nearer one.
    """

    sample: Sample
    age: float


class SampleTrack(Generic[Sample]):
    """
    The latest 2000 samples by stamp: poses, fixes or attitudes.

    A sample more than a second earlier than the last one begins a new track: after a restart of a
    simulation, or the end of a bag that is played in a loop, samples of two runs would be mixed,
    and one whose stamp is far in the future would end all waiting for poses.

    Examples
    --------
    >>> from obbhbb_ros.earth.pose import Fix
    >>> track = SampleTrack[Fix]()
    >>> track.add((10, 0), Fix.from_message(54.0, 12.0, 100.0))
    >>> track.add((12, 0), Fix.from_message(54.0, 12.0, 300.0))
    >>> middle = track.at((11, 0), max_age=1.0)
    >>> round(middle.sample.latitude, 9), middle.age
    (54.0, 1.0)
    >>> track.at((12, 1), max_age=1.0), track.has_reached((12, 1))
    (None, False)
    """

    def __init__(self) -> None:
        self.clear()

    def __len__(self) -> int:
        """Count the samples."""
        return len(self._samples)

    def clear(self) -> None:
        """Forget all samples."""
        self._samples: dict[int, Sample] = {}
        self._stamps: list[int] = []
        # In the order of their arrival.
        self._order: deque[int] = deque()

    def add(self, stamp: Stamp, sample: Sample) -> None:
        """Add a sample; it replaces one with the same stamp, or begins a new track."""
        time = nanoseconds_of(stamp)
        if self._stamps and time < self._stamps[-1] - _MAX_DISORDER:
            self.clear()
        if time not in self._samples:
            insort(self._stamps, time)
            self._order.append(time)
        self._samples[time] = sample
        if len(self._order) > _MAX_COUNT:
            oldest = self._order.popleft()
            del self._samples[oldest]
            del self._stamps[bisect_left(self._stamps, oldest)]

    def has_reached(self, stamp: Stamp) -> bool:
        """Tell whether a sample has come that is as late as a stamp, so that waiting is over."""
        return bool(self._stamps) and self._stamps[-1] >= nanoseconds_of(stamp)

    def gap(self, stamp: Stamp) -> float | None:
        """Return the seconds from a stamp to the nearest sample, negative to an earlier one."""
        time = nanoseconds_of(stamp)
        place = bisect_left(self._stamps, time)
        gaps = [(near - time) * 1e-9 for near in self._stamps[max(place - 1, 0) : place + 1]]
        return min(gaps, key=abs, default=None)

    def at(self, stamp: Stamp, max_age: float) -> SampleAt[Sample] | None:
        """
        Interpolate at a stamp.

        Parameters
        ----------
        stamp : Stamp
            Seconds and nanoseconds.
        max_age : float
            How far from it the samples may be, seconds.

        Returns
        -------
        SampleAt or None
            The sample with the stamp, or an interpolation between the last one before it and the
            first one after it; None if one of these is missing or too far away. There is no
            extrapolation.
        """
        time = nanoseconds_of(stamp)
        if time in self._samples:
            return SampleAt(self._samples[time], 0.0)
        place = bisect_left(self._stamps, time)
        if not 0 < place < len(self._stamps):
            return None
        before, after = self._stamps[place - 1], self._stamps[place]
        since, until = (time - before) * 1e-9, (after - time) * 1e-9
        if max(since, until) > max_age:
            return None
        fraction = since / (since + until)
        sample = self._samples[before].toward(self._samples[after], fraction)
        return SampleAt(sample, min(since, until))
