# SPDX-License-Identifier: Apache-2.0
"""
Chips in the order of their rank, by an index on k and worth.

For each k that order is the one of the index; so the next chip is the first of four, the one to be
evicted the last of four, and another fade changes no row. Of equal ranks the greater worth goes
first, then the older chip.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator
from collections.abc import Sequence
from functools import lru_cache
from heapq import merge
from operator import itemgetter
from typing import Any

from obbhbb_ros.spool.chip_rows import COLUMNS
from obbhbb_ros.spool.chip_rows import ChipState
from obbhbb_ros.spool.chip_rows import StoredChip
from obbhbb_ros.spool.ranking import MAX_K

# Damage may have turned k into anything: no chip must be missed.
_CLASSES = (*((f'k = {k}', k) for k in range(MAX_K + 1)), (f'k > {MAX_K}', MAX_K), ('k < 0', MAX_K))


_PLACE = itemgetter(0, 1, 2)


def in_order(
    rows: sqlite3.Cursor,
    fade: float,
    state: str,
    condition: str = 'TRUE',
    values: Sequence[object] = (),
) -> Iterator[StoredChip]:
    """
    Yield chips in the order of their rank.

    Parameters
    ----------
    rows : sqlite3.Cursor
        Of the transaction.
    fade : float
        The fade in force.
    state : str
        Condition on the state, SQL.
    condition : str
        Condition on the chips, SQL.
    values : sequence
        Values of the question marks in it.

    Yields
    ------
    StoredChip
        The chips, with the k by which they have their place.
    """

    def of_class(which: str, k: int) -> Iterator[tuple[Any, ...]]:
        columns = COLUMNS.replace(' k,', f' {k} AS k,')
        yield from rows.connection.execute(
            f'SELECT -{_rank(k, fade)}, -ifnull(CAST(worth AS REAL), 0.0), seq, {columns} '
            f'FROM chips WHERE {state} AND {which} AND {condition} ORDER BY worth DESC, seq',
            values,
        )

    for _, _, _, *fields in merge(*(of_class(*each) for each in _CLASSES), key=_PLACE):
        yield StoredChip(*fields)


def last_in_order(rows: sqlite3.Cursor, fade: float) -> tuple[int, float] | None:
    """Return number and rank of the waiting chip that a full spool evicts first."""
    last: tuple[int, float] | None = rows.execute(_last_query(fade)).fetchone()
    return last


@lru_cache(maxsize=4)
def _last_query(fade: float) -> str:
    """Return SQL for number and rank of the last chip."""

    def of_class(which: str, k: int) -> str:
        waiting = f'FROM chips WHERE state = {ChipState.WAITING} AND {which}'
        # Two queries, both answered by the index: the least worth, and the oldest chip of it.
        return (
            f'SELECT * FROM (SELECT {_rank(k, fade)} AS rank, worth, seq {waiting} AND worth IS '
            f'(SELECT worth {waiting} ORDER BY worth LIMIT 1) ORDER BY seq LIMIT 1)'
        )

    classes = ' UNION ALL '.join(of_class(*each) for each in _CLASSES)
    return f'SELECT seq, rank FROM ({classes}) ORDER BY rank, worth, seq LIMIT 1'


def _rank(k: int, fade: float) -> str:
    """Return SQL for the rank of a chip, whatever damage has made of its worth."""
    rank = f'CASE WHEN worth > 0.0 THEN worth * {float(fade**k)!r} ELSE worth END'
    return f'ifnull(CAST({rank} AS REAL), 0.0)'
