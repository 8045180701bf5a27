# SPDX-License-Identifier: Apache-2.0
"""The operator's view of a spool: what waits in it, and changes to that."""

from __future__ import annotations

import math
import sqlite3
import sys
from collections.abc import Callable
from collections.abc import Iterable
from collections.abc import Iterator
from collections.abc import Mapping
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import chain
from itertools import islice
from typing import Any
from typing import NamedTuple

from obbhbb_ros.spool.access import SpoolAccess
from obbhbb_ros.spool.books import Books
from obbhbb_ros.spool.chip_rows import COLUMNS
from obbhbb_ros.spool.chip_rows import ChipState
from obbhbb_ros.spool.chip_rows import StoredChip
from obbhbb_ros.spool.chip_rows import number_of
from obbhbb_ros.spool.order import in_order
from obbhbb_ros.spool.ranking import key_of
from obbhbb_ros.spool.views import ObjectViews

# Changes some chips in a transaction, and returns how many.
_Change = Callable[[sqlite3.Cursor, Books, Sequence[StoredChip]], int]
# Conditions on the state, in the order in which chips are listed; damage makes others.
_STATES = ('state < 0', *(f'state = {state}' for state in range(3)), 'state > 2')
# Chips to change in one transaction, so that writers do not wait long.
_PIECE = 1000


@dataclass(frozen=True)
class ChipFilter:
    """
    Which chips of a spool are meant; all conditions must hold.

    Attributes
    ----------
    class_ids, ids : sequence of str
        Classes and ids of chips (empty: any).
    min_value, max_value : float
        Bounds of the value, both included.
    objects : sequence of str
        Ids of the ships that they show (empty: any).

    Examples
    --------
    >>> ChipFilter(class_ids=['tug'], min_value=0.5).matches(
    ...     StoredChip(1, '5_000000000_a1b2c3_1', 0, 0.7, 'tug', 300, '{}')
    ... )
    True
    """

    class_ids: Sequence[str] = ()
    ids: Sequence[str] = ()
    min_value: float = -math.inf
    max_value: float = math.inf
    objects: Sequence[str] = ()

    def matches(self, chip: StoredChip) -> bool:
        """Return whether a chip is meant."""
        return (
            self.min_value <= chip.value <= self.max_value
            and (not self.class_ids or chip.class_id in self.class_ids)
            and (not self.ids or chip.id in self.ids)
            and (not self.objects or chip.object in [*map(key_of, self.objects)])
        )

    def sql(self) -> tuple[str, list[Any]]:
        """Return the same conditions for a catalogue: SQL and its values."""
        clauses: list[str] = ['TRUE']
        values: list[Any] = []
        # Damage may have turned a value into something without a place in the order.
        if (self.min_value, self.max_value) != (-math.inf, math.inf):
            clauses.append('value BETWEEN ? AND ?')
            values += (self.min_value, self.max_value)
        # The number of a chip finds it at once.
        columns: Mapping[str, Sequence[object]] = {
            'class_id': self.class_ids,
            'id': self.ids,
            'seq': [number_of(chip_id) for chip_id in self.ids],
            'object': [key_of(object_id) for object_id in self.objects],
        }
        for column, choices in columns.items():
            if choices:
                clauses.append(f'{column} IN ({", ".join("?" * len(choices))})')
                values += choices
        return ' AND '.join(clauses), values


ANY_CHIP = ChipFilter()


class ObjectSummary(NamedTuple):
    """A ship whose chips wait: its best chip, how many there are, how many were released."""

    best: StoredChip
    views: int
    released: int


class SpoolConsole(SpoolAccess):
    """Lists, revalues and deletes the chips of a spool while others write and release."""

    def select(self, chips: ChipFilter = ANY_CHIP, limit: int = -1) -> list[StoredChip]:
        """List chips in the order of their release, by state; a negative limit means none."""
        where, values = chips.sql()
        with self._catalogue.transaction() as rows:
            fade = Books.read(rows).fade
            listed = chain.from_iterable(
                in_order(rows, fade, state, where, values) for state in _STATES
            )
            return list(islice(listed, None if limit < 0 else limit))

    def objects(self, chips: ChipFilter = ANY_CHIP, limit: int = -1) -> list[ObjectSummary]:
        """List known ships whose chips wait, by the rank of their best ones."""
        where, values = chips.sql()
        known = f'object IS NOT NULL AND {where}'
        best: dict[int | None, StoredChip] = {}
        with self._catalogue.transaction() as rows:
            fade = Books.read(rows).fade
            for chip in in_order(rows, fade, f'state = {ChipState.WAITING}', known, values):
                if len(best) == limit:
                    break
                best.setdefault(chip.object, chip)
            views = dict(
                rows.execute(
                    f'SELECT object, count(*) FROM chips WHERE state < 2 AND {known} '
                    'GROUP BY object',
                    values,
                ).fetchall()
            )
            released = dict(rows.execute('SELECT object, released FROM objects').fetchall())
        return [
            ObjectSummary(chip, views.get(key, 0), released.get(key, 0))
            for key, chip in best.items()
        ]

    def files(self, chips: Iterable[StoredChip]) -> Iterator[tuple[StoredChip, bytes]]:
        """Read the files of chips, without those that are in the outbox already."""
        for chip in chips:
            with self._catalogue.transaction() as rows:
                row = rows.execute('SELECT data FROM chips WHERE seq = ?', (chip.seq,)).fetchone()
            if row is not None and row[0] is not None:
                yield chip, row[0]

    def revalue(self, chips: ChipFilter, factor: float, addend: float) -> int:
        """Change the value of waiting chips to `value * factor + addend`; return how many."""

        def change(rows: sqlite3.Cursor, books: Books, old: Sequence[StoredChip]) -> int:
            revalued = [_revalued(chip, factor, addend) for chip in old if chip.is_intact()]
            ObjectViews(rows, books).change(revalued)
            return len(revalued)

        return self._change_waiting(chips, change)

    def delete(self, chips: ChipFilter) -> int:
        """Delete waiting chips, and count them as evicted; return how many."""

        def change(rows: sqlite3.Cursor, books: Books, old: Sequence[StoredChip]) -> int:
            rows.executemany('DELETE FROM chips WHERE seq = ?', [(chip.seq,) for chip in old])
            ObjectViews(rows, books).remove(chip.object for chip in old)
            deleted = books.take(ChipState.WAITING, [chip.bytes for chip in old])
            books.count('evicted.deleted', deleted)
            return deleted

        return self._change_waiting(chips, change)

    def forget_outbox(self) -> int:
        """Count the chips in the outbox as evicted, and accept any outbox; return how many."""
        with self._booking() as (rows, books):
            rows.execute(
                'DELETE FROM chips WHERE state = ? RETURNING bytes, object', (ChipState.RELEASED,)
            )
            chips = rows.fetchall()
            lost = books.take(ChipState.RELEASED, [size for size, _ in chips])
            ObjectViews(rows, books).take_back(key for _, key in chips)
            books.count('evicted.outbox_lost', lost)
            books.outbox = ''
        return lost

    def integrity(self) -> list[str]:
        """Check the structure of the catalogue; list what is wrong."""
        with self._catalogue.transaction() as rows:
            return [text for (text,) in rows.execute('PRAGMA integrity_check') if text != 'ok']

    def _change_waiting(self, chips: ChipFilter, change: _Change) -> int:
        """Change waiting chips, in several transactions; return how many were changed."""
        where, conditions = chips.sql()
        changed, last = 0, 0
        while True:
            with self._booking() as (rows, books):
                rows.execute(
                    f'SELECT {COLUMNS} FROM chips WHERE state = ? AND seq > ? AND {where} '
                    'ORDER BY seq LIMIT ?',
                    (ChipState.WAITING, last, *conditions, _PIECE),
                )
                old = [StoredChip(*row) for row in rows.fetchall()]
                changed += change(rows, books, old)
            if not old:
                return changed
            last = old[-1].seq


def _revalued(chip: StoredChip, factor: float, addend: float) -> StoredChip:
    """Return a chip with another value."""
    # JSON has no infinite numbers.
    limit = sys.float_info.max
    value = max(min(chip.value * factor + addend, limit), -limit)
    return chip.revalued(value)
