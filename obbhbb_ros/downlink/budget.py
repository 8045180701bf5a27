# SPDX-License-Identifier: Apache-2.0
"""
The budget of a link: which chips of a frame are sent.

All times come from the caller, in seconds of a monotonic clock.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from dataclasses import replace

from obbhbb_ros.downlink.chips import CodecSettings
from obbhbb_ros.downlink.chips import Dropped
from obbhbb_ros.downlink.chips import EncodedChip
from obbhbb_ros.downlink.chips import encode
from obbhbb_ros.limits import MAX_BYTES
from obbhbb_ros.limits import MAX_INT
from obbhbb_ros.limits import CheckedSettings
from obbhbb_ros.limits import Range
from obbhbb_ros.limits import setting


@dataclass(frozen=True)
class LinkSettings(CheckedSettings):
    """What a link carries; ValueError if a value is out of range."""

    bytes_per_second: float = setting(
        0.0, 'Rate of the link, bytes per second. 0: unlimited.', Range(0.0, MAX_BYTES)
    )
    burst: float = setting(
        0.0,
        'Maximum bytes sent at once after a pause. 0: what the link carries in one second.',
        Range(0.0, MAX_BYTES),
    )
    overhead: int = setting(
        0, 'Bytes that the protocol adds to the file of each chip.', Range(0, 1_000_000)
    )

    @property
    def bucket_size(self) -> float:
        """Maximum bytes sent at once; infinite if the link is unlimited."""
        if not self.bytes_per_second:
            return float('inf')
        return self.burst or self.bytes_per_second


@dataclass(frozen=True)
class BudgetSettings(LinkSettings):
    """Limits of the link and of each frame; ValueError if a value is out of range."""

    max_chips: int = setting(0, 'Maximum chips per image. 0: unlimited.', Range(0, 1_000_000))
    max_bytes: int = setting(0, 'Maximum bytes per image. 0: unlimited.', Range(0, MAX_INT))
    min_quality: int = setting(
        0,
        'If a chip does not fit, encode it with lower quality, down to this. 0: drop it.',
        Range(0, 100),
    )


class TokenBucket:
    """
    Rate limiter: at most `rate * window + burst` bytes in any time window.

    Parameters
    ----------
    settings : LinkSettings
        Rate and burst.
    now : float
        Current time, seconds.

    Examples
    --------
    >>> bucket = TokenBucket(LinkSettings(bytes_per_second=100.0, burst=250.0), now=0.0)
    >>> bucket.spend(200, now=0.0)
    >>> bucket.available(now=1.0)
    150.0
    """

    def __init__(self, settings: LinkSettings, now: float) -> None:
        self._rate = settings.bytes_per_second
        self.burst = self._tokens = settings.bucket_size
        self._filled_at = now

    def change(self, settings: LinkSettings, now: float) -> None:
        """Change rate and burst; unspent bytes are kept up to the new burst."""
        was_unlimited = not self._rate
        self._fill(now)
        self._rate, self.burst = settings.bytes_per_second, settings.bucket_size
        # Without a limit nothing was counted, so the link may be in full use.
        self._tokens = 0.0 if was_unlimited else min(self._tokens, self.burst)

    def available(self, now: float) -> float:
        """Return how many bytes may be sent now."""
        self._fill(now)
        return self._tokens if self._rate else float('inf')

    def spend(self, count: int, now: float) -> None:
        """Spend bytes that are sent now; ValueError if they exceed `available`."""
        if count > self.available(now):
            raise ValueError(f'{count} bytes exceed the {self._tokens:.0f} available')
        if self._rate:
            self._tokens -= count

    def give_back(self, count: int) -> None:
        """Add bytes that were spent but not sent."""
        self._tokens = min(self.burst, self._tokens + count)

    def _fill(self, now: float) -> None:
        """Add what the link has carried since the last call."""
        self._tokens = min(self.burst, self._tokens + self._rate * (now - self._filled_at))
        self._filled_at = now


class FrameBudget:
    """
    The share of the link that the chips of one frame get.

    The first chip that the link cannot carry yet ends the frame: no less valuable chip is sent
    instead, so that the link is free for the most valuable chip of the next frame. A chip is
    skipped only if it can never be sent: if it is larger than the burst, or than a frame may be.

    Parameters
    ----------
    budget : BudgetSettings
        The limits.
    bucket : TokenBucket
        Rate limiter of the link, shared by all frames.
    codec : CodecSettings
        How chips are encoded.
    clock : callable
        Returns the time in seconds.

    Attributes
    ----------
    ended_by : Dropped or None
        Why no further chip of the frame is sent.
    """

    def __init__(
        self,
        budget: BudgetSettings,
        bucket: TokenBucket,
        codec: CodecSettings,
        clock: Callable[[], float],
    ) -> None:
        self._budget, self._bucket, self._codec, self._clock = budget, bucket, codec, clock
        self._bytes_left = budget.max_bytes or float('inf')
        self._chips_left = budget.max_chips or float('inf')
        self.ended_by: Dropped | None = None

    def admit(self, chip: EncodedChip) -> bytes | Dropped:
        """
        Spend the budget for a chip, if it fits.

        Parameters
        ----------
        chip : EncodedChip
            The next chip of the frame, in descending value.

        Returns
        -------
        bytes or Dropped
            The file to send now, which may be one of lower quality, or why there is none.
        """
        if self.ended_by is not None:
            return self.ended_by
        overhead = self._budget.overhead
        room = min(self._bytes_left, self._bucket.available(self._clock())) - overhead
        try:
            data = _encode_to_fit(chip, room, self._codec, self._budget.min_quality)
        except (ValueError, OSError, MemoryError):
            return Dropped.ENCODER
        cost = len(data) + overhead
        if cost > self._bucket.burst:
            return Dropped.LARGER_THAN_BURST
        if 0 < self._budget.max_bytes < cost:
            return Dropped.FRAME_BYTES
        if cost > self._bytes_left:
            self.ended_by = Dropped.FRAME_BYTES
        elif cost > self._bucket.available(now := self._clock()):
            self.ended_by = Dropped.LINK_BUDGET
        if self.ended_by is not None:
            return self.ended_by
        self._bucket.spend(cost, now)
        self._bytes_left -= cost
        self._chips_left -= 1
        if not self._chips_left:
            self.ended_by = Dropped.FRAME_CHIPS
        return data


def _encode_to_fit(chip: EncodedChip, room: float, codec: CodecSettings, min_quality: int) -> bytes:
    """Return the file of a chip; if too large, one of the lowest quality, or halfway if it fits."""
    if len(chip.data) <= room or codec.exact or not 0 < min_quality < codec.quality:
        return chip.data
    lowest = encode(chip.pixels, replace(codec, quality=min_quality))
    if len(lowest) > room:
        return lowest
    halfway = encode(chip.pixels, replace(codec, quality=(min_quality + codec.quality) // 2))
    return halfway if len(halfway) <= room else lowest
