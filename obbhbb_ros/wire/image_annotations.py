# SPDX-License-Identifier: Apache-2.0
"""
`foxglove_msgs/ImageAnnotations`, written to bytes.

rclpy spends several microseconds on the object of each point, and a dashed box has dozens. Releases
of foxglove_msgs differ in their fields, so the message is written as the installed one has it.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from obbhbb_ros.errors import ObbhbbError
from obbhbb_ros.geometry.boxes import FloatArray
from obbhbb_ros.wire.buffer import LITTLE_ENDIAN
from obbhbb_ros.wire.stamp import Stamp
from obbhbb_ros.wire.writing import padding
from obbhbb_ros.wire.writing import text_bytes

_LINE_LIST = 4
_EMPTY = struct.pack('<I', 0)
_CLEAR = np.zeros(4)
# The fields that are written; those of the second kind came with foxglove_msgs 3.2.6.
_FIELDS = {
    'ImageAnnotations': ({'points', 'texts'}, {'timestamp'}),
    'PointsAnnotation': (
        {'timestamp', 'type', 'points', 'outline_color', 'fill_color', 'thickness'},
        set[str](),
    ),
    'TextAnnotation': (
        {'timestamp', 'position', 'text', 'font_size', 'text_color', 'background_color'},
        set[str](),
    ),
}

# Numbers of eight bytes, which lie at a multiple of eight; or bytes of whole words.
_Pieces: TypeAlias = list[FloatArray | bytes]

MESSAGES = tuple(_FIELDS)
"""The messages of foxglove_msgs whose fields must be known to write annotations."""


class UnknownFieldsError(ObbhbbError, RuntimeError):
    """The installed foxglove_msgs cannot be written; the text names the fields."""


@dataclass(frozen=True)
class Stroke:
    """
    Lines of one colour.

    Attributes
    ----------
    color : tuple of int
        Red, green and blue, 0 to 255.
    width : float
        Width of the lines, pixels.
    segments : ndarray, shape (M, 2, 2)
        x and y of the ends of each line, pixels of the image.
    """

    color: tuple[int, int, int]
    width: float
    segments: FloatArray


@dataclass(frozen=True)
class Caption:
    """
    A text on a background.

    Attributes
    ----------
    text : str
        The text.
    position : tuple of float
        x and y of its lower left corner, pixels of the image.
    size : float
        Size of the font, pixels.
    ink, ground : tuple of int
        Colours of text and background: red, green and blue, 0 to 255.
    """

    text: str
    position: tuple[float, float]
    size: float
    ink: tuple[int, int, int]
    ground: tuple[int, int, int]


class AnnotationWriter:
    """
    Writes messages with the fields of the installed foxglove_msgs.

    Parameters
    ----------
    fields : mapping of str to mapping of str to str
        For each of `MESSAGES`, its fields in order and their types, as
        `get_fields_and_field_types()` lists them.

    Raises
    ------
    UnknownFieldsError
        If fields are missing, or others than sequences are unknown; an unknown sequence is empty.
    """

    def __init__(self, fields: Mapping[str, Mapping[str, str]]) -> None:
        self._fields = fields
        odd: list[str] = []
        for message, (needed, later) in _FIELDS.items():
            present = fields[message]
            odd += [f'{message} has no {name}' for name in sorted(needed - set(present))]
            odd += [
                f'{message} has {name}'
                for name, kind in present.items()
                if name not in needed | later and not kind.startswith('sequence<')
            ]
        if odd:
            raise UnknownFieldsError(f'this foxglove_msgs is not known: {", ".join(odd)}')

    def write(self, stamp: Stamp, strokes: Sequence[Stroke], captions: Sequence[Caption]) -> bytes:
        """
        Write a message.

        Parameters
        ----------
        stamp : Stamp
            Stamp of the image.
        strokes : sequence of Stroke
            The lines, the first at the bottom.
        captions : sequence of Caption
            The texts.

        Returns
        -------
        bytes
            The serialized message, little-endian, with its encapsulation header.
        """
        time = struct.pack('<iI', *stamp)
        pieces = self._pieces(
            'ImageAnnotations',
            timestamp=[time],
            points=_sequence([self._stroke(time, stroke) for stroke in strokes]),
            texts=_sequence([self._caption(time, caption) for caption in captions]),
        )
        body = bytearray()
        for piece in pieces:
            if isinstance(piece, bytes):
                body += piece
            elif len(piece):
                body += padding(len(body)) + piece.astype('<f8').tobytes()
        return LITTLE_ENDIAN + bytes(body)

    def _stroke(self, time: bytes, stroke: Stroke) -> _Pieces:
        """List the pieces of a `PointsAnnotation`."""
        points = stroke.segments.reshape(-1, 2)
        return self._pieces(
            'PointsAnnotation',
            timestamp=[time],
            type=[struct.pack('<B3x', _LINE_LIST)],
            points=[struct.pack('<I', len(points)), points],
            outline_color=[_rgba(stroke.color)],
            fill_color=[_CLEAR],
            thickness=[np.array([stroke.width])],
        )

    def _caption(self, time: bytes, caption: Caption) -> _Pieces:
        """List the pieces of a `TextAnnotation`."""
        return self._pieces(
            'TextAnnotation',
            timestamp=[time],
            position=[np.array(caption.position)],
            text=[text_bytes(caption.text.encode(errors='replace'))],
            font_size=[np.array([caption.size])],
            text_color=[_rgba(caption.ink)],
            background_color=[_rgba(caption.ground)],
        )

    def _pieces(self, message: str, **known: _Pieces) -> _Pieces:
        """List the pieces of a message in the order of its fields."""
        return [piece for name in self._fields[message] for piece in known.get(name, [_EMPTY])]


def _sequence(elements: list[_Pieces]) -> _Pieces:
    """List the pieces of a sequence."""
    return [struct.pack('<I', len(elements)), *(piece for element in elements for piece in element)]


def _rgba(color: tuple[int, int, int]) -> FloatArray:
    """Return an opaque colour, 0 to 1."""
    return np.array([*color, 255]) / 255.0
