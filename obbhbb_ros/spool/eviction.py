# SPDX-License-Identifier: Apache-2.0
"""What a full spool gives up."""

from __future__ import annotations

import sqlite3

from obbhbb_ros.spool.books import Books
from obbhbb_ros.spool.books import number
from obbhbb_ros.spool.chip_rows import ChipState
from obbhbb_ros.spool.order import last_in_order
from obbhbb_ros.spool.views import ObjectViews

# Chips to evict, and free pages to give back to the disk, in one transaction; a lowered limit is
# reached in several.
_MAX_EVICTED = _MAX_PAGES_GIVEN_BACK = 1000
# The file may be larger than its limit by this factor.
_SLACK = 1.1


def evict(rows: sqlite3.Cursor, books: Books, max_bytes: float) -> bool:
    """
    Delete the chips of the lowest rank, the oldest of equals first, to make room for the rest.

    Returns False if there is still no room when all waiting chips are gone.
    """
    views = ObjectViews(rows, books)
    max_pages, is_left = max_bytes / number(rows, 'PRAGMA page_size'), True
    sizes: list[int] = []
    while is_left and len(sizes) < _MAX_EVICTED and _used_pages(rows) > max_pages:
        last = last_in_order(rows, books.fade)
        is_left = last is not None
        if last is not None:
            rows.execute('DELETE FROM chips WHERE seq = ? RETURNING bytes, object, k', last[:1])
            for size, key, k in rows.fetchall():
                sizes.append(size)
                views.remove([key], k)
    books.count('evicted.max_bytes', books.take(ChipState.WAITING, sizes))
    # Free pages are used again; only those far beyond a lowered limit go back to the disk.
    excess = number(rows, 'PRAGMA page_count') - int(_SLACK * max_pages)
    for _ in range(min(excess, number(rows, 'PRAGMA freelist_count'), _MAX_PAGES_GIVEN_BACK)):
        # One by one: Python takes one step of a statement that returns no rows.
        rows.execute('PRAGMA incremental_vacuum(1)')
    return is_left


def _used_pages(rows: sqlite3.Cursor) -> int:
    """Count the pages of a catalogue that are not free."""
    return number(rows, 'PRAGMA page_count') - number(rows, 'PRAGMA freelist_count')
