# SPDX-License-Identifier: Apache-2.0
"""The writer of a spool: it plans frames and stores their chips."""

from __future__ import annotations

import itertools
import sqlite3
from collections import Counter
from collections.abc import Callable
from collections.abc import Iterator
from collections.abc import Mapping
from collections.abc import Sequence
from contextlib import contextmanager
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

from obbhbb_ros.spool.access import SpoolAccess
from obbhbb_ros.spool.books import Books
from obbhbb_ros.spool.catalogue import SpoolDamagedError
from obbhbb_ros.spool.catalogue import SpoolError
from obbhbb_ros.spool.chip_rows import INSERT
from obbhbb_ros.spool.chip_rows import ChipState
from obbhbb_ros.spool.chip_rows import NewChip
from obbhbb_ros.spool.eviction import evict
from obbhbb_ros.spool.views import ObjectViews


class FrameTicket(NamedTuple):
    """
    A frame in work.

    Attributes
    ----------
    catalogue : str
        Tag of the catalogue that it was planned in; empty if it could not be written down.
    number : int
        Its row there.
    chips : int
        How many chips it has.
    """

    catalogue: str
    number: int
    chips: int

    def part(self, chips: int) -> FrameTicket:
        """Return the ticket for some of its chips, which can be stored before the rest."""
        return self._replace(chips=chips)


class SpoolWriter(SpoolAccess):
    """
    Stores chips in a spool; any number of processes may do so at once.

    `plan` and `store` raise nothing: what they cannot write down they report, keep in memory, and
    write down as soon as that is possible again.

    Parameters
    ----------
    folder : Path
        Folder of the spool; created if it is missing.
    on_trouble : callable
        Called with a text about everything that an operator should know.

    Examples
    --------
    >>> import tempfile
    >>> chip = NewChip(0.9, 'ship', (5, 0), {'codec': 'jpeg'}, b'...')
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     writer = SpoolWriter(Path(folder), on_trouble=print)
    ...     is_stored = writer.store(writer.plan(2), [chip], {'encoder_failed': 1})
    ...     status = writer.status()
    ...     writer.close()
    >>> is_stored, status.waiting, status.counts['planned']
    (True, 1, 2)
    >>> status.counts['refused.encoder_failed']
    1
    """

    # A frame may be late by this much.
    _patience = 0.8

    def __init__(self, folder: Path, on_trouble: Callable[[str], object]) -> None:
        super().__init__(folder, on_trouble)
        self._number = 0
        # Still to be written down: frames to close, and additions to the books.
        self._open_frames: list[FrameTicket] = []
        self._unbooked: Counter[str] = Counter()
        # The fade to set; None if it has been set.
        self._fade: float | None = None
        self._fade_due: float | None = None
        self._on_fade: Callable[[float], object] = lambda before: None

    def set_fade(self, fade: float, on_change: Callable[[float], object] | None = None) -> None:
        """
        Set how much less repeated views of a ship count, for all users of the spool.

        The last one who sets it counts; it is written down with what comes next.

        Parameters
        ----------
        fade : float
            Factor for each better view, 0 to 1.
        on_change : callable, optional
            Called with the fade that was in force, if it was another.
        """
        self._fade = self._fade_due = fade
        if on_change is not None:
            self._on_fade = on_change

    def plan(self, chips: int) -> FrameTicket:
        """Write down that a frame with some chips is in work."""
        try:
            with self._booking() as (_, books):
                books.count('planned', chips)
                number = books.open_frame(self._number, chips)
            return FrameTicket(self._catalogue.tag, number, chips)
        except SpoolError as error:
            self._on_trouble(str(error))
            return FrameTicket('', 0, chips)

    def store(
        self,
        ticket: FrameTicket,
        chips: Sequence[NewChip],
        refused: Mapping[str, int],
        max_bytes: float = 0.0,
    ) -> bool:
        """
        Store the chips of a frame, and evict the least valuable ones if there is no room.

        Parameters
        ----------
        ticket : FrameTicket
            From `plan`, or a part of it. The frame is in work until all of its chips are stored.
        chips : sequence of NewChip
            Its chips.
        refused : mapping of str to int
            How many of its chips are not stored, by reason; together with `chips` all of them.
        max_bytes : float
            Maximum size of the catalogue, bytes (0: unlimited).

        Returns
        -------
        bool
            Whether they are stored; if not, all chips are refused, as `spool_failed`.
        """
        try:
            try:
                self._store(ticket, chips, refused, max_bytes)
            except SpoolDamagedError as error:
                self._on_trouble(str(error))
                # Into a new catalogue.
                self._store(ticket, chips, refused, max_bytes)
            return True
        except SpoolError as error:
            self._on_trouble(str(error))
            if ticket.catalogue:
                self._open_frames.append(ticket)
            else:
                self._unbooked['planned'] += ticket.chips
            self._unbooked['refused.spool_failed'] += len(chips)
            self._unbooked.update({f'refused.{reason}': n for reason, n in refused.items()})
            return False

    def catch_up(self) -> None:
        """Write down what could not be written down before, if there is anything."""
        if self._open_frames or self._unbooked or self._fade_due is not None:
            with suppress(SpoolError), self._booking():
                pass

    def close(self) -> None:
        """Write down what is left, close the catalogue and release the locks."""
        self.catch_up()
        super().close()

    @contextmanager
    def _booking(self) -> Iterator[tuple[sqlite3.Cursor, Books]]:
        """Begin a transaction with what could not be written down before."""
        with super()._booking() as (rows, books):
            for ticket in self._open_frames:
                self._close_frame(books, ticket)
            for name, count in self._unbooked.items():
                books.count(name, count)
            before = books.fade
            if self._fade_due is not None:
                books.fade = self._fade_due
            yield rows, books
        self._open_frames.clear()
        self._unbooked.clear()
        self._fade_due = None
        if before != books.fade:
            self._on_fade(before)

    def _store(
        self,
        ticket: FrameTicket,
        chips: Sequence[NewChip],
        refused: Mapping[str, int],
        max_bytes: float,
    ) -> None:
        """Close a frame, insert its chips and make room."""
        with self._booking() as (rows, books):
            self._close_frame(books, ticket)
            for reason, count in refused.items():
                books.count(f'refused.{reason}', count)
            first = books.last_seq + 1
            views = ObjectViews(rows, books)
            stored = [chip.stored(first + i, self._catalogue.tag) for i, chip in enumerate(chips)]
            rows.executemany(
                INSERT,
                [
                    (*admitted, chip.data)
                    for admitted, chip in zip(views.admit(stored), chips, strict=True)
                ],
            )
            books.last_seq += books.put(ChipState.WAITING, [len(chip.data) for chip in chips])
            views.forget(max_bytes)
            if max_bytes and not evict(rows, books, max_bytes):
                self._on_trouble(
                    f'{self.folder} is larger than spool.max_bytes, {max_bytes:.0f}, and no chip '
                    'is left to evict; chips are evicted as they come'
                )

    def _close_frame(self, books: Books, ticket: FrameTicket) -> None:
        """Take chips off their frame; if it was planned in another catalogue, plan them here."""
        if ticket.catalogue != self._catalogue.tag:
            books.count('planned', ticket.chips)
        elif not books.take_off_frame(ticket.number, ticket.chips):
            # Another writer has closed it, as the frame of a process that had ended.
            books.count('refused.interrupted', -ticket.chips)

    def _on_open(self, rows: sqlite3.Cursor) -> None:
        """Take the first free number of a writer, and refuse the frames of writers that ended."""
        # It may be a new catalogue.
        self._fade_due = self._fade
        books = Books.read(rows)
        last = max((writer for writer, _ in books.frames.values()), default=0)
        free = []
        for writer in itertools.count():
            if self._catalogue.lock(f'writer_{writer}'):
                books.close_frames_of(writer)
                free.append(writer)
            if free and writer >= last:
                break
        self._number = free[0]
        books.write(rows)
