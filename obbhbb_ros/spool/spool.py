# SPDX-License-Identifier: Apache-2.0
"""
The spool: a folder in which chips wait for the ground, whatever happens to the processes.

Its catalogue is an SQLite database with the chips in it. Whatever changes, changes in one
transaction that is on disk when it ends: a frame is planned, its chips are stored, a chip is
claimed, released, delivered. So the books balance at every instant,

    planned = delivered + waiting + evicted + refused + in work,

where `in work` are the chips of the frames that a running process has in hand. Several processes
may have a spool open.
"""

from __future__ import annotations

import hashlib
import itertools
import json
import math
import re
import sqlite3
import sys
from collections import Counter
from collections.abc import Callable
from collections.abc import Iterator
from collections.abc import Mapping
from collections.abc import Sequence
from contextlib import closing
from contextlib import contextmanager
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from typing import NamedTuple
from typing import TypeVar

from obbhbb_ros.downlink.chips import CODECS
from obbhbb_ros.spool.catalogue import PATIENCE
from obbhbb_ros.spool.catalogue import Catalogue
from obbhbb_ros.spool.catalogue import SpoolError
from obbhbb_ros.spool.catalogue import lossy_text

T = TypeVar('T')

_VERSION = 1
# Times the maximum size that the file of a catalogue may have.
_SLACK = 1.1
# Seconds that a writer waits for another process: as long as a frame may be late.
_WRITER_PATIENCE = 0.8
# Chips that are evicted in one transaction: a lower limit is reached in several.
_MOST_EVICTED = 1000
# Free pages that are given back to the disk in one transaction.
_PAGES_GIVEN_BACK = 1000
# Numbers of chips that are tried, one by one, to get behind a damaged place.
_MOST_SKIPPED = 100_000
# The greatest number that SQLite can give to a chip.
_MOST_SEQ = 2**63 - 1

WAITING, CLAIMED, RELEASED = 0, 1, 2
"""States of a chip in the catalogue: in the spool, on its way to the outbox, in the outbox."""

# Tables, and triggers that count the chips that move or leave.
_SCHEMA = """
CREATE TABLE chips (
    seq INTEGER PRIMARY KEY AUTOINCREMENT,
    id TEXT NOT NULL UNIQUE,
    state INTEGER NOT NULL,
    value REAL NOT NULL,
    class_id TEXT NOT NULL,
    bytes INTEGER NOT NULL,
    facts TEXT NOT NULL,
    data BLOB
);
CREATE INDEX chips_in_order ON chips (state, value DESC, seq);
CREATE TABLE frames (
    number INTEGER PRIMARY KEY AUTOINCREMENT, writer INTEGER NOT NULL, chips INTEGER NOT NULL
);
CREATE TABLE notes (name TEXT PRIMARY KEY, text TEXT NOT NULL);
CREATE TABLE books (name TEXT PRIMARY KEY, count INTEGER NOT NULL);
CREATE TABLE totals (state INTEGER PRIMARY KEY, chips INTEGER NOT NULL, bytes INTEGER NOT NULL);
INSERT INTO totals VALUES (0, 0, 0), (1, 0, 0), (2, 0, 0);
CREATE TRIGGER chip_moved AFTER UPDATE OF state ON chips BEGIN
    UPDATE totals SET chips = chips - 1, bytes = bytes - OLD.bytes WHERE state = OLD.state;
    UPDATE totals SET chips = chips + 1, bytes = bytes + NEW.bytes WHERE state = NEW.state;
END;
CREATE TRIGGER chip_out AFTER DELETE ON chips BEGIN
    UPDATE totals SET chips = chips - 1, bytes = bytes - OLD.bytes WHERE state = OLD.state;
END;
"""


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

    Raises
    ------
    ValueError
        If the value is not finite.
    """

    value: float
    class_id: str
    stamp: tuple[int, int]
    facts: Mapping[str, Any]
    data: bytes

    def __post_init__(self) -> None:
        """Check the value."""
        if not math.isfinite(self.value):
            raise ValueError(f'value must be finite, not {self.value}')


class StoredChip(NamedTuple):
    """A chip of the catalogue; `facts` is JSON without `id` and `value`."""

    seq: int
    id: str
    state: int
    value: float
    class_id: str
    bytes: int
    facts: str

    def describe(self) -> dict[str, Any]:
        """Give everything that is known of the chip, as its JSON file has it."""
        return {'id': self.id, 'value': self.value, **json.loads(self.facts)}


_COLUMNS = ', '.join(StoredChip._fields)


class Frame(NamedTuple):
    """A frame in work: the catalogue and row in which it was planned, and how many chips it has."""

    catalogue: str
    number: int
    chips: int


@dataclass(frozen=True)
class Status:
    """
    The books of a spool.

    Attributes
    ----------
    waiting, waiting_bytes : int
        Chips in the spool, those on their way to the outbox included, and bytes of their files.
    in_outbox : int
        Chips in the outbox whose removal is waited for.
    in_work : int
        Chips of frames that are being cut.
    file_bytes : int
        Size of the catalogue in use.
    set_aside : int
        Damaged catalogues beside it.
    counts : mapping of str to int
        `planned`, `released`, `delivered`, `delivered_bytes`, and `evicted.<reason>`,
        `refused.<reason>`.
    """

    waiting: int
    waiting_bytes: int
    in_outbox: int
    in_work: int
    file_bytes: int
    set_aside: int
    counts: Mapping[str, int]

    def total(self, kind: str) -> int:
        """Sum up `evicted` or `refused` over all reasons."""
        return sum(n for name, n in self.counts.items() if name.startswith(f'{kind}.'))

    @property
    def balance(self) -> int:
        """Chips planned that are unaccounted for; 0."""
        return self.counts.get('planned', 0) - (
            self.counts.get('delivered', 0)
            + self.waiting
            + self.in_outbox
            + self.in_work
            + self.total('evicted')
            + self.total('refused')
        )


class Spool:
    """
    One process's access to a spool; it opens the catalogue when it is first needed.

    A `Spool` belongs to one thread at a time. Methods raise `SpoolError` if the spool cannot be
    used, with a full disk for example, and try again at the next call. `plan` and `store` do not:
    what they cannot write down is kept in memory and written down when that is possible again.

    Parameters
    ----------
    folder : Path
        Where the spool is; made if it is missing.
    on_trouble : callable
        Called with a text about everything that an operator should know.
    role : str
        'writer' for `plan` and `store`, 'releaser' for `claim` and what follows; a spool has any
        number of writers and one releaser.

    Examples
    --------
    >>> import tempfile
    >>> chip = NewChip(0.9, 'ship', (5, 0), {'codec': 'jpeg'}, b'...')
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     spool = Spool(Path(folder), on_trouble=print, role='writer')
    ...     done = spool.store(spool.plan(2), [chip], {'encoder_failed': 1})
    ...     status = spool.status()
    ...     spool.close()
    >>> done, status.waiting, status.counts['planned'], status.counts['refused.encoder_failed']
    (True, 1, 2, 1)
    """

    def __init__(self, folder: Path, on_trouble: Callable[[str], object], role: str = '') -> None:
        self._folder = Path(folder)
        self._on_trouble = on_trouble
        self._catalogue = Catalogue(
            self._folder,
            _SCHEMA,
            _VERSION,
            on_trouble,
            {'writer': self._become_writer, 'releaser': self._become_releaser}.get(role),
            _WRITER_PATIENCE if role == 'writer' else PATIENCE,
        )
        self._number = 0
        # What could not be written down: frames and why none of their chips was stored.
        self._arrears: list[tuple[Frame, Counter[str]]] = []

    # Writing chips

    def plan(self, chips: int) -> Frame:
        """Write down that a frame with some chips is in work."""
        with self._said():
            return self._write(lambda rows: self._begin_frame(rows, chips))
        return Frame('', 0, chips)

    def store(
        self,
        frame: Frame,
        chips: Sequence[NewChip],
        refused: Mapping[str, int],
        max_bytes: float = 0.0,
    ) -> bool:
        """
        Store the chips of a frame, and evict the least valuable ones if there is no room.

        Parameters
        ----------
        frame : Frame
            From `plan`.
        chips : sequence of NewChip
            Its chips.
        refused : mapping of str to int
            How many of its chips are not stored, by reason; together with `chips` all of them.
        max_bytes : float
            Maximum size of the catalogue, bytes (0: unlimited).

        Returns
        -------
        bool
            Whether it is done; if not, all chips are refused, as `spool_failed`.
        """
        with self._said():
            self._write(lambda rows: self._store(rows, frame, chips, refused, max_bytes))
            return True
        failed = Counter(refused)
        failed['spool_failed'] += len(chips)
        if self._arrears and not frame.catalogue and not self._arrears[-1][0].catalogue:
            # However long it lasts, it takes no more memory.
            last, reasons = self._arrears.pop()
            frame, failed = Frame('', 0, last.chips + frame.chips), failed + reasons
        self._arrears.append((frame, failed))
        return False

    # Releasing chips

    def claim(
        self, most: int, room: float, largest: float, overhead: int
    ) -> tuple[list[tuple[StoredChip, bytes]], float]:
        """
        Take the next chips, which nobody evicts from then on.

        Parameters
        ----------
        most : int
            Maximum number of chips.
        room, largest : float
            Maximum bytes of all and of one; a larger one is passed over.
        overhead : int
            Bytes that each costs besides its file and JSON.

        Returns
        -------
        list of (StoredChip, bytes)
            Chips and their files, the most valuable first, the oldest of equals first.
        float
            Bytes of the first one that has no room; infinite if all that wait are larger than one
            may be, 0 if none waits.
        """

        def work(rows: sqlite3.Cursor) -> tuple[list[tuple[StoredChip, bytes]], float]:
            left, claimed, missing = room, [], 0.0
            for cost, *fields in rows.execute(
                f'SELECT {_COST} + ?, {_COLUMNS} FROM chips WHERE state = ? AND {_COST} + ? <= ? '
                'ORDER BY value DESC, seq LIMIT ?',
                (overhead, WAITING, overhead, largest, most),
            ).fetchall():
                if cost > left:
                    missing = cost
                    break
                left -= cost
                chip = StoredChip(*fields)
                (data,) = rows.execute(
                    'SELECT data FROM chips WHERE seq = ?', (chip.seq,)
                ).fetchone()
                claimed.append((chip, data))
            rows.executemany(
                'UPDATE chips SET state = ? WHERE seq = ?',
                [(CLAIMED, chip.seq) for chip, _ in claimed],
            )
            if not claimed and not missing:
                (waiting,) = rows.execute(
                    'SELECT chips FROM totals WHERE state = ?', (WAITING,)
                ).fetchone()
                missing = math.inf if waiting else 0.0
            return claimed, missing

        return self._write(work)

    def unclaim(self, ids: Sequence[str]) -> None:
        """Put claimed chips back."""
        if ids:
            self._write(
                lambda rows: rows.executemany(
                    'UPDATE chips SET state = ? WHERE id = ? AND state = ?',
                    [(WAITING, each, CLAIMED) for each in ids],
                )
            )

    def released(self, ids: Sequence[str], delivered: bool) -> None:
        """Write down that chips are in the outbox, and whether they are delivered by that."""

        def work(rows: sqlite3.Cursor) -> None:
            # The outbox has the file now.
            rows.executemany(
                'UPDATE chips SET state = ?, data = NULL WHERE id = ? AND state = ?',
                [(RELEASED, each, CLAIMED) for each in ids],
            )
            _book(rows, 'released', rows.rowcount)
            if delivered:
                _deliver(rows, ids)

        if ids:
            self._write(work)

    def delivered(self, ids: Sequence[str]) -> None:
        """Write down that the bus has taken chips from the outbox."""
        if ids:
            self._write(lambda rows: _deliver(rows, ids))

    def ids(self, state: int) -> list[str]:
        """List the ids of the chips in a state."""
        return [
            chip_id
            for (chip_id,) in self._catalogue.run(
                lambda rows: rows.execute(
                    'SELECT id FROM chips WHERE state = ?', (state,)
                ).fetchall()
            )
        ]

    def set_aside(self, chip_id: str) -> None:
        """Take a chip whose file is damaged out of the catalogue, and count it as evicted."""

        def work(rows: sqlite3.Cursor) -> None:
            rows.execute('DELETE FROM chips WHERE id = ?', (chip_id,))
            _book(rows, 'evicted.damaged', rows.rowcount)

        self._write(work)

    def outbox(self) -> str:
        """Return the token of the outbox that chips are released into; empty if none is known."""
        row = self._catalogue.run(
            lambda rows: rows.execute("SELECT text FROM notes WHERE name = 'outbox'").fetchone()
        )
        return row[0] if row else ''

    def set_outbox(self, token: str) -> None:
        """Write down which outbox chips are released into."""
        self._write(lambda rows: rows.execute("REPLACE INTO notes VALUES ('outbox', ?)", (token,)))

    # Looking at it and changing it

    def status(self) -> Status:
        """Read the books."""

        def work(rows: sqlite3.Cursor) -> Status:
            totals = {
                state: (chips, size)
                for state, chips, size in rows.execute('SELECT * FROM totals').fetchall()
            }
            (in_work,) = rows.execute('SELECT ifnull(sum(chips), 0) FROM frames').fetchone()
            return Status(
                waiting=totals[WAITING][0] + totals[CLAIMED][0],
                waiting_bytes=totals[WAITING][1] + totals[CLAIMED][1],
                in_outbox=totals[RELEASED][0],
                in_work=in_work,
                file_bytes=_pragma(rows, 'page_count') * _pragma(rows, 'page_size'),
                set_aside=self._catalogue.set_aside,
                counts=dict(rows.execute('SELECT name, count FROM books').fetchall()),
            )

        return self._catalogue.run(work)

    def select(
        self, where: str = '1', values: Sequence[Any] = (), most: int = -1
    ) -> list[StoredChip]:
        """List chips that meet an SQL condition, in the order of their release."""
        return [
            StoredChip(*row)
            for row in self._catalogue.run(
                lambda rows: rows.execute(
                    f'SELECT {_COLUMNS} FROM chips WHERE {where} ORDER BY state, value DESC, seq '
                    'LIMIT ?',
                    (*values, most),
                ).fetchall()
            )
        ]

    def data(self, seq: int) -> bytes | None:
        """Read the file of a chip; None if it is in the outbox."""
        row = self._catalogue.run(
            lambda rows: rows.execute('SELECT data FROM chips WHERE seq = ?', (seq,)).fetchone()
        )
        return None if row is None else row[0]

    def revalue(self, where: str, values: Sequence[Any], factor: float, addend: float) -> int:
        """Change the value of waiting chips that meet a condition; return how many."""

        def work(rows: sqlite3.Cursor, seqs: Sequence[int]) -> None:
            # JSON has no infinite numbers.
            rows.executemany(
                'UPDATE chips SET value = max(min(value * ? + ?, ?), ?) WHERE seq = ?',
                [(factor, addend, sys.float_info.max, -sys.float_info.max, seq) for seq in seqs],
            )

        return self._in_pieces(where, values, work)

    def delete(self, where: str, values: Sequence[Any]) -> int:
        """Delete waiting chips that meet a condition, counted as evicted; return how many."""

        def work(rows: sqlite3.Cursor, seqs: Sequence[int]) -> None:
            rows.executemany('DELETE FROM chips WHERE seq = ?', [(seq,) for seq in seqs])
            _book(rows, 'evicted.deleted', len(seqs))

        return self._in_pieces(where, values, work)

    def _in_pieces(
        self,
        where: str,
        values: Sequence[Any],
        change: Callable[[sqlite3.Cursor, Sequence[int]], None],
    ) -> int:
        """Change waiting chips that meet a condition, so many at once that nobody waits long."""
        changed, last = 0, 0

        def work(rows: sqlite3.Cursor) -> list[int]:
            found = rows.execute(
                f'SELECT seq FROM chips WHERE state = ? AND seq > ? AND {where} ORDER BY seq '
                'LIMIT ?',
                (WAITING, last, *values, _MOST_EVICTED),
            ).fetchall()
            seqs = [seq for (seq,) in found]
            change(rows, seqs)
            return seqs

        while seqs := self._write(work):
            changed, last = changed + len(seqs), seqs[-1]
        return changed

    def integrity(self) -> list[str]:
        """Check the structure of the catalogue; list what is wrong."""
        found = self._catalogue.run(lambda rows: rows.execute('PRAGMA integrity_check').fetchall())
        return [text for (text,) in found if text != 'ok']

    def forget_outbox(self) -> int:
        """Count the chips in the outbox as evicted, and take any outbox; return how many."""

        def work(rows: sqlite3.Cursor) -> int:
            rows.execute('DELETE FROM chips WHERE state = ?', (RELEASED,))
            lost = rows.rowcount
            _book(rows, 'evicted.outbox_lost', lost)
            rows.execute("DELETE FROM notes WHERE name = 'outbox'")
            return lost

        return self._write(work)

    def catch_up(self) -> None:
        """Write down what could not be written down before, if there is anything."""
        if self._arrears:
            with suppress(SpoolError):
                self._write(lambda rows: None)

    def close(self) -> None:
        """Close the catalogue and let go of the locks."""
        self.catch_up()
        self._catalogue.close()

    def _write(self, work: Callable[[sqlite3.Cursor], T]) -> T:
        """Change something, after what could not be written down before."""

        def all_work(rows: sqlite3.Cursor) -> T:
            for frame, refused in self._arrears:
                self._settle(rows, frame, refused)
            return work(rows)

        result = self._catalogue.run(all_work, writing=True)
        self._arrears.clear()
        return result

    @contextmanager
    def _said(self) -> Iterator[None]:
        """Have the operator know what goes wrong."""
        try:
            yield
        except SpoolError as error:
            self._on_trouble(str(error))

    def _begin_frame(self, rows: sqlite3.Cursor, chips: int) -> Frame:
        """Open a frame for this process."""
        _book(rows, 'planned', chips)
        rows.execute('INSERT INTO frames (writer, chips) VALUES (?, ?)', (self._number, chips))
        return Frame(self._catalogue.tag, int(rows.lastrowid or 0), chips)

    def _store(
        self,
        rows: sqlite3.Cursor,
        frame: Frame,
        chips: Sequence[NewChip],
        refused: Mapping[str, int],
        max_bytes: float,
    ) -> None:
        """Insert chips, settle their frame and make room."""
        self._settle(rows, frame, refused)
        (last,) = rows.execute(
            "SELECT ifnull(max(seq), 0) FROM sqlite_sequence WHERE name = 'chips'"
        ).fetchone()
        rows.executemany(
            f'INSERT INTO chips ({_COLUMNS}, data) VALUES (?, ?, ?, ?, ?, ?, ?, ?)',
            [self._row(last + 1 + i, chip) for i, chip in enumerate(chips)],
        )
        # Once for all of them: a trigger would take as long as the insertion.
        rows.execute(
            'UPDATE totals SET chips = chips + ?, bytes = bytes + ? WHERE state = ?',
            (len(chips), sum(len(chip.data) for chip in chips), WAITING),
        )
        if max_bytes and not _evict(rows, max_bytes):
            self._on_trouble(
                f'{self._folder} is larger than spool.max_bytes, {max_bytes:.0f}, and no chip is '
                'left to evict; chips are evicted as they come'
            )

    def _row(self, seq: int, chip: NewChip) -> tuple[Any, ...]:
        """Lay out a chip for the catalogue."""
        seconds, nanoseconds = chip.stamp
        facts = {
            'stamp': {'sec': seconds, 'nanosec': nanoseconds},
            'class_id': chip.class_id,
            **chip.facts,
            'bytes': len(chip.data),
            'sha256': hashlib.sha256(chip.data).hexdigest(),
        }
        name = f'{seconds}_{nanoseconds:09d}_{self._catalogue.tag}_{seq}'
        return (
            seq,
            name,
            WAITING,
            chip.value,
            chip.class_id,
            len(chip.data),
            json.dumps(facts, ensure_ascii=False),
            chip.data,
        )

    def _settle(self, rows: sqlite3.Cursor, frame: Frame, refused: Mapping[str, int]) -> None:
        """Close a frame; one that was planned in another catalogue, or in none, is planned here."""
        if frame.catalogue != self._catalogue.tag:
            _book(rows, 'planned', frame.chips)
        elif not rows.execute('DELETE FROM frames WHERE number = ?', (frame.number,)).rowcount:
            # Closed meanwhile, so it was taken for a frame of a process that had ended.
            _book(rows, 'refused.interrupted', -frame.chips)
        for reason, count in refused.items():
            _book(rows, f'refused.{reason}', count)

    def _become_writer(self, rows: sqlite3.Cursor) -> None:
        """Take numbers that no other writer holds; frames with them are of writers that died."""
        (most,) = rows.execute('SELECT ifnull(max(writer), 0) FROM frames').fetchone()
        mine = None
        for number in itertools.count():
            if self._catalogue.lock(f'writer_{number}'):
                _refuse_interrupted(rows, number)
                mine = number if mine is None else mine
            if mine is not None and number >= most:
                self._number = mine
                return

    def _become_releaser(self, rows: sqlite3.Cursor) -> None:
        """Keep other releasers away."""
        if not self._catalogue.lock('releaser'):
            raise SpoolError(
                f'{self._folder}: another process releases this spool; each chain needs its own '
                'spool.path and outbox.path'
            )


def describe_intact(chip: StoredChip, data: bytes) -> dict[str, Any] | None:
    """Describe a chip; None if its description or its file, which is given, is damaged."""
    with suppress(ValueError, KeyError, TypeError):
        description = chip.describe()
        whole = description['sha256'] == hashlib.sha256(data).hexdigest()
        # The names of its files.
        named = _ID.fullmatch(chip.id) and description['codec'] in CODECS
        return description if whole and named else None
    return None


# As `Spool.store` makes them.
_ID = re.compile(r'-?[0-9]+_[0-9]{9,10}_[0-9a-f]{6}_[0-9]+')
# Maximum bytes of id and value in a JSON file.
_JSON_ROOM = 128
# Bytes that a chip costs on the link: its file and its JSON.
_COST = f'(bytes + length(CAST(facts AS BLOB)) + {_JSON_ROOM})'


def _book(rows: sqlite3.Cursor, name: str, count: int) -> None:
    """Add to a count."""
    if count:
        rows.execute(
            'INSERT INTO books VALUES (?, ?) ON CONFLICT (name) DO UPDATE SET count = count + ?',
            (name, count, count),
        )


def _refuse_interrupted(rows: sqlite3.Cursor, writer: int) -> None:
    """Close the frames of a writer that ended in the middle of them."""
    (chips,) = rows.execute(
        'SELECT ifnull(sum(chips), 0) FROM frames WHERE writer = ?', (writer,)
    ).fetchone()
    rows.execute('DELETE FROM frames WHERE writer = ?', (writer,))
    _book(rows, 'refused.interrupted', chips)


def _deliver(rows: sqlite3.Cursor, ids: Sequence[str]) -> None:
    """Count chips as delivered and take them out."""
    for each in ids:
        row = rows.execute('SELECT bytes FROM chips WHERE id = ?', (each,)).fetchone()
        if row is not None:
            rows.execute('DELETE FROM chips WHERE id = ?', (each,))
            _book(rows, 'delivered', 1)
            _book(rows, 'delivered_bytes', row[0])


def _evict(rows: sqlite3.Cursor, max_bytes: float) -> bool:
    """
    Delete the least valuable chips, the oldest of equals first, to make room for the rest.

    Returns False if all have gone that may go, and there is still no room.
    """
    evicted, most, left = 0, max_bytes / _pragma(rows, 'page_size'), True
    while _pragma(rows, 'page_count') - _pragma(rows, 'freelist_count') > most:
        # Two questions that the one index answers.
        rows.execute(
            'DELETE FROM chips WHERE seq = (SELECT seq FROM chips WHERE state = ?1 AND value = '
            '(SELECT min(value) FROM chips WHERE state = ?1) ORDER BY seq LIMIT 1)',
            (WAITING,),
        )
        left = bool(rows.rowcount)
        evicted += rows.rowcount
        if not left or evicted == _MOST_EVICTED:
            break
    _book(rows, 'evicted.max_bytes', evicted)
    # Free pages are used again; only those far beyond a limit that was lowered go to the disk.
    excess = _pragma(rows, 'page_count') - int(_SLACK * most)
    for _ in range(min(excess, _pragma(rows, 'freelist_count'), _PAGES_GIVEN_BACK)):
        # One after the other: Python takes one step of a statement without rows.
        rows.execute('PRAGMA incremental_vacuum(1)')
    return left


def _pragma(rows: sqlite3.Cursor, name: str) -> int:
    """Ask SQLite for a number."""
    return int(rows.execute(f'PRAGMA {name}').fetchone()[0])


def intact_chips(path: Path) -> Iterator[tuple[StoredChip, bytes]]:
    """
    Read what can be read of a damaged catalogue: all chips but those in damaged places.

    Parameters
    ----------
    path : Path
        The SQLite file.

    Yields
    ------
    (StoredChip, bytes)
        Chips whose file is the one that was stored.

    Raises
    ------
    SpoolError
        If it cannot be opened, damaged or not, is no catalogue, or no chip of it can be read.
    """
    with closing(_connected(path)) as database:
        _prepare_damaged(database, path)
        seen: set[int] = set()
        troubles: list[str] = []
        for step in (1, -1):
            for chip, data in _readable(database, step, troubles):
                if chip.seq in seen:
                    break
                seen.add(chip.seq)
                # Damage may have turned a value into a text.
                if (
                    data is not None
                    and isinstance(chip.value, float)
                    and describe_intact(chip, data)
                ):
                    yield chip, data
        if troubles and not seen:
            raise SpoolError(f'{path}: no chip can be read: {troubles[0]}')


def _readable(
    database: sqlite3.Connection, step: int, troubles: list[str]
) -> Iterator[tuple[StoredChip, bytes | None]]:
    """Read chips, up (step 1) or down (-1), and go on behind each damaged place."""
    sign, order = ('>', 'ASC') if step > 0 else ('<', 'DESC')
    query = f'SELECT data, {_COLUMNS} FROM chips WHERE seq {sign} ? ORDER BY seq {order}'
    # All chips are behind it.
    place, skipped = 0 if step > 0 else _MOST_SEQ, 0
    while skipped < _MOST_SKIPPED:
        try:
            for data, *fields in database.execute(query, (place,)):
                chip = StoredChip(*fields)
                # Never back, whatever number damage has given to a chip.
                place, skipped = step * max(step * place, step * chip.seq), 0
                yield chip, data
            return
        except sqlite3.DatabaseError as error:
            troubles[:] = troubles or [str(error)]
            place, skipped = place + step, skipped + 1


def _connected(path: Path) -> sqlite3.Connection:
    """Connect to a file for reading; SpoolError if that is not possible."""
    try:
        database = sqlite3.connect(f'{path.resolve().as_uri()}?mode=ro', uri=True)
    except sqlite3.Error as error:
        raise _not_opened(path, error) from error
    database.text_factory = lossy_text
    return database


def _prepare_damaged(database: sqlite3.Connection, path: Path) -> None:
    """Open the file of a connection, damaged or not; SpoolError if it is no catalogue."""
    try:
        # With it, SQLite reads a file that has lost its end.
        database.execute('PRAGMA writable_schema = ON')
        database.execute('PRAGMA schema_version')
    except sqlite3.OperationalError as error:
        raise _not_opened(path, error) from error
    except sqlite3.DatabaseError:
        # Damaged: how far it can be read is found out below, and row by row.
        pass
    try:
        database.execute(f'SELECT data, {_COLUMNS} FROM chips LIMIT 0')
    except sqlite3.DatabaseError as error:
        raise SpoolError(
            f'{path} is no catalogue of a spool, or its start is damaged: {error}'
        ) from error


def _not_opened(path: Path, error: sqlite3.Error) -> SpoolError:
    """Say that a file cannot be opened, and what helps."""
    return SpoolError(
        f'{path}: {error}; it must be readable, and if its disk is read-only, copy all files of '
        'the same name to another'
    )
