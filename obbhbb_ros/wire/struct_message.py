# SPDX-License-Identifier: Apache-2.0
"""A message that is one struct."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from typing import Any

from obbhbb_ros.wire.buffer import Buffer
from obbhbb_ros.wire.stamp import Stamp
from obbhbb_ros.wire.walk import Places
from obbhbb_ros.wire.walk import Step
from obbhbb_ros.wire.walk import walk


class StructMessage:
    """
    A message that is one struct, read without copying it.

    Parameters
    ----------
    data : bytes
        The serialized message.
    steps : sequence of Step
        The steps over it.

    Raises
    ------
    obbhbb_ros.wire.buffer.WireError
        If the bytes are no such message.
    """

    def __init__(self, data: bytes, steps: Sequence[Step]) -> None:
        self._buffer = Buffer(data)
        self._places: Places = defaultdict(list)
        self._buffer.check_end(walk(self._buffer.lengths, 0, steps, self._places, []))

    @property
    def stamp(self) -> Stamp:
        """The stamp of the header."""
        return self._buffer.stamp

    def numbers(self, path: str, codes: str) -> tuple[Any, ...]:
        """Read numbers from a field on, whose types are given as `struct` does."""
        return self._buffer.numbers(self._places[path][0], codes)

    def content(self, path: str) -> memoryview:
        """Return the bytes of a sequence of bytes."""
        return self._buffer.content(self._places[path][0])

    def text(self, path: str) -> str:
        """Read a string; bytes that are not UTF-8 are escaped."""
        return self._buffer.text(self._places[path][0])
