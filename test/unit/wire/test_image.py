# SPDX-License-Identifier: Apache-2.0
"""Images in their bytes."""

import numpy as np
import pytest
from cdr import Writer
from hypothesis import given
from hypothesis import strategies as st

from obbhbb_ros.wire.buffer import WireError
from obbhbb_ros.wire.image import read_image

ORDERS = pytest.mark.parametrize('order', '<>')


def image(order='<', padding=0, data=bytes(range(60)), frame_id='camera') -> bytes:
    """Serialize an image of 5 x 4 pixels."""
    writer = Writer(order, padding)
    writer.header((-3, 7), frame_id)
    writer.number('I', 4)
    writer.number('I', 5)
    writer.text('rgb8')
    writer.number('B', 1)
    writer.number('I', 15)
    writer.number('I', len(data))
    writer.data += data
    return bytes([0, order == '<', 0, 0]) + bytes(writer.data)


@ORDERS
@pytest.mark.parametrize('padding', [0, 0xA5])
@pytest.mark.parametrize('trailing', range(7))
@pytest.mark.parametrize('frame_id', ['', 'a', 'ab', 'abc', 'Größe'])
def test_an_image_is_read(order, padding, trailing, frame_id) -> None:
    received = read_image(image(order, padding, frame_id=frame_id) + bytes(trailing))
    assert received.stamp == (-3, 7)
    assert (received.frame_id, received.encoding) == (frame_id, 'rgb8')
    assert (received.width, received.height, received.step, received.is_bigendian) == (
        5,
        4,
        15,
        True,
    )
    assert received.data == bytes(range(60))


def test_the_pixels_of_an_image_are_not_copied() -> None:
    message = image(data=bytes(10**6))
    pixels = np.frombuffer(read_image(message).data, np.uint8)
    assert np.shares_memory(pixels, np.frombuffer(message, np.uint8))


@ORDERS
@given(data=st.data())
def test_an_image_cut_anywhere_is_refused(order, data) -> None:
    whole = image(order)
    with pytest.raises(WireError):
        read_image(whole[: data.draw(st.integers(0, len(whole) - 1))])


@given(data=st.data())
def test_a_damaged_image_raises_the_documented_error_or_is_read(data) -> None:
    damaged = bytearray(image())
    for _ in range(data.draw(st.integers(1, 4))):
        place = data.draw(st.integers(0, len(damaged) - 1))
        damaged[place] = data.draw(st.sampled_from([0, 1, 2, 0x7F, 0x80, 0xFF]))
    try:
        received = read_image(bytes(damaged))
    except WireError:
        return
    assert len(received.data) <= len(damaged)


def test_more_behind_an_image_than_padding_is_refused() -> None:
    with pytest.raises(WireError, match='7 bytes behind'):
        read_image(image() + bytes(7))
