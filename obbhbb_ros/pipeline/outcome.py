# SPDX-License-Identifier: Apache-2.0
"""What becomes of a message: where its answers go, and what is counted and said of it."""

from __future__ import annotations

from collections.abc import Callable
from collections.abc import Iterable
from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

OTHER_FRAME = 'other frame'
OTHER_POSE = 'pose of another frame'
SAID_ONCE = (OTHER_FRAME, OTHER_POSE)
"""Kinds of the complaints that are worth saying once."""

_NONE: Mapping[str, str] = {}


@dataclass(frozen=True)
class Output:
    """
    A topic for answers.

    Attributes
    ----------
    publish : callable
        Takes the bytes of a message.
    wanted : callable
        Returns whether anybody wants a message now.
    """

    publish: Callable[[bytes], object]
    wanted: Callable[[], object] = lambda: True


NOBODY = Output(lambda data: None, lambda: False)


class Finding(NamedTuple):
    """
    Something that a message shows.

    Attributes
    ----------
    counts : mapping of str to int
        By key of the diagnostics.
    complaints : mapping of str
        What is wrong with it, by kind.
    """

    counts: Mapping[str, int]
    complaints: Mapping[str, str] = _NONE


class Outcome(NamedTuple):
    """
    What became of a message.

    Attributes
    ----------
    counts : dict of str to int
        By key of the diagnostics.
    complaints : dict of str
        What went wrong, by kind.
    image_size : tuple of int, optional
        Width and height of the image, if they are known.
    """

    counts: dict[str, int]
    complaints: dict[str, str]
    image_size: tuple[int, int] | None = None

    @classmethod
    def of(cls, findings: Iterable[Finding], image_size: tuple[int, int] | None) -> Outcome:
        """Put findings together; their keys and kinds differ."""
        counts: dict[str, int] = {}
        complaints: dict[str, str] = {}
        for finding in findings:
            counts |= finding.counts
            complaints |= finding.complaints
        return cls(counts, complaints, image_size)
