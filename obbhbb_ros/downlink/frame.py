# SPDX-License-Identifier: Apache-2.0
"""
The loop over the regions of a frame: cut each one, record it for the spool, offer it to the link.

No ROS in here: the node, the chip study and the simulation of passes all run this loop.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from collections.abc import Iterator
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Generic
from typing import TypeVar

from obbhbb_ros.downlink.budget import FrameBudget
from obbhbb_ros.downlink.chips import Dropped
from obbhbb_ros.downlink.chips import EncodedChip
from obbhbb_ros.downlink.chips import Region

Record = TypeVar('Record')


@dataclass(frozen=True)
class FrameLink:
    """
    The link for the chips of one frame.

    Attributes
    ----------
    budget : FrameBudget
        Decides which chips go out.
    send : callable
        Sends a chip, given the chip and its file, which may be of lower quality than `chip.data`.
    """

    budget: FrameBudget
    send: Callable[[EncodedChip, bytes], None]

    def offer(self, chip: EncodedChip) -> Dropped | None:
        """Send a chip if the budget admits it; return why it was not sent."""
        admitted = self.budget.admit(chip)
        if isinstance(admitted, Dropped):
            return admitted
        self.send(chip, admitted)
        return None


class FrameCut(Generic[Record]):
    """
    The regions of one frame, and what becomes of each of them.

    For link and spool alike, a region has either success or exactly one reason why it was dropped:
    `Dropped.FAILED` where an exception kept `run` from dealing with it.

    Parameters
    ----------
    regions : sequence of tuple of int
        x0, y0, x1, y1 of each region, pixels, most valuable first.

    Examples
    --------
    >>> frame = FrameCut[int]([(0, 0, 4, 4), (9, 9, 9, 9)])
    >>> frame.close_link(Dropped.NO_SUBSCRIBER)
    >>> frame.run(lambda index, region: Dropped.OUTSIDE, record=lambda chip: len(chip.data))
    >>> frame.sent, frame.not_sent, frame.not_recorded
    (0, Counter({'no_subscriber': 2}), Counter({'outside_image': 2}))
    """

    def __init__(self, regions: Sequence[Region]) -> None:
        self._regions = regions
        # One assignment decides the fate of a chip: an interrupt cannot come in between.
        self._sending: list[Dropped | None] = [Dropped.FAILED] * len(regions)
        self._recording: list[Dropped | Record] = [Dropped.FAILED] * len(regions)
        # How many regions `run` has dealt with, and how many of these `take` has returned.
        self._recorded = self._taken = 0

    @property
    def sent(self) -> int:
        """Number of chips that were sent."""
        return self._sending.count(None)

    @property
    def not_sent(self) -> Counter[str]:
        """Number of regions whose chip was not sent, by reason."""
        return _by_reason(self._sending)

    @property
    def records(self) -> list[Record]:
        """The records of the chips that were not taken, in the order of the regions."""
        return _records(self._recording[self._taken :])

    @property
    def not_recorded(self) -> Counter[str]:
        """Number of regions without a record that were not taken, by reason."""
        return _by_reason(self._recording[self._taken :])

    def take(self, rest: bool = False) -> tuple[list[Record], Counter[str]]:
        """
        Return records and `not_recorded` of the regions that are through, and forget them.

        With `rest`, also of those that `steps` has not come to.
        """
        end = len(self._recording) if rest else self._recorded
        start, self._taken = self._taken, end
        taken = self._recording[start:end]
        self._recording[start:end] = [Dropped.FAILED] * len(taken)
        return _records(taken), _by_reason(taken)

    def close_link(self, reason: Dropped, start: int = 0) -> None:
        """Note why no chip is sent, from the region with index `start` on."""
        self._sending[start:] = [reason] * (len(self._regions) - start)

    def refuse(self, reason: Dropped) -> None:
        """Note why nothing was cut, for link and spool alike."""
        self._sending = [reason if fate is Dropped.FAILED else fate for fate in self._sending]
        self._recording = [reason if fate is Dropped.FAILED else fate for fate in self._recording]

    def run(
        self,
        cut: Callable[[int, Region], EncodedChip | Dropped],
        link: FrameLink | None = None,
        record: Callable[[EncodedChip], Record] | None = None,
    ) -> None:
        """
        Cut the regions in order, as long as link or spool want more of them.

        Parameters, and what exceptions do: see `steps`.
        """
        for _ in self.steps(cut, link, record):
            pass

    def steps(
        self,
        cut: Callable[[int, Region], EncodedChip | Dropped],
        link: FrameLink | None = None,
        record: Callable[[EncodedChip], Record] | None = None,
    ) -> Iterator[None]:
        """
        Cut the regions in order, and yield after each; whoever iterates may pause or stop there.

        An exception from the link, even an interrupt, closes the link only; it is raised when all
        chips are recorded. One from `cut` or `record` ends the loop.

        Parameters
        ----------
        cut : callable
            Returns the chip of a region, or why there is none, given the region's index and
            corners: `obbhbb_ros.downlink.chips.ChipCutter.cut`, for example.
        link : FrameLink, optional
            Where chips are sent. None: nowhere.
        record : callable, optional
            Returns what the spool stores of a chip. None: there is no spool.
        """
        chips = self._cut_and_record(cut, record)
        failure = None
        try:
            if link is not None:
                yield from self._send(chips, link)
        except GeneratorExit:
            raise
        except BaseException as error:
            failure = error
        if record is not None:
            # The chips that the link did not ask for.
            for _ in chips:
                yield
        if failure is not None:
            raise failure

    def _cut_and_record(
        self,
        cut: Callable[[int, Region], EncodedChip | Dropped],
        record: Callable[[EncodedChip], Record] | None,
    ) -> Iterator[EncodedChip | Dropped]:
        """Yield the chips in order, after they are recorded."""
        for index, region in enumerate(self._regions):
            chip = cut(index, region)
            if record is not None:
                self._recording[index] = chip if isinstance(chip, Dropped) else record(chip)
            self._recorded = index + 1
            yield chip

    def _send(self, chips: Iterator[EncodedChip | Dropped], link: FrameLink) -> Iterator[None]:
        """Offer chips to the link until it takes no more, and yield after each."""
        for index, chip in enumerate(chips):
            self._sending[index] = chip if isinstance(chip, Dropped) else link.offer(chip)
            if link.budget.ended_by is not None:
                self.close_link(link.budget.ended_by, index + 1)
                return
            yield


def _records(fates: Sequence[Dropped | Record]) -> list[Record]:
    """Select the records."""
    return [fate for fate in fates if not isinstance(fate, Dropped)]


def _by_reason(fates: Sequence[object]) -> Counter[str]:
    """Count what was dropped."""
    return Counter(fate.value for fate in fates if isinstance(fate, Dropped))
