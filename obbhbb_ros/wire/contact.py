# SPDX-License-Identifier: Apache-2.0
"""`std_msgs/Bool`, read from its bytes."""

from __future__ import annotations

from obbhbb_ros.wire.layouts import BOOL
from obbhbb_ros.wire.walk import read_struct


def read_contact(data: bytes) -> bool:
    """
    Read whether there is contact with the ground.

    Parameters
    ----------
    data : bytes
        A serialized `std_msgs/Bool`.

    Returns
    -------
    bool
        Its value.

    Raises
    ------
    obbhbb_ros.wire.buffer.WireError
        If the bytes are no such message.
    """
    buffer, places = read_struct(data, BOOL)
    return buffer.numbers(places['data'], '?')[0]
