# SPDX-License-Identifier: Apache-2.0
"""The budget of the link: never exceeded, the most valuable first, everything accounted for."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from obbhbb_ros.downlink.budget import BudgetSettings
from obbhbb_ros.downlink.budget import FrameBudget
from obbhbb_ros.downlink.budget import TokenBucket
from obbhbb_ros.downlink.chips import PIXEL_FORMATS
from obbhbb_ros.downlink.chips import ChipCutter
from obbhbb_ros.downlink.chips import CodecSettings
from obbhbb_ros.downlink.chips import Dropped
from obbhbb_ros.downlink.frame import FrameCut
from obbhbb_ros.downlink.frame import FrameLink

PNG = CodecSettings('png')
GREY = PIXEL_FORMATS['mono8']
# Noise does not compress: a chip of n pixels takes n bytes and a little.
NOISE = np.random.default_rng(0).integers(0, 256, (400, 400, 1)).astype(np.uint8)
RATE = st.floats(1.0, 1e6)


@given(
    rate=RATE,
    burst=st.floats(0.0, 1e6),
    asked=st.lists(st.tuples(st.floats(0.0, 3.0), st.integers(0, 200_000)), max_size=40),
)
def test_no_window_has_more_than_rate_times_window_plus_burst(rate, burst, asked) -> None:
    bucket = TokenBucket(BudgetSettings(rate, burst), 0.0)
    sent, now = [], 0.0
    for pause, count in asked:
        now += pause
        if count <= bucket.available(now):
            bucket.spend(count, now)
            sent.append((now, count))
    for first, last in itertools.combinations_with_replacement(range(len(sent)), 2):
        total = sum(count for _, count in sent[first : last + 1])
        window = sent[last][0] - sent[first][0]
        assert total <= (rate * window + (burst or rate)) * (1 + 1e-9) + 1e-6


@given(
    changes=st.lists(st.tuples(st.floats(0.0, 2.0), RATE, RATE), min_size=1, max_size=20),
)
def test_changing_the_budget_gives_nothing_away(changes) -> None:
    bucket = TokenBucket(BudgetSettings(1000.0, 500.0), 0.0)
    carried, now = 500.0, 0.0
    spent, rate = 0.0, 1000.0
    for pause, new_rate, burst in changes:
        now += pause
        carried += pause * rate
        bucket.change(BudgetSettings(new_rate, burst), now)
        rate = new_rate
        available = bucket.available(now)
        assert available <= burst
        bucket.spend(available, now)
        spent += available
        assert spent <= carried * (1 + 1e-9)


def test_without_a_rate_there_is_no_bound_and_setting_one_starts_from_nothing() -> None:
    bucket = TokenBucket(BudgetSettings(), 0.0)
    bucket.spend(10**15, 0.0)
    bucket.change(BudgetSettings(100.0), 5.0)
    assert bucket.available(5.0) == 0
    assert bucket.available(5.5) == 50


def test_more_than_there_is_cannot_be_spent() -> None:
    bucket = TokenBucket(BudgetSettings(100.0), 0.0)
    with pytest.raises(ValueError, match='101 bytes exceed the 100 available'):
        bucket.spend(101, 0.0)


def send(sides, budget, codec=PNG, bucket=None, view=NOISE, now=0.0):
    """Ask for square chips; give the sides of those sent, what was dropped, and the files."""
    frame = FrameCut([(0, 0, side, side) for side in sides])
    limits = FrameBudget(budget, bucket or TokenBucket(budget, now), codec, lambda: now)
    sent = []
    link = FrameLink(limits, lambda chip, data: sent.append((chip.region[2], data)))
    frame.run(ChipCutter(view, GREY, codec, fail).cut, link)
    assert frame.sent == len(sent)
    assert frame.sent + frame.not_sent.total() == len(sides)
    return [side for side, _ in sent], frame.not_sent, [data for _, data in sent]


def fail(*failure):
    raise AssertionError(failure)


def test_without_a_budget_everything_goes_in_order() -> None:
    assert send([30, 10, 20], BudgetSettings())[:2] == ([30, 10, 20], {})


def test_what_the_link_cannot_carry_ends_the_frame() -> None:
    sent, dropped, _ = send([30, 30, 5, 5], BudgetSettings(1500.0))
    assert sent == [30]
    assert dropped == {Dropped.LINK_BUDGET.value: 3}


def test_a_chip_larger_than_the_burst_is_passed_over() -> None:
    sent, dropped, _ = send([100, 30, 5], BudgetSettings(1500.0))
    assert sent == [30, 5]
    assert dropped == {Dropped.LARGER_THAN_BURST.value: 1}


def test_the_next_frame_finds_what_the_link_has_carried_since() -> None:
    budget = BudgetSettings(1500.0)
    bucket = TokenBucket(budget, 0.0)
    assert send([30, 30], budget, bucket=bucket)[0] == [30]
    assert send([30, 30], budget, bucket=bucket, now=0.1)[0] == []
    assert send([30, 30], budget, bucket=bucket, now=1.0)[0] == [30]


@pytest.mark.parametrize(
    ('caps', 'sent', 'reasons'),
    [
        ({'max_chips': 2}, [30, 10], {Dropped.FRAME_CHIPS: 2}),
        ({'max_bytes': 1500}, [30, 10], {Dropped.FRAME_BYTES: 2}),
        ({'max_bytes': 500}, [10, 5], {Dropped.FRAME_BYTES: 2}),
    ],
)
def test_a_frame_has_caps_of_its_own(caps, sent, reasons) -> None:
    got, dropped, _ = send([30, 10, 25, 5], BudgetSettings(**caps))
    assert got == sent
    assert dropped == {reason.value: count for reason, count in reasons.items()}


def test_the_overhead_of_the_link_is_paid_for() -> None:
    budget = BudgetSettings(1500.0, overhead=500)
    assert send([20, 20], budget)[0] == [20]
    assert send([20, 20], replace(budget, overhead=0))[0] == [20, 20]


def test_a_chip_that_does_not_fit_is_encoded_at_lower_quality() -> None:
    codec = CodecSettings('jpeg', 95)
    whole, lower = (
        len(send([64], BudgetSettings(), replace(codec, quality=quality))[2][0])
        for quality in (95, 50)
    )
    budget = BudgetSettings(1e6, burst=(whole + lower) / 2)
    assert send([64], budget, codec)[1] == {Dropped.LARGER_THAN_BURST.value: 1}
    sent, dropped, files = send([64], replace(budget, min_quality=5), codec)
    assert (sent, dropped) == ([64], {})
    # Not the lowest quality: that in the middle fits.
    assert len(files[0]) == lower
    tight = replace(budget, burst=lower - 1, min_quality=5)
    assert len(send([64], tight, codec)[2][0]) < lower


def test_an_exact_chip_is_never_made_inexact() -> None:
    budget = BudgetSettings(100.0, min_quality=1)
    assert send([64], budget, CodecSettings('webp', lossless=True))[0] == []


@given(
    sides=st.lists(st.integers(1, 60), max_size=12),
    rate=st.floats(1.0, 5000.0),
    caps=st.builds(
        dict,
        max_chips=st.integers(0, 5),
        max_bytes=st.integers(0, 5000),
        overhead=st.integers(0, 100),
    ),
)
def test_the_budget_of_a_frame_holds_and_the_most_valuable_go_first(sides, rate, caps) -> None:
    budget = BudgetSettings(rate, **caps)
    sent, dropped, files = send(sides, budget)
    total = sum(len(file) + budget.overhead for file in files)
    assert total <= rate
    assert not budget.max_bytes or total <= budget.max_bytes
    assert not budget.max_chips or len(files) <= budget.max_chips
    passed_over = dropped[Dropped.LARGER_THAN_BURST.value] + dropped[Dropped.FRAME_BYTES.value]
    if not passed_over:
        assert sent == sides[: len(sent)]


@pytest.mark.parametrize('name', vars(BudgetSettings()))
@pytest.mark.parametrize('value', [-1, float('nan'), float('inf')])
def test_a_setting_out_of_range_is_an_error_that_names_it(name, value) -> None:
    with pytest.raises(ValueError, match=f'^{name} must'):
        BudgetSettings(**{name: value})
