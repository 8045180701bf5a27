# SPDX-License-Identifier: Apache-2.0
"""
Where ship lists wait for the ground, in a catalogue of their own beside that of the chips.

At most one list waits: the next one takes over its ships in the same transaction. One at most is
claimed: of what waits, as much as the link carries at once; the rest goes on waiting. Every change
is on disk when it ends, so at every instant

    ships added = merged + dropped + damaged + released + waiting + claimed,
    lists claimed = released + damaged + claimed, and
    lists released = delivered + lost with their outbox + in the outbox.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Callable
from collections.abc import Collection
from collections.abc import Iterator
from collections.abc import Mapping
from collections.abc import Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from obbhbb_ros.reports.ship_geojson import ship_geojson
from obbhbb_ros.reports.ship_list import LIST_KIND
from obbhbb_ros.reports.ship_message import MIN_MESSAGE_BYTES
from obbhbb_ros.reports.ship_message import ship_message
from obbhbb_ros.reports.ship_report import MAX_SHIPS
from obbhbb_ros.reports.ship_report import ShipListError
from obbhbb_ros.reports.ship_report import ShipReport
from obbhbb_ros.reports.ship_report import joined_reports
from obbhbb_ros.reports.ship_report import most_valuable
from obbhbb_ros.spool.access import booking
from obbhbb_ros.spool.books import Books
from obbhbb_ros.spool.catalogue import Catalogue
from obbhbb_ros.spool.catalogue import CatalogueSchema
from obbhbb_ros.spool.chip_rows import ChipState
from obbhbb_ros.spool.list_rows import LIST_COLUMNS
from obbhbb_ros.spool.list_rows import LIST_INSERT
from obbhbb_ros.spool.list_rows import LIST_JSON_ROOM
from obbhbb_ros.spool.list_rows import STATES
from obbhbb_ros.spool.list_rows import ShipListFile
from obbhbb_ros.spool.list_rows import StoredList
from obbhbb_ros.spool.schema import BOOKS_SCRIPT
from obbhbb_ros.spool.schema import count_rebuilt

FOLDER = 'lists'
"""Folder of the lists in that of the spool."""
# Seconds to wait for another process; detections wait meanwhile.
_PATIENCE = 0.8
_SCRIPT = f"""
CREATE TABLE lists (
    seq INTEGER PRIMARY KEY,
    state INTEGER NOT NULL,
    ships INTEGER NOT NULL,
    max_bytes INTEGER NOT NULL,
    bytes INTEGER NOT NULL,
    outbox TEXT NOT NULL,
    digest TEXT NOT NULL,
    data BLOB
);
{BOOKS_SCRIPT}
"""


def _from_no_version(rows: sqlite3.Cursor) -> None:
    """Refuse a database of an earlier version: there is none."""
    raise sqlite3.DatabaseError('it has no version')


_SCHEMA = CatalogueSchema(1, _SCRIPT, _from_no_version, count_rebuilt, LIST_KIND)


@dataclass(frozen=True)
class ListStatus:
    """
    The books of the lists at one instant.

    Attributes
    ----------
    ships_waiting, ships_claimed : int
        Ships of the list that waits, and of the one on its way to the outbox.
    in_outbox : int
        Lists in the outbox that the bus has not removed yet.
    set_aside : int
        Damaged catalogues of lists.
    counts : mapping of str to int
        `ships_added`, `ships_merged`, `ships_dropped`, `ships_damaged`, `ships_released`, and of
        lists `claimed`, `released`, `delivered`, `delivered_bytes`, `outbox_lost`, `damaged`.
    """

    ships_waiting: int
    ships_claimed: int
    in_outbox: int
    set_aside: int
    counts: Mapping[str, int]

    @property
    def balance(self) -> int:
        """Number of ships unaccounted for; 0 if the books balance."""
        gone = ('merged', 'dropped', 'damaged', 'released')
        rest = self.counts.get('ships_added', 0) - self.ships_waiting - self.ships_claimed
        return rest - sum(self.counts.get(f'ships_{name}', 0) for name in gone)


class ListSpool:
    """
    Keeps ship lists until they are released; any number of processes may use it at once.

    It is opened by the first call that needs it. Only one thread at a time may use an object.
    Methods raise `SpoolError` if it cannot be used now; the next call tries again.

    Parameters
    ----------
    spool : Path
        Folder of the spool of the chips.
    on_trouble : callable
        Called with a text about anything that an operator should know and that raises no error.

    Examples
    --------
    >>> import tempfile
    >>> tug = ShipReport(
    ...     id='a-1', latitude=36.1, longitude=-5.4, course=12.0, course_ambiguous=True,
    ...     length_m=30.0, width_m=9.0, first=5_000_000_000, last=6_250_000_000,
    ... )
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     lists = ListSpool(Path(folder), on_trouble=print)
    ...     lists.add([tug])
    ...     lists.add([tug])
    ...     status = lists.status()
    ...     lists.close()
    >>> status.ships_waiting, status.counts['ships_merged']
    (1, 1)
    """

    def __init__(self, spool: Path, on_trouble: Callable[[str], object]) -> None:
        self._folder, self._on_trouble = Path(spool) / FOLDER, on_trouble
        self._catalogue = Catalogue(self._folder, _SCHEMA, on_trouble, lambda rows: None, _PATIENCE)

    @property
    def exists(self) -> bool:
        """Whether lists were ever kept there."""
        return self._folder.is_dir()

    def add(self, ships: Sequence[ShipReport], max_bytes: int = 0) -> None:
        """
        Add ships to those that wait, as one list.

        Parameters
        ----------
        ships : sequence of ShipReport
            The ships.
        max_bytes : int
            Maximum size of a message; 0: GeoJSON.
        """
        with self._booking() as (rows, books):
            old: list[ShipReport] = []
            for row in self._rows(rows, ChipState.WAITING):
                old += self._taken(rows, books, row) or ()
            together = _joined(old, ships)
            kept, content = _readable(together)
            books.count('ships_added', len(ships))
            books.count('ships_merged', len(old) + len(ships) - len(together))
            books.count('ships_dropped', len(together) - len(kept))
            if kept:
                self._put(rows, books, ChipState.WAITING, len(kept), max_bytes, content)

    def needed(self, max_size: float) -> int:
        """
        Return what the next list costs at most, file and JSON, bytes; 0 if none waits.

        Parameters
        ----------
        max_size : float
            What it may cost; the ships of a larger list go one part after the other.
        """
        with self._catalogue.transaction() as rows:
            for row in self._rows(rows, ChipState.CLAIMED):
                return _size(row.bytes)
            for row in self._rows(rows, ChipState.WAITING):
                return int(min(_size(row.max_bytes or row.bytes), max_size))
        return 0

    def claim(self, max_size: float) -> ShipListFile | None:
        """
        Claim the next list, or the one that is claimed already.

        Parameters
        ----------
        max_size : float
            Maximum bytes of file and JSON: as many ships as fit, the most valuable first. The rest
            goes on waiting.

        Returns
        -------
        ShipListFile or None
            The list; None if none waits, or no ship has room.
        """
        with self._booking() as (rows, books):
            for row in self._rows(rows, ChipState.CLAIMED):
                if row.read() is not None and row.data is not None:
                    return ShipListFile(self._id_of(row.seq), row.ships, row.data)
                self._drop_damaged(rows, books, row)
            for row in self._rows(rows, ChipState.WAITING):
                max_bytes = min(max_size - LIST_JSON_ROOM, row.max_bytes or max_size)
                ships = self._taken(rows, books, row)
                if not ships:
                    continue
                content, rest = _cut(ships, max_bytes, is_message=bool(row.max_bytes))
                if rest:
                    left = ship_geojson(rest)
                    self._put(rows, books, ChipState.WAITING, len(rest), row.max_bytes, left)
                count = len(ships) - len(rest)
                if not count:
                    return None
                seq = self._put(rows, books, ChipState.CLAIMED, count, row.max_bytes, content)
                books.count('claimed', 1)
                return ShipListFile(self._id_of(seq), count, content)
        return None

    def claimed_id(self) -> str:
        """Return the id of the list that is claimed; empty if none is."""
        with self._catalogue.transaction() as rows:
            return next((self._id_of(row.seq) for row in self._rows(rows, ChipState.CLAIMED)), '')

    def released(self, list_id: str, outbox: str, is_delivered: bool) -> None:
        """Write down that the claimed list is in an outbox, and whether that delivers it."""
        with self._booking() as (rows, books):
            for row in self._rows(rows, ChipState.CLAIMED):
                if self._id_of(row.seq) != list_id:
                    continue
                books.count('released', 1)
                books.count('ships_released', self._take_ships(books, row))
                there = row._replace(state=ChipState.RELEASED, outbox=outbox, data=None)
                rows.execute('DELETE FROM lists WHERE seq = ?', (row.seq,))
                rows.execute(LIST_INSERT, there.with_digest())
                books.put(ChipState.RELEASED, [row.bytes])
                if is_delivered:
                    self._deliver(rows, books, row.seq, 'delivered')

    def in_outbox(self) -> dict[str, str]:
        """Return the ids of the lists that were released, and the tokens of their outboxes."""
        with self._catalogue.transaction() as rows:
            released = self._rows(rows, ChipState.RELEASED)
            return {self._id_of(row.seq): row.outbox for row in released}

    def gone(self, ids: Collection[str], is_delivered: bool) -> None:
        """Write down that the bus has taken lists from the outbox, or that this one is lost."""
        if ids:
            with self._booking() as (rows, books):
                for row in self._rows(rows, ChipState.RELEASED):
                    if self._id_of(row.seq) in ids:
                        name = 'delivered' if is_delivered else 'outbox_lost'
                        self._deliver(rows, books, row.seq, name)

    def status(self) -> ListStatus:
        """Read the books."""
        with self._catalogue.transaction() as rows:
            books = Books.read(rows)
        counts = dict(books.counts)
        return ListStatus(
            ships_waiting=counts.pop(_SHIPS[ChipState.WAITING], 0),
            ships_claimed=counts.pop(_SHIPS[ChipState.CLAIMED], 0),
            in_outbox=books.held[ChipState.RELEASED][0],
            set_aside=self._catalogue.set_aside,
            counts=counts,
        )

    def close(self) -> None:
        """Close the catalogue; the next call opens it again."""
        self._catalogue.close()

    @contextmanager
    def _booking(self) -> Iterator[tuple[sqlite3.Cursor, Books]]:
        """Run a `with` block as one transaction that may change lists and books."""
        with booking(self._catalogue, self._on_trouble) as (rows, books):
            self._recount(books, _mended(rows))
            yield rows, books

    def _recount(self, books: Books, stored: Collection[StoredList]) -> None:
        """Hold the books against the lists that are stored; count and report what damage took."""
        lists = [[row for row in stored if row.state == state] for state in STATES]
        lost = 0
        for state, name in _SHIPS.items():
            ships = sum(row.ships for row in lists[state])
            lost += books.counts.pop(name, 0) - ships
            books.count(name, ships)
        gone = [held[0] - len(there) for held, there in zip(books.held, lists, strict=True)]
        books.held = [[len(there), sum(row.bytes for row in there)] for there in lists]
        books.count('ships_damaged', lost)
        books.count('damaged', gone[ChipState.CLAIMED])
        # It may be in the outbox still, but nothing knows it there any more.
        books.count('outbox_lost', gone[ChipState.RELEASED])
        if lost:
            self._on_trouble(f'{self._folder}: a ship list was damaged; {lost} ships are lost')
        if gone[ChipState.RELEASED]:
            self._on_trouble(
                f'{self._folder}: whether the bus takes {gone[ChipState.RELEASED]} released lists '
                'is not known any more: their rows were damaged'
            )

    def _rows(self, rows: sqlite3.Cursor, state: int) -> list[StoredList]:
        """Read the lists in a state, the oldest first."""
        rows.execute(f'SELECT {LIST_COLUMNS} FROM lists WHERE state = ? ORDER BY seq', (state,))
        return [StoredList(*fields) for fields in rows.fetchall()]

    def _id_of(self, seq: int) -> str:
        """Return the id of a list by its number."""
        return f'{LIST_KIND}_{self._catalogue.tag}_{seq}'

    def _put(
        self,
        rows: sqlite3.Cursor,
        books: Books,
        state: int,
        ships: int,
        max_bytes: int,
        content: bytes,
    ) -> int:
        """Store a list of so many ships; return its number."""
        books.last_seq += 1
        size = len(content)
        row = StoredList(
            books.last_seq, state, ships, max_bytes, size, '', '', content
        ).with_digest()
        rows.execute(LIST_INSERT, row)
        books.put(state, [row.bytes])
        books.count(_SHIPS[state], ships)
        return row.seq

    def _taken(
        self, rows: sqlite3.Cursor, books: Books, row: StoredList
    ) -> list[ShipReport] | None:
        """Take a list that waits out of the catalogue; None if it is damaged."""
        ships = row.read()
        if ships is None:
            self._drop_damaged(rows, books, row)
            return None
        rows.execute('DELETE FROM lists WHERE seq = ?', (row.seq,))
        self._take_ships(books, row)
        return ships

    def _drop_damaged(self, rows: sqlite3.Cursor, books: Books, row: StoredList) -> None:
        """Delete a damaged list, count and report it."""
        rows.execute('DELETE FROM lists WHERE seq = ?', (row.seq,))
        if row.state == ChipState.CLAIMED:
            books.count('damaged', 1)
        lost = self._take_ships(books, row)
        books.count('ships_damaged', lost)
        self._on_trouble(f'{self._folder}: a ship list was damaged; {lost} ships are lost')

    def _take_ships(self, books: Books, row: StoredList) -> int:
        """Take the list of a state out of the books; return how many ships it had."""
        books.take(row.state, [row.bytes])
        # At most one list is in such a state, and its own number may be damaged.
        return books.counts.pop(_SHIPS[row.state], 0)

    def _deliver(self, rows: sqlite3.Cursor, books: Books, seq: int, name: str) -> None:
        """Delete a released list and count it."""
        rows.execute('DELETE FROM lists WHERE seq = ? RETURNING bytes', (seq,))
        for (size,) in rows.fetchall():
            books.count(name, books.take(ChipState.RELEASED, [size]))
            if name == 'delivered' and isinstance(size, int):
                books.count('delivered_bytes', size)


def _mended(rows: sqlite3.Cursor) -> Collection[StoredList]:
    """Read all lists; delete those that are damaged, and put the state of others right."""
    rows.execute(f'SELECT {LIST_COLUMNS} FROM lists')
    intact = {}
    for row in [StoredList(*fields) for fields in rows.fetchall()]:
        mended = row.mended()
        if mended is None:
            rows.execute('DELETE FROM lists WHERE seq = ?', (row.seq,))
            continue
        intact[row.seq] = mended
        if mended.state != row.state:
            rows.execute('UPDATE lists SET state = ? WHERE seq = ?', (mended.state, row.seq))
    return intact.values()


# In the books, how many ships are in a state.
_SHIPS = {ChipState.WAITING: 'ships_waiting', ChipState.CLAIMED: 'ships_claimed'}


def _joined(old: Sequence[ShipReport], new: Sequence[ShipReport]) -> list[ShipReport]:
    """Join the reports of equal ids, in the order of the first ones; those without id remain."""
    by_id: dict[str | int, ShipReport] = {}
    for number, ship in enumerate((*old, *new)):
        key = ship.id or number
        known = by_id.get(key)
        by_id[key] = ship if known is None else joined_reports(known, ship)
    return list(by_id.values())


def _readable(ships: Sequence[ShipReport]) -> tuple[list[ShipReport], bytes]:
    """Write a list that can be read again; if it is too large, only its better half."""
    kept = most_valuable(ships, MAX_SHIPS)
    while True:
        try:
            return kept, ship_geojson(kept)
        except ShipListError:
            kept = most_valuable(kept, len(kept) // 2)


def _size(file_bytes: int) -> int:
    """Return the size of a list with its JSON; damage may have turned the size into anything."""
    return LIST_JSON_ROOM + (file_bytes if isinstance(file_bytes, int) else 0)


def _cut(
    ships: Sequence[ShipReport], max_bytes: float, is_message: bool
) -> tuple[bytes, list[ShipReport]]:
    """Write as many of the most valuable ships as fit; also return the rest."""
    if is_message:
        if max_bytes < MIN_MESSAGE_BYTES:
            return b'', list(ships)
        return ship_message(ships, int(max_bytes))
    content, count = ship_geojson(ships), len(ships)
    while len(content) > max_bytes and count:
        # A short list packs worse than a long one.
        count = min(count - 1, int(0.95 * count * max(max_bytes, 0.0) / len(content)))
        chosen = most_valuable(ships, count)
        content = ship_geojson(chosen)
    if count == len(ships):
        return content, []
    kept = {id(ship) for ship in chosen}
    return content, [ship for ship in ships if id(ship) not in kept]
