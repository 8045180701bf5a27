# SPDX-License-Identifier: Apache-2.0
"""
A link's budget: which chips of a frame may go, the most valuable first.

Time is given by the caller, seconds of a clock that never goes back.
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
    What may be sent.

    Attributes
    ----------
    bytes_per_second : float
        What the link carries; 0 for no bound.
    burst : float
        What may be sent at once after a pause, bytes; 0 for what the link carries in a second.
    overhead : int
        What each chip costs besides its file, bytes.
    max_chips : int
        At most so many chips a frame; 0 for no bound.
    max_bytes : int
        At most so many bytes a frame; 0 for no bound.
    min_quality : int
        A chip that does not fit is encoded again, down to this quality; 0 to drop it at once.

    Raises
    ------
    ValueError
        If a value is negative; the message names it.
    """

    bytes_per_second: float = 0.0
    burst: float = 0.0
    overhead: int = 0
    max_chips: int = 0
    max_bytes: int = 0
    min_quality: int = 0

    def __post_init__(self) -> None:
        """Check every value."""
        for name, value in vars(self).items():
            if not 0 <= value < float('inf'):
                raise ValueError(f'{name} must be finite and not negative, not {value}')


class TokenBucket:
    """
    Never lets through more than `rate * window + burst` bytes in any window of time.

    Parameters
    ----------
    settings : BudgetSettings
        Rate and burst.
    now : float
        Seconds.
    """

    def __init__(self, settings: BudgetSettings, now: float) -> None:
        self._rate = settings.bytes_per_second
        self.burst = _burst(settings)
        self._tokens = self.burst
        self._filled_at = now

    def change(self, settings: BudgetSettings, now: float) -> None:
        """Go on with another rate and burst; what was not spent stays, as far as it fits."""
        unbounded = not self._rate
        self._fill(now)
        self._rate, self.burst = settings.bytes_per_second, _burst(settings)
        # Nothing was counted while there was no bound, so nothing may have been left over.
        self._tokens = 0.0 if unbounded else min(self._tokens, self.burst)

    def available(self, now: float) -> float:
        """Tell how many bytes may be sent now."""
        self._fill(now)
        return self._tokens if self._rate else float('inf')

    def spend(self, count: int, now: float) -> None:
        """
        Account for bytes that are sent now.

        Raises
        ------
        ValueError
            If there are not so many.
        """
        if count > self.available(now):
            raise ValueError(f'{count} bytes are more than the {self._tokens:.0f} left')
        if self._rate:
            self._tokens -= count

    def _fill(self, now: float) -> None:
        """Add what the link has carried since the last time."""
        self._tokens = min(self.burst, self._tokens + self._rate * (now - self._filled_at))
        self._filled_at = now


def _burst(settings: BudgetSettings) -> float:
    """Give the burst in bytes."""
    if not settings.bytes_per_second:
        return float('inf')
    return settings.burst or settings.bytes_per_second


@dataclass(frozen=True)
class Chip:
    """An encoded chip, and where it lies in the image."""

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
    Make the chips of one frame that may be sent; each must be sent before the next is asked for.

    The first that the link cannot carry yet ends the frame: what is less valuable does not get
    through in its place, so that the next frame's most valuable finds the link free. Only a chip
    that no pause would make room for is passed over.

    Parameters
    ----------
    view : ndarray, shape (height, width, channels)
        The image.
    layout : PixelFormat
        Of its pixels.
    regions : sequence of tuple of int
        The crop plan, most valuable first.
    codec, budget : CodecSettings, BudgetSettings
        How chips are encoded, and what may be sent.
    bucket : TokenBucket
        The link's, shared by all frames.
    clock : callable
        Gives the time in seconds.
    dropped : Counter
        Is added to, by `Dropped`: every region is either given or counted.
    on_failure : callable
        Called with region and error where the encoder fails.

    Yields
    ------
    Chip
        Paid for.
    """
    bytes_left = budget.max_bytes or float('inf')
    sent = 0
    image_size = view.shape[1], view.shape[0]
    for index, wanted in enumerate(regions):
        region = placed(wanted, image_size, layout)
        if region is None:
            dropped[Dropped.OUTSIDE.value] += 1
            continue
        if budget.max_chips and sent == budget.max_chips:
            dropped[Dropped.FRAME_CHIPS.value] += len(regions) - index
            return
        pixels = cut(view, region, layout)
        room = min(bytes_left, bucket.available(clock())) - budget.overhead
        try:
            data = _encode_into(pixels, room, codec, budget.min_quality)
        except (ValueError, OSError, MemoryError) as error:
            # Each format has sizes that it cannot hold.
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


def _encode_into(
    pixels: NDArray[Any], room: float, codec: CodecSettings, min_quality: int
) -> bytes:
    """Encode; where that is too large and quality may fall, at the middle or lowest quality."""
    data = encode(pixels, codec)
    if len(data) <= room or codec.exact or not 0 < min_quality < codec.quality:
        return data
    lowest = encode(pixels, replace(codec, quality=min_quality))
    if len(lowest) > room:
        return lowest
    between = encode(pixels, replace(codec, quality=(min_quality + codec.quality) // 2))
    return between if len(between) <= room else lowest
