# SPDX-License-Identifier: Apache-2.0
"""Small messages that claim to be large take no more time and memory than their bytes."""

import resource
import struct
import subprocess
import sys
from pathlib import Path

import pytest
from cdr import Writer

from obbhbb_ros.wire.buffer import WireError
from obbhbb_ros.wire.camera import read_camera
from obbhbb_ros.wire.detections import Detections
from obbhbb_ros.wire.layouts import INPUT_TYPES

MANY = 2**32 - 1


def message(writer: Writer, order: str = '<') -> bytes:
    return bytes([0, order == '<', 0, 0]) + bytes(writer.data)


def keypoints(order: str, detections: int, count: int) -> bytes:
    """Write detections that claim to have many keypoints."""
    writer = Writer(order, 0)
    writer.header((0, 0), 'camera')
    writer.number('I', detections)
    for _ in range(detections):
        writer.number('i', 0)
        writer.text('ship')
        writer.number('d', 0.5)
        writer.text('1')
        for _ in range(15):
            writer.number('d', 1.0)
        writer.text('')
        for value in (0, 0, 0, count, 0):
            writer.number('I', value)
        writer.text('')
    return message(writer, order)


def false_starts(size: int) -> bytes:
    """Write what looks like the start of a detection every 24 bytes, each with many results."""
    writer = Writer('<', 0)
    writer.header((0, 0), '')
    writer.number('I', size // 96)
    writer.data += struct.pack('<6I', 7, 7, 1, 0, size // 704, 1) * (size // 96)
    writer.data += struct.pack('<I', 1) * (3 * size // 16)
    return message(writer)


def long_headers(count: int) -> bytes:
    """Write a long frame_id, and many polygons that would each get it."""
    writer = Writer('<', 0)
    writer.header((0, 0), 'x' * 4 * count)
    writer.number('I', count)
    writer.data += bytes(4 * count + 4)
    return message(writer)


HOSTILE = [
    pytest.param('DetectionArray', 'keypoints("<", 40, MANY)', id='keypoints'),
    pytest.param('DetectionArray', 'keypoints(">", 40, MANY)', id='keypoints, big-endian'),
    pytest.param('DetectionArray', 'keypoints("<", 5, MANY)', id='keypoints of a few'),
    pytest.param('Detection2DArray', 'false_starts(1_600_000)', id='false starts'),
    pytest.param('Polygon2DCollection', 'long_headers(20_000)', id='long headers'),
]


def read_within_limits(input_type: str, data: bytes) -> None:
    """Read a message with half a gigabyte besides what imports take, and exit with 7 if refused."""
    pages = int(Path('/proc/self/statm').read_text().split()[0])
    used = pages * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (used + 2**29, used + 2**29))
    resource.setrlimit(resource.RLIMIT_CPU, (20, 20))
    try:
        Detections(data, INPUT_TYPES[input_type])
    except WireError:
        sys.exit(7)


@pytest.mark.parametrize(('input_type', 'made_by'), HOSTILE)
def test_a_hostile_message_is_refused_within_its_means(input_type: str, made_by: str) -> None:
    code = f"""
import sys; sys.path[:0] = {[str(Path(__file__).parent), *sys.path]!r}
from test_hostile import *
read_within_limits('{input_type}', {made_by})
"""
    assert subprocess.run([sys.executable, '-c', code], check=False).returncode == 7


def polygons(*counts: int) -> bytes:
    """Write polygons with some numbers of vertices."""
    writer = Writer('<', 0)
    writer.header((0, 0), '')
    writer.number('I', len(counts))
    for count in counts:
        writer.number('I', count)
        for _ in range(2 * count):
            writer.number('d', 1.0)
    # No colours.
    writer.number('I', 0)
    return message(writer)


@pytest.mark.parametrize(
    ('counts', 'readable'),
    [((0,) * 1000, True), ((0, 4) * 1000, True), ((0, 4, 0) * 1000, False), ((0,) * 1001, False)],
)
def test_many_polygons_are_not_mostly_empty(counts: tuple[int, ...], readable: bool) -> None:
    data, kind = polygons(*counts), INPUT_TYPES['Polygon2DCollection']
    if readable:
        assert len(Detections(data, kind)) == len(counts)
    else:
        with pytest.raises(WireError, match=f'{counts.count(0)} of {len(counts)} polygons'):
            Detections(data, kind)


@pytest.mark.parametrize(('width', 'readable'), [(10**6, True), (10**6 + 1, False), (MANY, False)])
def test_an_image_that_cannot_be_is_no_image_size(width: int, readable: bool) -> None:
    writer = Writer('<', 0)
    writer.header((0, 0), 'camera')
    writer.number('I', 480)
    writer.number('I', width)
    writer.text('')
    writer.number('I', 0)
    for _ in range(30):
        writer.number('d', 0.0)
    for _ in range(6):
        writer.number('I', 0)
    writer.data += b'\0'
    if readable:
        assert read_camera(message(writer)).image_size == (width, 480)
    else:
        with pytest.raises(WireError, match=f'image of {width} x 480 pixels'):
            read_camera(message(writer))
