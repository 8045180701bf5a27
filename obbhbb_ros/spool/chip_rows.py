# SPDX-License-Identifier: Apache-2.0
"""A chip on its way into the catalogue, and on its way out."""

from __future__ import annotations

import hashlib
import json
import math
import re
import sqlite3
from collections.abc import Iterable
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from typing import Any
from typing import NamedTuple

from obbhbb_ros.downlink.chips import CODECS
from obbhbb_ros.spool.ranking import key_of
from obbhbb_ros.spool.ranking import rank_of
from obbhbb_ros.spool.ranking import worth_of
from obbhbb_ros.spool.seals import digest_of
from obbhbb_ros.wire.stamp import Stamp

# In the form of `NewChip.row`; the last number is that of the row.
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
    object_id : str
        Which ship it shows, by an id that no other has; empty if that is not known.

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
    object_id: str = ''

    def __post_init__(self) -> None:
        """Check the value."""
        if not math.isfinite(self.value):
            raise ValueError(f'value must be finite, not {self.value}')

    def stored(self, seq: int, tag: str) -> StoredChip:
        """Describe the chip as it waits under a number in the catalogue of a tag."""
        seconds, nanoseconds = self.stamp
        facts = {
            'stamp': {'sec': seconds, 'nanosec': nanoseconds},
            'class_id': self.class_id,
            'object': self.object_id or None,
            **self.facts,
            'bytes': len(self.data),
            'sha256': hashlib.sha256(self.data).hexdigest(),
        }
        return StoredChip(
            seq,
            f'{seconds}_{nanoseconds:09d}_{tag}_{seq}',
            ChipState.WAITING,
            float(self.value),
            self.class_id,
            len(self.data),
            json.dumps(facts, ensure_ascii=False),
            object=key_of(self.object_id) if self.object_id else None,
            worth=_worth(self.value, self.facts),
        ).with_digest()


class StoredChip(NamedTuple):
    """
    A chip of the catalogue.

    Attributes
    ----------
    seq, id : int, str
        Number of its row, and id.
    state : int
        A `ChipState`.
    value, class_id, bytes : float, str, int
        Value and class, and size of the file.
    facts : str
        The rest of its JSON.
    digest : str
        Digest of all of it but `state` and `k`.
    object : int or None
        Key of the ship that it shows, if that is known.
    worth, k : float, int
        What its rank is computed from, see `obbhbb_ros.spool.ranking`.
    view : int or None
        Which view of its object it is: one more than were released when it was claimed.
    """

    seq: int
    id: str
    state: int
    value: float
    class_id: str
    bytes: int
    facts: str
    digest: str = ''
    object: int | None = None
    worth: float = 0.0
    k: int = 0
    view: int | None = None

    @classmethod
    def of_version_1(cls, *fields: Any) -> StoredChip:
        """Make a chip of the columns of version 1; TypeError if one of them is damaged."""
        chip = cls(*fields)
        return chip._replace(worth=chip.value).with_digest()

    def with_digest(self) -> StoredChip:
        """Return the chip with the digest of its description."""
        return self._replace(digest=self._digest())

    def is_intact(self) -> bool:
        """Return whether the description is the one that was stored."""
        # Damage may have turned a number or a text into anything.
        with suppress(TypeError):
            return self.digest == self._digest()
        return False

    def revalued(self, value: float) -> StoredChip:
        """Return the chip with another value; ValueError if the facts are damaged."""
        worth = _worth(value, json.loads(self.facts))
        return self._replace(value=float(value), worth=worth).with_digest()

    def rank(self, fade: float) -> float:
        """Return the rank of the chip."""
        return rank_of(self.worth, self.k, fade)

    def describe(self, fade: float | None) -> dict[str, Any]:
        """
        Return everything that the JSON file of the chip says.

        Parameters
        ----------
        fade : float or None
            The fade in force; None if it is not known, and then the rank is not.

        Raises
        ------
        ValueError, RecursionError
            If the facts are damaged.
        """
        rank = None if fade is None else self.rank(fade)
        facts = json.loads(self.facts)
        return {'id': self.id, 'value': self.value, 'rank': rank, 'view': self.view, **facts}

    def _digest(self) -> str:
        """Compute the digest of all that says what the chip is."""
        # SQLite does not store the sign of zero.
        numbers = (
            f'{self.value + 0.0!r} {self.worth + 0.0!r} {self.bytes} {self.object} {self.view}'
        )
        texts = '\0'.join((self.id, numbers, self.class_id, self.facts))
        return digest_of(texts.encode(errors='surrogatepass'))


COLUMNS = ', '.join(StoredChip._fields)
"""The columns of a `StoredChip`, in their order."""
COLUMNS_1 = StoredChip._fields[:7]
"""Those of them that catalogues of version 1 have."""
INSERT = f'INSERT INTO chips ({COLUMNS}, data) VALUES ({"?, " * len(StoredChip._fields)}?)'
"""A statement that stores a `StoredChip` and its file."""


def number_of(chip_id: str) -> int:
    """Return the number of the row that an id names; 0, which no row has, if it names none."""
    # Damage may have turned it into bytes.
    match = _ID.fullmatch(chip_id) if isinstance(chip_id, str) else None
    return int(match[1]) if match else 0


def chips_of(rows: sqlite3.Cursor, ids: Iterable[str], state: int) -> list[StoredChip]:
    """Read the chips of some ids, as far as they are in a state."""
    chips = []
    for chip_id in ids:
        rows.execute(
            f'SELECT {COLUMNS} FROM chips WHERE seq = ? AND id = ? AND state = ?',
            (number_of(chip_id), chip_id, state),
        )
        chips += [StoredChip(*fields) for fields in rows.fetchall()]
    return chips


def describe_intact(chip: StoredChip, data: bytes, fade: float | None) -> dict[str, Any] | None:
    """Describe a chip by the fade; None if its description or its file, `data`, is damaged."""
    if not chip.is_intact():
        return None
    with suppress(ValueError, KeyError, TypeError, RecursionError):
        description = chip.describe(fade)
        is_whole = description['sha256'] == hashlib.sha256(data).hexdigest()
        # Id and codec make the names of its files.
        if is_whole and _ID.fullmatch(chip.id) and description['codec'] in CODECS:
            return description
    return None


def _worth(value: float, facts: Mapping[str, Any]) -> float:
    """Return the worth of a chip of some facts."""
    # The digest is over its text, which NumPy's numbers write otherwise than those from SQLite.
    return float(worth_of(value, facts.get('obb'), facts.get('image_size', ())))
