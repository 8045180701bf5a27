# SPDX-License-Identifier: Apache-2.0
"""A chip on its way into the catalogue, and as it comes out."""

from __future__ import annotations

import hashlib
import json
import math
import re
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from typing import Any
from typing import NamedTuple

from obbhbb_ros.downlink.chips import CODECS
from obbhbb_ros.spool.seals import digest_of
from obbhbb_ros.wire.stamp import Stamp

# As `NewChip.row` makes them; the last number is that of the row.
_ID = re.compile(r'-?[0-9]+_[0-9]{9,10}_[0-9a-f]{6}_([0-9]{1,18})')


class ChipState:
    """Where a chip of the catalogue is: in the spool, on its way to the outbox, or in it."""

    WAITING = 0
    CLAIMED = 1
    RELEASED = 2


@dataclass(frozen=True)
class NewChip:
    """
    A chip to store.

    Attributes
    ----------
    value : float
        Value, finite.
    class_id : str
        Class of the best detection.
    stamp : tuple of int
        Seconds and nanoseconds of the image.
    facts : mapping of str to value
        The rest of what its JSON says, besides `id`, `stamp`, `class_id`, `value`, `bytes` and
        `sha256`.
    data : bytes
        The file.

    Raises
    ------
    ValueError
        If the value is not finite.
    """

    value: float
    class_id: str
    stamp: Stamp
    facts: Mapping[str, Any]
    data: bytes

    def __post_init__(self) -> None:
        """Check the value."""
        if not math.isfinite(self.value):
            raise ValueError(f'value must be finite, not {self.value}')

    def row(self, seq: int, tag: str) -> tuple[Any, ...]:
        """Lay out the chip as a waiting row: the fields of `StoredChip`, and the file."""
        seconds, nanoseconds = self.stamp
        facts = {
            'stamp': {'sec': seconds, 'nanosec': nanoseconds},
            'class_id': self.class_id,
            **self.facts,
            'bytes': len(self.data),
            'sha256': hashlib.sha256(self.data).hexdigest(),
        }
        chip = StoredChip(
            seq,
            f'{seconds}_{nanoseconds:09d}_{tag}_{seq}',
            ChipState.WAITING,
            self.value,
            self.class_id,
            len(self.data),
            json.dumps(facts, ensure_ascii=False),
        )
        return (*chip.with_digest(), self.data)


class StoredChip(NamedTuple):
    """A chip of the catalogue; `facts` is JSON without `id` and `value`."""

    seq: int
    id: str
    state: int
    value: float
    class_id: str
    bytes: int
    facts: str
    digest: str = ''
    object: int | None = None

    def with_digest(self) -> StoredChip:
        """Return the chip with the digest of its description."""
        return self._replace(digest=self._digest())

    def is_intact(self) -> bool:
        """Return whether the description is the one that was stored."""
        # Damage may have turned a number or a text into anything.
        with suppress(TypeError):
            return self.digest == self._digest()
        return False

    def describe(self) -> dict[str, Any]:
        """
        Return everything that the JSON file of the chip says.

        Raises
        ------
        ValueError, RecursionError
            If the facts are damaged.
        """
        return {'id': self.id, 'value': self.value, **json.loads(self.facts)}

    def _digest(self) -> str:
        """Compute the digest of all that says what the chip is."""
        # SQLite does not store the sign of zero.
        numbers = f'{self.value + 0.0!r} {self.bytes} {self.object}'
        texts = '\0'.join((self.id, numbers, self.class_id, self.facts))
        return digest_of(texts.encode(errors='surrogatepass'))


COLUMNS = ', '.join(StoredChip._fields)
"""The columns of a `StoredChip`, in their order."""


def number_of(chip_id: str) -> int:
    """Return the number of the row that an id names; 0, which no row has, if it names none."""
    # Damage may have turned it into bytes.
    match = _ID.fullmatch(chip_id) if isinstance(chip_id, str) else None
    return int(match[1]) if match else 0


def describe_intact(chip: StoredChip, data: bytes) -> dict[str, Any] | None:
    """Describe a chip; None if its description or its file, `data`, is damaged."""
    if not chip.is_intact():
        return None
    with suppress(ValueError, KeyError, TypeError, RecursionError):
        description = chip.describe()
        is_whole = description['sha256'] == hashlib.sha256(data).hexdigest()
        # Id and codec make the names of its files.
        if is_whole and _ID.fullmatch(chip.id) and description['codec'] in CODECS:
            return description
    return None
