# SPDX-License-Identifier: Apache-2.0
"""The releaser of a spool: it claims chips and writes down what becomes of them."""

from __future__ import annotations

import sqlite3
from collections.abc import Collection
from enum import Enum
from typing import NamedTuple

from obbhbb_ros.spool.books import SpoolAccess
from obbhbb_ros.spool.books import book
from obbhbb_ros.spool.books import deliver
from obbhbb_ros.spool.books import number
from obbhbb_ros.spool.catalogue import SpoolError
from obbhbb_ros.spool.chip_rows import COLUMNS
from obbhbb_ros.spool.chip_rows import ChipState
from obbhbb_ros.spool.chip_rows import StoredChip

# Maximum bytes of id and value in a JSON file.
_JSON_ROOM = 128
# Bytes that a chip costs on the link: its file and its JSON.
_COST = f'(bytes + length(CAST(facts AS BLOB)) + {_JSON_ROOM})'


class Stall(Enum):
    """Why no chip, or no further one, was claimed."""

    NOTHING_WAITS = 'nothing waits'
    ALL_TOO_LARGE = 'all chips that wait are too large'
    NO_ROOM = 'the next chip has no room'


class Claim(NamedTuple):
    """
    The chips that were claimed.

    Attributes
    ----------
    chips : list of (StoredChip, bytes)
        Chips and their files, the most valuable first, the oldest of equals first.
    stall : Stall or None
        Why there are no more; None if as many as asked for, or all, were claimed.
    missing : int
        Bytes of the next chip if it has no room, else 0.
    """

    chips: list[tuple[StoredChip, bytes]]
    stall: Stall | None = None
    missing: int = 0


class SpoolReleaser(SpoolAccess):
    """
    Takes chips out of a spool; a spool has one releaser at a time, others get a `SpoolError`.

    The parameters are those of `SpoolAccess`.
    """

    def claim(
        self, count: int, room: float, max_cost: float, overhead: int, is_resumed: bool = False
    ) -> Claim:
        """
        Claim the next chips; a claimed chip is not evicted.

        Parameters
        ----------
        count : int
            Maximum number of chips.
        room : float
            Maximum bytes of all of them.
        max_cost : float
            Maximum bytes of one chip; larger ones are passed over.
        overhead : int
            Bytes that a chip costs besides its file and JSON.
        is_resumed : bool
            Whether chips that are claimed already come first.

        Returns
        -------
        Claim
            The chips, and why there are no more.
        """
        with self._catalogue.transaction(write=True) as rows:
            states = [ChipState.CLAIMED, ChipState.WAITING] if is_resumed else [ChipState.WAITING]
            claim = _next_chips(rows, states, count, room, max_cost, overhead)
            rows.executemany(
                'UPDATE chips SET state = ? WHERE seq = ?',
                [(ChipState.CLAIMED, chip.seq) for chip, _ in claim.chips],
            )
            if claim.chips or claim.stall:
                return claim
            waiting = number(rows, 'SELECT sum(chips) FROM totals WHERE state <= ?', max(states))
            return Claim([], Stall.ALL_TOO_LARGE if waiting else Stall.NOTHING_WAITS)

    def unclaim(self, ids: Collection[str]) -> None:
        """Put claimed chips back into their place."""
        if ids:
            with self._catalogue.transaction(write=True) as rows:
                rows.executemany(
                    'UPDATE chips SET state = ? WHERE id = ? AND state = ?',
                    [(ChipState.WAITING, chip_id, ChipState.CLAIMED) for chip_id in ids],
                )

    def released(self, ids: Collection[str], is_delivered: bool) -> None:
        """Write down that claimed chips are in the outbox, and whether that delivers them."""
        if ids:
            with self._catalogue.transaction(write=True) as rows:
                # The outbox has the file now.
                rows.executemany(
                    'UPDATE chips SET state = ?, data = NULL WHERE id = ? AND state = ?',
                    [(ChipState.RELEASED, chip_id, ChipState.CLAIMED) for chip_id in ids],
                )
                book(rows, 'released', rows.rowcount)
                if is_delivered:
                    deliver(rows, ids)

    def delivered(self, ids: Collection[str]) -> None:
        """Write down that the bus has taken chips from the outbox."""
        if ids:
            with self._catalogue.transaction(write=True) as rows:
                deliver(rows, ids)

    def evict_damaged(self, chip_id: str) -> None:
        """Delete a chip whose file or description is damaged, and count it as evicted."""
        with self._catalogue.transaction(write=True) as rows:
            rows.execute('DELETE FROM chips WHERE id = ?', (chip_id,))
            book(rows, 'evicted.damaged', rows.rowcount)

    def ids(self, state: int) -> set[str]:
        """Return the ids of the chips in a state."""
        with self._catalogue.transaction() as rows:
            ids = rows.execute('SELECT id FROM chips WHERE state = ?', (state,))
            return {chip_id for (chip_id,) in ids}

    def outbox(self) -> str:
        """Return the token of the outbox that chips are released into; empty before the first."""
        with self._catalogue.transaction() as rows:
            row = rows.execute("SELECT text FROM notes WHERE name = 'outbox'").fetchone()
        return row[0] if row else ''

    def set_outbox(self, token: str) -> None:
        """Write down which outbox chips are released into."""
        with self._catalogue.transaction(write=True) as rows:
            rows.execute("REPLACE INTO notes VALUES ('outbox', ?)", (token,))

    def _on_open(self, rows: sqlite3.Cursor) -> None:
        """Refuse to be a second releaser."""
        if not self._catalogue.lock('releaser'):
            raise SpoolError(
                f'{self._folder}: another process releases this spool; each chain needs its own '
                'spool.path and outbox.path'
            )


def _next_chips(
    rows: sqlite3.Cursor, states: list[int], count: int, room: float, max_cost: float, overhead: int
) -> Claim:
    """Read the next chips that have room, state by state; the first that has none ends it."""
    chips: list[tuple[StoredChip, bytes]] = []
    for state in states:
        for cost, data, *fields in rows.execute(
            f'SELECT {_COST} + ? AS cost, data, {COLUMNS} FROM chips '
            'WHERE state = ? AND cost <= ? ORDER BY value DESC, seq LIMIT ?',
            (overhead, state, max_cost, count - len(chips)),
        ):
            if cost > room:
                return Claim(chips, Stall.NO_ROOM, cost)
            room -= cost
            chips.append((StoredChip(*fields), data))
    return Claim(chips)
