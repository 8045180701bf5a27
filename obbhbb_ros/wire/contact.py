# SPDX-License-Identifier: Apache-2.0
"""`std_msgs/Bool`, read from its bytes."""

from __future__ import annotations

from obbhbb_ros.wire.cdr import Message
from obbhbb_ros.wire.cdr import steps_of
from obbhbb_ros.wire.layouts import BOOL

_BOOL = steps_of(BOOL)


def read_contact(data: bytes) -> bool:
    """
    Read whether there is contact.

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
    return Message(data, _BOOL).bytes_at('data')[0] != 0
