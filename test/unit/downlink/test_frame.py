# SPDX-License-Identifier: Apache-2.0
"""The loop over a frame: link and spool each have one fate for every region, whatever happens."""

import itertools
import sys
from collections import Counter
from contextlib import suppress

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from obbhbb_ros.downlink.budget import BudgetSettings
from obbhbb_ros.downlink.budget import FrameBudget
from obbhbb_ros.downlink.budget import TokenBucket
from obbhbb_ros.downlink.chips import CodecSettings
from obbhbb_ros.downlink.chips import Dropped
from obbhbb_ros.downlink.chips import EncodedChip
from obbhbb_ros.downlink.frame import FrameCut
from obbhbb_ros.downlink.frame import FrameLink

PIXELS = np.zeros((1, 1, 1), np.uint8)


class Frame:
    """A frame whose chips have given sizes; in the place of a size, a reason why there is none."""

    def __init__(self, *chips, burst=1000):
        self.chips = chips
        self.cut = FrameCut([(i, 0, i + 1, 1) for i in range(len(chips))])
        self.encoded, self.sent = [], []
        budget = BudgetSettings(1.0, burst)
        limits = FrameBudget(budget, TokenBucket(budget, 0.0), CodecSettings(), lambda: 0.0)
        self.link = FrameLink(limits, self.send)

    def encode(self, index, region):
        assert region == (index, 0, index + 1, 1)
        self.encoded.append(index)
        chip = self.chips[index]
        if isinstance(chip, Exception):
            raise chip
        return (
            chip if isinstance(chip, Dropped) else EncodedChip(index, region, PIXELS, b'x' * chip)
        )

    def send(self, chip, data):
        assert data == chip.data
        self.sent.append(chip.index)

    def run(self, link=True, spool=True):
        record = (lambda chip: chip.index) if spool else None
        self.cut.run(self.encode, self.link if link else None, record)

    @property
    def fates(self):
        """What became of the regions: sent and why not, recorded and why not."""
        cut = self.cut
        return cut.sent, cut.not_sent, cut.records, cut.not_recorded


def test_every_chip_goes_to_link_and_spool() -> None:
    frame = Frame(1, 2, 3)
    frame.run()
    assert frame.fates == (3, {}, [0, 1, 2], {})
    assert frame.sent == [0, 1, 2]


def test_a_region_without_chip_has_its_reason_in_both() -> None:
    frame = Frame(1, Dropped.OUTSIDE, Dropped.ENCODER, 1)
    frame.run()
    reasons = {'outside_image': 1, 'encoder_failed': 1}
    assert frame.fates == (2, reasons, [0, 3], reasons)


def test_the_spool_gets_what_the_link_does_not_take() -> None:
    frame = Frame(600, 600, Dropped.OUTSIDE, 1)
    frame.run()
    # What comes after the end of the link is not sent for its end, whatever else there is.
    assert frame.fates == (1, {'link_budget': 3}, [0, 1, 3], {'outside_image': 1})


def test_without_a_spool_nothing_is_encoded_after_the_end_of_the_link() -> None:
    frame = Frame(600, 600, 1, 1)
    frame.run(spool=False)
    assert frame.fates[:2] == (1, {'link_budget': 3})
    assert frame.encoded == [0, 1]


def test_a_chip_larger_than_the_burst_is_passed_over() -> None:
    frame = Frame(2000, 1)
    frame.run()
    assert frame.fates == (1, {'larger_than_burst': 1}, [0, 1], {})


def test_without_a_link_the_reason_is_that_there_is_none() -> None:
    frame = Frame(1, Dropped.OUTSIDE)
    frame.cut.close_link(Dropped.NO_SUBSCRIBER)
    frame.run(link=False)
    assert frame.fates == (0, {'no_subscriber': 2}, [0], {'outside_image': 1})


def test_with_neither_link_nor_spool_nothing_is_encoded() -> None:
    frame = Frame(1, 2)
    frame.run(link=False, spool=False)
    assert frame.encoded == []


@pytest.mark.parametrize('is_wanted', [True, False])
def test_an_image_that_is_refused_has_that_reason_unless_nobody_wanted_it(is_wanted) -> None:
    frame = Frame(1, 2)
    if not is_wanted:
        frame.cut.close_link(Dropped.NO_SUBSCRIBER)
    frame.cut.refuse(Dropped.IMAGE_REFUSED)
    refused = {'image_refused': 2}
    assert frame.fates == (0, refused if is_wanted else {'no_subscriber': 2}, [], refused)


@pytest.mark.parametrize('error', [RuntimeError, KeyboardInterrupt, SystemExit])
def test_an_error_of_the_link_costs_the_spool_nothing(error) -> None:
    frame = Frame(1, 1, 1, Dropped.OUTSIDE)
    send = frame.send

    def broken(chip, data):
        if chip.index == 1:
            raise error('the middleware is full')
        send(chip, data)

    frame.send = broken
    frame.link = FrameLink(frame.link.budget, broken)
    with pytest.raises(error, match='the middleware is full'):
        frame.run()
    assert frame.fates == (1, {'failed': 3}, [0, 1, 2], {'outside_image': 1})


def interrupted_at(line, run):
    """Run, with an interrupt at a line of the loop; return whether it came that far."""
    lines = itertools.count()

    def trace(python_frame, event, _):
        if python_frame.f_code.co_filename != FrameCut.run.__code__.co_filename:
            return None
        if event == 'line' and next(lines) == line:
            raise KeyboardInterrupt
        return trace

    before = sys.gettrace()
    sys.settrace(trace)
    try:
        run()
    except KeyboardInterrupt:
        return True
    finally:
        sys.settrace(before)
    return False


def test_an_interrupt_at_any_line_of_the_loop_leaves_one_fate_for_every_region() -> None:
    for line in itertools.count():
        frame = Frame(1, Dropped.OUTSIDE, 1, 1200, 1)
        was_interrupted = interrupted_at(line, frame.run)
        sent, not_sent, records, not_recorded = frame.fates
        assert sent + not_sent.total() == len(records) + not_recorded.total() == 5
        if not was_interrupted:
            break
    assert line > 30


@pytest.mark.parametrize('spool', [True, False])
def test_after_an_error_of_the_encoder_the_rest_has_failed(spool) -> None:
    frame = Frame(1, Dropped.OUTSIDE, ArithmeticError('odd'), 1)
    with pytest.raises(ArithmeticError):
        frame.run(spool=spool)
    left = {'outside_image': 1, 'failed': 2}
    assert frame.fates == (1, left, [0] if spool else [], left if spool else {'failed': 4})


def test_after_an_error_of_the_record_the_rest_has_failed() -> None:
    frame = Frame(1, 1, 1)
    with pytest.raises(ZeroDivisionError):
        frame.cut.run(frame.encode, frame.link, lambda chip: 1 // (1 - chip.index))
    assert frame.fates == (1, {'failed': 2}, [1], {'failed': 2})


@pytest.mark.parametrize('link', [True, False])
def test_a_frame_can_be_taken_in_parts_and_given_up(link) -> None:
    frame = Frame(1, Dropped.OUTSIDE, 1, 1)
    steps = frame.cut.steps(frame.encode, frame.link if link else None, lambda chip: chip.index)
    next(steps)
    assert frame.cut.take() == ([0], {})
    next(steps)
    next(steps)
    assert frame.cut.take() == ([2], {'outside_image': 1})
    steps.close()
    assert frame.encoded == [0, 1, 2]
    frame.cut.refuse(Dropped.DEACTIVATED)
    assert frame.cut.take(rest=True) == ([], {'deactivated': 1})
    assert frame.cut.take(rest=True) == ([], {})
    if link:
        assert (frame.cut.sent, frame.cut.not_sent) == (2, {'outside_image': 1, 'deactivated': 1})


CHIP = st.one_of(
    st.integers(1, 1200),
    st.sampled_from([Dropped.OUTSIDE, Dropped.ENCODER]),
    st.just(ArithmeticError('odd')),
)


@given(st.lists(CHIP, max_size=12), st.booleans(), st.booleans(), st.booleans())
def test_every_region_has_one_fate_in_link_and_spool(chips, link, spool, link_fails) -> None:
    frame = Frame(*chips)
    if link_fails:
        frame.link = FrameLink(frame.link.budget, lambda chip, data: 1 // (chip.index - 2))
    with suppress(ArithmeticError):
        frame.run(link, spool)
    sent, not_sent, records, not_recorded = frame.fates
    assert sent + not_sent.total() == len(records) + not_recorded.total() == len(chips)
    assert min(Counter(not_sent | not_recorded).values(), default=1) > 0
    if link and not link_fails:
        assert frame.sent == sorted(frame.sent)
        assert sum(chips[index] for index in frame.sent) <= 1000
