# SPDX-License-Identifier: Apache-2.0
"""The releaser of a spool: it claims chips and writes down what becomes of them."""

from __future__ import annotations

import sqlite3
from collections.abc import Collection
from collections.abc import Iterator
from contextlib import suppress
from enum import Enum
from itertools import islice
from typing import Any
from typing import NamedTuple

from obbhbb_ros.spool.access import SpoolAccess
from obbhbb_ros.spool.books import Books
from obbhbb_ros.spool.books import number
from obbhbb_ros.spool.catalogue import SpoolError
from obbhbb_ros.spool.chip_rows import COLUMNS
from obbhbb_ros.spool.chip_rows import ChipState
from obbhbb_ros.spool.chip_rows import StoredChip
from obbhbb_ros.spool.chip_rows import chips_of
from obbhbb_ros.spool.chip_rows import number_of
from obbhbb_ros.spool.compact_json import compact_cost
from obbhbb_ros.spool.order import in_order
from obbhbb_ros.spool.views import ObjectViews

# Maximum bytes of id, value, rank, view and digest in a JSON file.
_JSON_ROOM = 192
# Bytes that a chip costs on the link: its file and its JSON. A damaged chip costs nothing: it is
# claimed, and evicted.
_COST = f'ifnull(bytes + length(CAST(facts AS BLOB)) + {_JSON_ROOM}, 0)'
# JSON cannot make it less.
_LEAST_COST = 'ifnull(bytes + 0, 0)'


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
        Chips and their files, by their rank, the oldest of equals first.
    fade : float
        The fade by which they have their rank.
    stall : Stall or None
        Why there are no more; None if as many as asked for, or all, were claimed.
    missing : int
        Bytes of the next chip if it has no room, else 0.
    """

    chips: list[tuple[StoredChip, bytes]]
    fade: float
    stall: Stall | None = None
    missing: int = 0


class SpoolReleaser(SpoolAccess):
    """
    Takes chips out of a spool; a spool has one releaser at a time, others get a `SpoolError`.

    The parameters are those of `SpoolAccess`.
    """

    def claim(
        self,
        count: int,
        room: float,
        max_cost: float,
        overhead: int,
        is_resumed: bool = False,
        is_compact: bool = False,
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
        is_compact : bool
            Whether the JSON will be a compact one.

        Returns
        -------
        Claim
            The chips, and why there are no more.
        """
        with self._booking() as (rows, books):
            states = [ChipState.CLAIMED, ChipState.WAITING] if is_resumed else [ChipState.WAITING]
            chips_left = _chips_up_to(rows, books.fade, states, max_cost - overhead, is_compact)
            claim = _next_chips(chips_left, books.fade, count, room, overhead)
            chips = ObjectViews(rows, books).counted([chip for chip, _ in claim.chips])
            for chip in chips:
                books.take(chip.state, [chip.bytes])
                books.put(ChipState.CLAIMED, [chip.bytes])
            rows.executemany(
                'UPDATE chips SET state = ?, view = ?, digest = ? WHERE seq = ?',
                [(ChipState.CLAIMED, chip.view, chip.digest, chip.seq) for chip in chips],
            )
            if claim.stall or chips:
                files = [data for _, data in claim.chips]
                return claim._replace(chips=list(zip(chips, files, strict=True)))
            waiting = sum(books.held[state][0] for state in states)
            in_states = f'FROM chips WHERE state IN ({", ".join("?" * len(states))})'
            if waiting and not number(rows, f'SELECT EXISTS (SELECT 1 {in_states})', *states):
                raise sqlite3.DatabaseError('chips that wait are not in its index')
            return claim._replace(stall=Stall.ALL_TOO_LARGE if waiting else Stall.NOTHING_WAITS)

    def unclaim(self, ids: Collection[str]) -> None:
        """Put claimed chips back into their place."""
        if ids:
            with self._booking() as (rows, books):
                chips = chips_of(rows, ids, ChipState.CLAIMED)
                back = [
                    chip._replace(view=None).with_digest() if chip.is_intact() else chip
                    for chip in chips
                ]
                rows.executemany(
                    'UPDATE chips SET state = ?, view = ?, digest = ? WHERE seq = ?',
                    [(ChipState.WAITING, chip.view, chip.digest, chip.seq) for chip in back],
                )
                sizes = [chip.bytes for chip in chips]
                books.take(ChipState.CLAIMED, sizes)
                books.put(ChipState.WAITING, sizes)

    def released(self, ids: Collection[str], is_delivered: bool) -> None:
        """Write down that claimed chips are in the outbox, and whether that delivers them."""
        if ids:
            with self._booking() as (rows, books):
                chips = chips_of(rows, ids, ChipState.CLAIMED)
                rows.executemany(
                    # The outbox has the file now.
                    'UPDATE chips SET state = ?, data = NULL WHERE seq = ?',
                    [(ChipState.RELEASED, chip.seq) for chip in chips],
                )
                ObjectViews(rows, books).release(chip.object for chip in chips)
                sizes = [chip.bytes for chip in chips]
                books.take(ChipState.CLAIMED, sizes)
                books.count('released', books.put(ChipState.RELEASED, sizes))
                if is_delivered:
                    self._deliver(rows, books, ids)

    def delivered(self, ids: Collection[str]) -> None:
        """Write down that the bus has taken chips from the outbox."""
        if ids:
            with self._booking() as (rows, books):
                self._deliver(rows, books, ids)

    def evict_damaged(self, chip: StoredChip) -> None:
        """Delete a claimed chip whose file or description is damaged; count it as evicted."""
        with self._booking() as (rows, books):
            # Its id may be damaged as well.
            rows.execute(
                'DELETE FROM chips WHERE seq = ? AND id IS ? AND state = ? RETURNING bytes, object',
                (chip.seq, chip.id, ChipState.CLAIMED),
            )
            for size, key in rows.fetchall():
                books.count('evicted.damaged', books.take(ChipState.CLAIMED, [size]))
                ObjectViews(rows, books).remove([key])

    def ids(self, state: int) -> set[str]:
        """Return the ids of the chips in a state."""
        with self._catalogue.transaction() as rows:
            rows.execute('SELECT id FROM chips WHERE state = ?', (state,))
            ids = [chip_id for (chip_id,) in rows.fetchall()]
            if len(ids) < Books.read(rows).held[state][0]:
                raise sqlite3.DatabaseError('chips are not in its index')
            return set(ids)

    def outbox(self) -> str:
        """Return the token of the outbox that chips are released into; empty before the first."""
        with self._catalogue.transaction() as rows:
            return Books.read(rows).outbox

    def set_outbox(self, token: str) -> None:
        """Write down which outbox chips are released into."""
        with self._booking() as (_, books):
            books.outbox = token

    def _deliver(self, rows: sqlite3.Cursor, books: Books, ids: Collection[str]) -> None:
        """Count released chips as delivered and delete them; report those that are damaged."""
        for chip_id in ids:
            for chip in _take_released(rows, chip_id):
                books.take(ChipState.RELEASED, [chip.bytes])
                # Nobody knows what became of a chip with another id.
                if chip.is_intact():
                    books.count('delivered', 1)
                    books.count('delivered_bytes', chip.bytes)
                else:
                    books.count('evicted.damaged', 1)
                    self._on_trouble(
                        f'the record of {chip_id} in the spool is damaged: the chip left the '
                        'outbox, but does not count as delivered'
                    )

    def _on_open(self, rows: sqlite3.Cursor) -> None:
        """Refuse to be a second releaser."""
        if not self._catalogue.lock('releaser'):
            raise SpoolError(
                f'{self.folder}: another process releases this spool; each chain needs its own '
                'spool.path and outbox.path'
            )


def _take_released(rows: sqlite3.Cursor, chip_id: str) -> list[StoredChip]:
    """Delete the released chip of an id from the catalogue, and return it."""
    taken: list[tuple[Any, ...]] = []
    # The condition without the number finds it if its id is damaged.
    for condition, values in (
        ('seq = ? AND id = ?', (number_of(chip_id), chip_id)),
        ('id IS ?', (chip_id,)),
    ):
        if not taken:
            rows.execute(
                f'DELETE FROM chips WHERE {condition} AND state = ? RETURNING {COLUMNS}',
                (*values, ChipState.RELEASED),
            )
            taken = rows.fetchall()
    return list(map(StoredChip._make, taken))


def _chips_up_to(
    rows: sqlite3.Cursor, fade: float, states: list[int], max_cost: float, is_compact: bool
) -> Iterator[tuple[StoredChip, bytes, int]]:
    """Yield the next chips up to a cost, with file and cost, state by state."""
    least = _LEAST_COST if is_compact else _COST
    for state in states:
        for chip in in_order(rows, fade, f'state = {state}', f'{least} <= ?', (max_cost,)):
            ((cost, data),) = rows.execute(
                f'SELECT {_COST}, data FROM chips WHERE seq = ?', (chip.seq,)
            )
            if is_compact:
                cost = min(cost, _compact_cost(chip, fade))
            if cost <= max_cost:
                # The state of the row may be damaged; the index found it by this one.
                yield chip._replace(state=state), data, cost


def _compact_cost(chip: StoredChip, fade: float) -> int:
    """Return the bytes that a chip costs with compact JSON; 0 if it is damaged."""
    with suppress(ValueError, TypeError, KeyError, RecursionError):
        return compact_cost(chip.describe(fade))
    return 0


def _next_chips(
    chips: Iterator[tuple[StoredChip, bytes, int]],
    fade: float,
    count: int,
    room: float,
    overhead: int,
) -> Claim:
    """Take the next chips that have room; the first that has none ends it."""
    taken: list[tuple[StoredChip, bytes]] = []
    for chip, data, cost in islice(chips, count):
        if cost + overhead > room:
            return Claim(taken, fade, Stall.NO_ROOM, cost + overhead)
        room -= cost + overhead
        taken.append((chip, data))
    return Claim(taken, fade)
