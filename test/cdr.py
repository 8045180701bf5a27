# SPDX-License-Identifier: Apache-2.0
"""
An encoder of `Detection2DArray`, written from the CDR rules field by field.

It knows nothing of how `obbhbb_ros.wire` goes about it, so that the two can be held together.
"""

import struct
from dataclasses import dataclass
from dataclasses import field
from dataclasses import replace

from hypothesis import strategies as st


@dataclass(frozen=True)
class Hypothesis:
    class_id: str = 'ship'
    score: float = 0.5
    pose: tuple = tuple(float(i) for i in range(43))


@dataclass(frozen=True)
class Detection:
    stamp: tuple = (1, 2)
    frame_id: str = 'camera'
    results: tuple = (Hypothesis(),)
    bbox: tuple = (10.0, 20.0, 0.3, 40.0, 8.0)
    id: str = '7'


@dataclass(frozen=True)
class Message:
    stamp: tuple = (3, 4)
    frame_id: str = 'camera'
    detections: tuple = field(default_factory=tuple)


class Writer:
    """Appends values, each at a multiple of its size."""

    def __init__(self, order: str, padding: int) -> None:
        self.order, self.padding, self.data = order, bytes([padding]), bytearray()

    def number(self, code: str, value: float) -> None:
        size = struct.calcsize(code)
        self.data += self.padding * (-len(self.data) % size)
        self.data += struct.pack(self.order + code, value)

    def text(self, value: str) -> None:
        encoded = value.encode() + b'\0'
        self.number('I', len(encoded))
        self.data += encoded

    def header(self, stamp, frame_id) -> None:
        self.number('i', stamp[0])
        self.number('I', stamp[1])
        self.text(frame_id)


def encode(message: Message, order: str = '<', padding: int = 0) -> bytes:
    """Serialize a message; `padding` is what lies between fields."""
    writer = Writer(order, padding)
    writer.header(message.stamp, message.frame_id)
    writer.number('I', len(message.detections))
    for detection in message.detections:
        writer.header(detection.stamp, detection.frame_id)
        writer.number('I', len(detection.results))
        for result in detection.results:
            writer.text(result.class_id)
            for value in (result.score, *result.pose):
                writer.number('d', value)
        for value in detection.bbox:
            writer.number('d', value)
        writer.text(detection.id)
    return bytes([0, order == '<', 0, 0]) + bytes(writer.data)


def with_box(detection: Detection, row) -> Detection:
    """Give a detection an axis-aligned box: centre x and y, size x and y."""
    x, y, width, height = map(float, row)
    return replace(detection, bbox=(x, y, 0.0, width, height))


TEXT = st.one_of(
    st.sampled_from(['', 'ship', 'tug', 'camera_optical_frame', 'größe', '船', 'a' * 200]),
    st.text(st.characters(exclude_characters='\0', exclude_categories=['Cs']), max_size=12),
)
STAMP = st.tuples(st.integers(-(2**31), 2**31 - 1), st.integers(0, 2**32 - 1))
NUMBER = st.floats(-1e9, 1e9)
HYPOTHESES = st.builds(Hypothesis, class_id=TEXT, score=st.one_of(NUMBER, st.just(float('nan'))))
DETECTIONS = st.builds(
    Detection,
    stamp=STAMP,
    frame_id=TEXT,
    results=st.lists(HYPOTHESES, max_size=5).map(tuple),
    bbox=st.tuples(NUMBER, NUMBER, NUMBER, NUMBER, NUMBER),
    id=TEXT,
)
# A few kinds of detection, repeated and mixed: what a detector sends.
REPEATED = st.lists(DETECTIONS, min_size=1, max_size=3).flatmap(
    lambda kinds: st.lists(st.sampled_from(kinds), max_size=60)
)
MESSAGES = st.builds(
    Message,
    stamp=STAMP,
    frame_id=TEXT,
    detections=st.one_of(st.lists(DETECTIONS, max_size=6), REPEATED).map(tuple),
)
