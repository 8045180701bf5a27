# SPDX-License-Identifier: Apache-2.0
"""The operator's view of a spool: what waits in it, and changes to that."""

from __future__ import annotations

import math
import sys
from collections.abc import Iterable
from collections.abc import Iterator
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from obbhbb_ros.spool.books import SpoolAccess
from obbhbb_ros.spool.books import book
from obbhbb_ros.spool.chip_rows import COLUMNS
from obbhbb_ros.spool.chip_rows import ChipState
from obbhbb_ros.spool.chip_rows import StoredChip

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

    def matches(self, chip: StoredChip) -> bool:
        """Return whether a chip is meant."""
        return (
            self.min_value <= chip.value <= self.max_value
            and (not self.class_ids or chip.class_id in self.class_ids)
            and (not self.ids or chip.id in self.ids)
        )

    def sql(self) -> tuple[str, list[Any]]:
        """Return the same conditions for a catalogue: SQL and its values."""
        clauses = ['value BETWEEN ? AND ?']
        values: list[Any] = [self.min_value, self.max_value]
        for column, texts in (('class_id', self.class_ids), ('id', self.ids)):
            if texts:
                clauses.append(f'{column} IN ({", ".join("?" * len(texts))})')
                values += texts
        return ' AND '.join(clauses), values


ANY_CHIP = ChipFilter()


class SpoolConsole(SpoolAccess):
    """Lists, revalues and deletes the chips of a spool while others write and release."""

    def select(self, chips: ChipFilter = ANY_CHIP, limit: int = -1) -> list[StoredChip]:
        """List chips in the order of their release, by state; a negative limit means none."""
        where, values = chips.sql()
        with self._catalogue.transaction() as rows:
            return [
                StoredChip(*row)
                for row in rows.execute(
                    f'SELECT {COLUMNS} FROM chips WHERE {where} ORDER BY state, value DESC, seq '
                    'LIMIT ?',
                    (*values, limit),
                )
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
        return self._change_waiting(
            chips,
            'UPDATE chips SET value = max(min(value * ? + ?, ?), ?) WHERE seq = ?',
            # JSON has no infinite numbers.
            (factor, addend, sys.float_info.max, -sys.float_info.max),
        )

    def delete(self, chips: ChipFilter) -> int:
        """Delete waiting chips, and count them as evicted; return how many."""
        return self._change_waiting(
            chips, 'DELETE FROM chips WHERE seq = ?', booked_as='evicted.deleted'
        )

    def forget_outbox(self) -> int:
        """Count the chips in the outbox as evicted, and accept any outbox; return how many."""
        with self._catalogue.transaction(write=True) as rows:
            rows.execute('DELETE FROM chips WHERE state = ?', (ChipState.RELEASED,))
            lost = rows.rowcount
            book(rows, 'evicted.outbox_lost', lost)
            rows.execute("DELETE FROM notes WHERE name = 'outbox'")
        return lost

    def integrity(self) -> list[str]:
        """Check the structure of the catalogue; list what is wrong."""
        with self._catalogue.transaction() as rows:
            return [text for (text,) in rows.execute('PRAGMA integrity_check') if text != 'ok']

    def _change_waiting(
        self, chips: ChipFilter, change: str, values: Sequence[Any] = (), booked_as: str = ''
    ) -> int:
        """Apply a statement to waiting chips, in several transactions; return to how many."""
        where, conditions = chips.sql()
        changed, seqs = 0, [0]
        while seqs:
            with self._catalogue.transaction(write=True) as rows:
                seqs = [
                    seq
                    for (seq,) in rows.execute(
                        f'SELECT seq FROM chips WHERE state = ? AND seq > ? AND {where} '
                        'ORDER BY seq LIMIT ?',
                        (ChipState.WAITING, seqs[-1], *conditions, _PIECE),
                    )
                ]
                rows.executemany(change, [(*values, seq) for seq in seqs])
                if booked_as:
                    book(rows, booked_as, len(seqs))
            changed += len(seqs)
        return changed
