# SPDX-License-Identifier: Apache-2.0
"""What every user of a spool can do."""

from __future__ import annotations

import sqlite3
from collections.abc import Callable
from collections.abc import Iterator
from contextlib import AbstractContextManager
from contextlib import contextmanager
from pathlib import Path

from obbhbb_ros.spool.books import Books
from obbhbb_ros.spool.books import Status
from obbhbb_ros.spool.books import number
from obbhbb_ros.spool.catalogue import Catalogue
from obbhbb_ros.spool.order import last_in_order
from obbhbb_ros.spool.schema import SCHEMA


@contextmanager
def booking(
    catalogue: Catalogue, on_trouble: Callable[[str], object]
) -> Iterator[tuple[sqlite3.Cursor, Books]]:
    """Run a `with` block as one transaction that may change a catalogue and its books."""

    def report_restored() -> None:
        on_trouble(f'{catalogue.folder}: damaged books were restored from their copy')

    with catalogue.transaction(write=True) as rows:
        books = Books.read(rows, report_restored)
        yield rows, books
        books.write(rows)


class SpoolAccess:
    """
    What every user of a spool can do; the base of writer, releaser and console.

    The spool is opened by the first call that needs it. Only one thread at a time may use it.
    Methods raise `SpoolError` if the spool cannot be used now, because the disk is full for
    example; the next call tries again.

    Parameters
    ----------
    folder : Path
        Folder of the spool; created if it is missing.
    on_trouble : callable
        Called with a text about anything that an operator should know but that raises no error.

    Attributes
    ----------
    folder : Path
        Folder of the spool.
    """

    # Seconds to wait for another process.
    _patience = 5.0

    def __init__(self, folder: Path, on_trouble: Callable[[str], object]) -> None:
        self.folder, self._on_trouble = Path(folder), on_trouble
        self._catalogue = Catalogue(self.folder, SCHEMA, on_trouble, self._on_open, self._patience)

    def status(self) -> Status:
        """Read the books."""
        with self._catalogue.transaction() as rows:
            books = Books.read(rows)
            last = last_in_order(rows, books.fade)
            waiting, claimed, released = books.held
            return Status(
                waiting=waiting[0] + claimed[0],
                waiting_bytes=waiting[1] + claimed[1],
                in_outbox=released[0],
                in_work=books.in_work(),
                file_bytes=number(rows, 'PRAGMA page_count') * number(rows, 'PRAGMA page_size'),
                set_aside=self._catalogue.set_aside,
                least_rank=last[1] if last else None,
                fade=books.fade,
                objects_waiting=books.objects,
                counts=dict(books.counts),
            )

    def close(self) -> None:
        """Close the catalogue and release the locks; the next call opens it again."""
        self._catalogue.close()

    def _booking(self) -> AbstractContextManager[tuple[sqlite3.Cursor, Books]]:
        """Run a `with` block as one transaction that may change chips and books."""
        return booking(self._catalogue, self._on_trouble)

    def _on_open(self, rows: sqlite3.Cursor) -> None:
        """Prepare a catalogue that has just been opened."""
