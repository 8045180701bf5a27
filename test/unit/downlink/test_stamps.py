# SPDX-License-Identifier: Apache-2.0
"""Stamps of chips: none twice, and the image's can be told from them."""

from itertools import islice

import pytest
from hypothesis import given
from hypothesis import strategies as st

from obbhbb_ros.downlink.stamps import ChipStamps


def take(stamps, stamp, count):
    return list(islice(stamps.of_image(stamp), count))


def test_the_first_chip_has_the_stamp_of_its_image() -> None:
    assert take(ChipStamps(), (5, 10), 3) == [(5, 10), (5, 11), (5, 12)]


@pytest.mark.parametrize('seconds', [5, 0, -3])
def test_a_second_has_a_thousand_million_nanoseconds(seconds) -> None:
    assert take(ChipStamps(), (seconds, 999_999_998), 3) == [
        (seconds, 999_999_998),
        (seconds, 999_999_999),
        (seconds + 1, 0),
    ]


@given(
    st.lists(
        st.tuples(
            st.tuples(st.integers(0, 2), st.sampled_from([0, 3, 10, 999_999_995, 999_999_999])),
            st.integers(0, 100),
        ),
        max_size=20,
    )
)
def test_none_is_given_twice(images) -> None:
    stamps = ChipStamps()
    taken = []
    for stamp, count in images:
        stamps_of_image = take(stamps, stamp, count)
        assert stamps_of_image == sorted(stamps_of_image)
        assert not stamps_of_image or stamps_of_image[0] >= stamp
        taken += stamps_of_image
    assert len(set(taken)) == len(taken)
    assert all(0 <= nanoseconds < 10**9 for _, nanoseconds in taken)


def test_images_whose_chips_overlap_share_no_stamp() -> None:
    stamps = ChipStamps()
    assert take(stamps, (5, 0), 3) == [(5, 0), (5, 1), (5, 2)]
    assert take(stamps, (5, 1), 2) == [(5, 3), (5, 4)]


def test_the_last_ten_thousand_are_remembered() -> None:
    stamps = ChipStamps()
    take(stamps, (5, 0), 10_000)
    assert take(stamps, (5, 0), 1) == [(5, 10_000)]
    # The first is forgotten now.
    assert take(stamps, (5, 0), 1) == [(5, 0)]


def test_after_the_last_stamp_comes_the_first() -> None:
    stamps = ChipStamps().of_image((2**31 - 1, 999_999_999))
    assert [next(stamps) for _ in range(3)] == [(2**31 - 1, 999_999_999), (0, 0), (0, 1)]
