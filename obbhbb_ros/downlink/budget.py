# SPDX-License-Identifier: Apache-2.0
"""
The budget of a link: which chips of a frame are sent, the most valuable first.

All times come from the caller, in seconds of a monotonic clock.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from collections.abc import Iterator
from collections.abc import Sequence
from dataclasses import dataclass
from dataclasses import replace
from enum import Enum
from typing import Any

from numpy.typing import NDArray

from obbhbb_ros.downlink import require_not_negative
from obbhbb_ros.downlink.chips import CodecSettings
from obbhbb_ros.downlink.chips import PixelFormat
from obbhbb_ros.downlink.chips import Region
from obbhbb_ros.downlink.chips import cut
from obbhbb_ros.downlink.chips import encode
from obbhbb_ros.downlink.chips import placed


class Dropped(str, Enum):
    """Why a region of a frame was not sent."""

    OUTSIDE = 'outside_image'
    ENCODER = 'encoder_failed'
    LINK_BUDGET = 'link_budget'
    LARGER_THAN_BURST = 'larger_than_burst'
    FRAME_CHIPS = 'frame_max_chips'
    FRAME_BYTES = 'frame_max_bytes'


@dataclass(frozen=True)
class BudgetSettings:
    """
    Limits of the link and of each frame; a negative or infinite value raises ValueError.

    Attributes
    ----------
    bytes_per_second : float
        Data rate of the link (0: unlimited).
    burst : float
        Maximum bytes sent at once after a pause (0: what the link carries in a second).
    overhead : int
        Bytes added to each chip by the protocol.
    max_chips : int
        Maximum chips per frame (0: unlimited).
    max_bytes : int
        Maximum bytes per frame (0: unlimited).
    min_quality : int
        A chip that does not fit is encoded again, down to this quality (0: dropped at once).
    """

    bytes_per_second: float = 0.0
    burst: float = 0.0
    overhead: int = 0
    max_chips: int = 0
    max_bytes: int = 0
    min_quality: int = 0

    def __post_init__(self) -> None:
        """Check every value."""
        require_not_negative(**vars(self))

    @property
    def bucket_size(self) -> float:
        """Maximum bytes sent at once; infinite if the link is unlimited."""
        if not self.bytes_per_second:
            return float('inf')
        return self.burst or self.bytes_per_second


class TokenBucket:
    """
    Rate limiter: at most `rate * window + burst` bytes in any time window.

    Parameters
    ----------
    settings : BudgetSettings
        Rate and burst.
    now : float
        Current time, seconds.

    Examples
    --------
    >>> bucket = TokenBucket(BudgetSettings(bytes_per_second=100.0, burst=250.0), now=0.0)
    >>> bucket.spend(200, now=0.0)
    >>> bucket.available(now=1.0)
    150.0
    """

    def __init__(self, settings: BudgetSettings, now: float) -> None:
        self._rate = settings.bytes_per_second
        self.burst = self._tokens = settings.bucket_size
        self._filled_at = now

    def change(self, settings: BudgetSettings, now: float) -> None:
        """Change rate and burst; unspent bytes are kept up to the new burst."""
        was_unlimited = not self._rate
        self._fill(now)
        self._rate, self.burst = settings.bytes_per_second, settings.bucket_size
        # Without a limit nothing was counted, so the link may be fully used.
        self._tokens = 0.0 if was_unlimited else min(self._tokens, self.burst)

    def available(self, now: float) -> float:
        """Return how many bytes may be sent now."""
        self._fill(now)
        return self._tokens if self._rate else float('inf')

    def spend(self, count: int, now: float) -> None:
        """Subtract bytes that are sent now; ValueError if they exceed `available`."""
        if count > self.available(now):
            raise ValueError(f'{count} bytes exceed the {self._tokens:.0f} available')
        if self._rate:
            self._tokens -= count

    def _fill(self, now: float) -> None:
        """Add what the link has carried since the last call."""
        self._tokens = min(self.burst, self._tokens + self._rate * (now - self._filled_at))
        self._filled_at = now


@dataclass(frozen=True)
class Chip:
    """An encoded chip and its region of the image."""

    region: Region
    data: bytes


def chips_within_budget(
    view: NDArray[Any],
    layout: PixelFormat,
    regions: Sequence[Region],
    codec: CodecSettings,
    budget: BudgetSettings,
    bucket: TokenBucket,
    clock: Callable[[], float],
    dropped: Counter[str],
    on_failure: Callable[[Region, Exception], None],
) -> Iterator[Chip]:
    """
    Encode the chips of a frame that fit the budget; send each before requesting the next.

    The first chip that the link cannot carry yet ends the frame: less valuable chips are not sent
    in its place, so that the link is free for the most valuable chip of the next frame. Only a
    chip that could never be sent, larger than the burst or than a frame may be, is skipped.

    Parameters
    ----------
    view, layout : ndarray of shape (height, width, channels), PixelFormat
        The image.
    regions : sequence of tuple of int
        The crop plan, most valuable first.
    codec, budget, bucket : CodecSettings, BudgetSettings, TokenBucket
        Encoding, limits, and the rate limiter of the link, shared by all frames.
    clock : callable
        Returns the time in seconds.
    dropped : Counter
        Counts by `Dropped` every region that is not sent.
    on_failure : callable
        Called with region and error if the encoder fails.

    Yields
    ------
    Chip
        Already subtracted from the budget.
    """
    bytes_left = budget.max_bytes or float('inf')
    sent = 0
    image_size = view.shape[1], view.shape[0]
    for index, planned in enumerate(regions):
        region = placed(planned, image_size, layout)
        if region is None:
            dropped[Dropped.OUTSIDE.value] += 1
            continue
        if budget.max_chips and sent == budget.max_chips:
            dropped[Dropped.FRAME_CHIPS.value] += len(regions) - index
            return
        pixels = cut(view, region, layout)
        room = min(bytes_left, bucket.available(clock())) - budget.overhead
        try:
            data = _encode_to_fit(pixels, room, codec, budget.min_quality)
        except (ValueError, OSError, MemoryError) as error:
            # Each format has a maximum size.
            dropped[Dropped.ENCODER.value] += 1
            on_failure(region, error)
            continue
        cost = len(data) + budget.overhead
        if cost > bucket.burst:
            dropped[Dropped.LARGER_THAN_BURST.value] += 1
        elif 0 < budget.max_bytes < cost:
            dropped[Dropped.FRAME_BYTES.value] += 1
        elif cost > bytes_left:
            dropped[Dropped.FRAME_BYTES.value] += len(regions) - index
            return
        elif cost > bucket.available(now := clock()):
            dropped[Dropped.LINK_BUDGET.value] += len(regions) - index
            return
        else:
            bucket.spend(cost, now)
            bytes_left -= cost
            sent += 1
            yield Chip(region, data)


def _encode_to_fit(
    pixels: NDArray[Any], room: float, codec: CodecSettings, min_quality: int
) -> bytes:
    """Encode; if the result is too large, try the lowest quality and the one halfway to it."""
    data = encode(pixels, codec)
    if len(data) <= room or codec.exact or not 0 < min_quality < codec.quality:
        return data
    lowest = encode(pixels, replace(codec, quality=min_quality))
    if len(lowest) > room:
        return lowest
    halfway = encode(pixels, replace(codec, quality=(min_quality + codec.quality) // 2))
    return halfway if len(halfway) <= room else lowest
