# SPDX-License-Identifier: Apache-2.0
"""Seas of ships through the node `ship_tracker`."""

from __future__ import annotations

from itertools import count

import numpy as np
from harness import Converter
from seas import Frame
from seas import Ints
from ships import detections

# Later than all that `Converter.connect` sends, seconds.
_FIRST_STAMP = 100_000
# Length by width.
_SLENDERNESS = 5.5


def numbers_of(node: Converter, frame: Frame) -> Ints:
    """
    Let the node number the boxes of an image.

    Returns
    -------
    ndarray of int, shape (N,)
        The numbers in the ids; boxes without one have a number below 0 that no other has.
    """
    message = detections(
        np.column_stack(
            (
                frame.place.real,
                frame.place.imag,
                frame.length,
                frame.length / _SLENDERNESS,
                frame.angle,
            )
        )
    )
    nanoseconds = round((_FIRST_STAMP + frame.time) * 1e9)
    message.header.stamp.sec, message.header.stamp.nanosec = divmod(nanoseconds, 10**9)
    node.publisher.publish(message)
    answer = node.wait_for(
        lambda: (one for one in reversed(node.boxes) if one.header == message.header),
        'the ids of an image',
    )
    unnumbered = count(-1, -1)
    return np.array(
        [
            int(detection.id.rpartition('-')[2]) if detection.id else next(unnumbered)
            for detection in answer.detections
        ],
        np.int64,
    )
