# SPDX-License-Identifier: Apache-2.0
"""
A durable SQLite database in a folder: transactions that survive kills, damage and deletion.

Several processes may use it at once. A damaged database stays where it is, with a mark beside it,
and a new one takes its place. The new one never has the name of an old one: a process that still
has the old one open would delete the files of the new one.

Damage of indexes alone is made good, once: a second one is the disk's.
"""

from __future__ import annotations

import fcntl
import os
import re
import secrets
import sqlite3
import time
from collections.abc import Callable
from collections.abc import Iterator
from contextlib import ExitStack
from contextlib import closing
from contextlib import contextmanager
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

from obbhbb_ros.damaged_sqlite import lossy_text
from obbhbb_ros.errors import ObbhbbError
from obbhbb_ros.files import sync_folder

_NAME = re.compile(r'[a-z]+_([0-9]+)_[0-9a-f]{6}\.sqlite3')
DAMAGED = '.damaged'
"""Suffix of the mark beside a damaged database."""
# Suffix of the mark beside a database whose indexes were rebuilt, or were about to be.
_REBUILT = '.rebuilt'
# For so many seconds afterwards, another process may still meet the old damage.
_AFTERMATH = 60.0
# Name of the lock of a process that opens a database.
_OPENING = 'open.lock'
# Seconds to wait for a process that holds the lock, once a first wait was in vain.
_IMPATIENCE = 0.05


class SpoolError(ObbhbbError, OSError):
    """The spool cannot be used now; the text says why."""


class SpoolDamagedError(SpoolError):
    """The database in use was damaged; it was mended, or the next transaction begins a new one."""


class CatalogueSchema(NamedTuple):
    """
    The tables of a database.

    Attributes
    ----------
    version : int
        Their version; a database of another one is treated as damaged, except the one before.
    script : str
        SQL script that creates them.
    migrate : callable
        Makes them of those of the version before, by a cursor in a transaction.
    on_rebuilt : callable
        Writes down that their indexes were rebuilt, by a cursor in the same transaction.
    content : str
        What they hold; the names of the files begin with it.
    """

    version: int
    script: str
    migrate: Callable[[sqlite3.Cursor], object]
    on_rebuilt: Callable[[sqlite3.Cursor], object]
    content: str = 'chips'


class Catalogue:
    """
    One process's access to the database of a folder; the first transaction opens it.

    Only one thread at a time may use it.

    Parameters
    ----------
    folder : Path
        Folder of the database; created if it is missing.
    schema : CatalogueSchema
        Its tables.
    on_trouble : callable
        Called with a text about anything that an operator should know and that raises no error.
    on_open : callable
        Called with a cursor, in a transaction, whenever a database is opened.
    patience : float
        Seconds to wait while another process holds the lock. After a wait in vain, calls hardly
        wait until a transaction succeeds, so that a stuck process does not delay every one.

    Attributes
    ----------
    folder : Path
        The folder.
    tag : str
        Six hexadecimal digits that identify the database in use.
    """

    def __init__(
        self,
        folder: Path,
        schema: CatalogueSchema,
        on_trouble: Callable[[str], object],
        on_open: Callable[[sqlite3.Cursor], object],
        patience: float,
    ) -> None:
        self.folder = folder
        self._patience = self._wait = patience
        self._schema = schema
        self._on_trouble, self._on_open = on_trouble, on_open
        self._database: sqlite3.Connection | None = None
        self._path = folder
        self._files: list[tuple[int, int] | None] = []
        self._locks: list[int] = []
        self._rebuilt = folder
        self.tag = ''

    @property
    def set_aside(self) -> int:
        """Number of damaged databases in the folder."""
        return len(list(self.folder.glob(f'*{DAMAGED}')))

    @contextmanager
    def transaction(self, write: bool = False) -> Iterator[sqlite3.Cursor]:
        """
        Run a `with` block as one transaction.

        At the end of the block all its changes are on disk; after an error nothing has changed.

        Parameters
        ----------
        write : bool
            Whether the block changes anything.

        Yields
        ------
        sqlite3.Cursor
            Cursor for the block.

        Raises
        ------
        SpoolDamagedError
            If the database is damaged, or its files were deleted or replaced. If rebuilding its
            indexes does not mend it, it is set aside, and the next transaction uses a new one.
        SpoolError
            If the database cannot be used now.
        """
        try:
            with _transaction(self._current(), write) as rows:
                yield rows
            if write:
                self._set_wait(self._patience)
                self._check_files()
        except SpoolError:
            raise
        except (sqlite3.Error, OSError, UnicodeDecodeError) as error:
            raise self._failure(error) from error

    def lock(self, name: str) -> bool:
        """Lock a name until the database is closed; False if another process holds the lock."""
        lock = _locked(self.folder / f'{name}.lock')
        if lock is not None:
            self._locks.append(lock)
        return lock is not None

    def close(self) -> None:
        """Close the database and release the locks."""
        if self._database is not None:
            with suppress(sqlite3.Error):
                self._database.close()
        self._database = None
        for lock in self._locks:
            os.close(lock)
        self._locks.clear()

    def _current(self) -> sqlite3.Connection:
        """Return the connection to the database in use; open it if necessary."""
        if self._database is None or not self._is_current():
            self.close()
            self._database = self._open()
            self.tag = self._path.stem.rpartition('_')[2]
            try:
                with _transaction(self._database, write=True) as rows:
                    self._on_open(rows)
                self._files = self._files_now()
            except BaseException:
                self.close()
                raise
        return self._database

    def _is_current(self) -> bool:
        """Return whether the open files are still there and in use; report it if one is gone."""
        try:
            self._check_files()
        except SpoolDamagedError as error:
            self._on_trouble(str(error))
            return False
        return is_in_use(self._path)

    def _check_files(self) -> None:
        """Set the database aside and close it if one of its files is gone or was replaced."""
        before, self._files = self._files, self._files_now()
        # SQLite creates one later if the disk was full.
        if all(file in (None, now) for file, now in zip(before, self._files, strict=True)):
            return
        # Whatever other processes wrote into it would be lost.
        if self._path.exists():
            self._set_aside('')
        self.close()
        raise SpoolDamagedError(
            f'{self._path} or its log was deleted or replaced; a new catalogue begins'
        )

    def _files_now(self) -> list[tuple[int, int] | None]:
        """Identify the files of the database by their names, which others may have taken."""
        return [_identity(f'{self._path}{suffix}') for suffix in ('', '-wal', '-shm')]

    def _open(self) -> sqlite3.Connection:
        """Open the database in use, or a new one."""
        if not self.folder.exists():
            self.folder.mkdir(parents=True, exist_ok=True)
            sync_folder(self.folder.parent)
        with _exclusive(self.folder / _OPENING, self._wait):
            in_use = list(filter(is_in_use, catalogue_files(self.folder)))
            self._path = in_use[-1] if in_use else self._new_path()
            try:
                return self._connect()
            except (sqlite3.DatabaseError, UnicodeDecodeError) as error:
                if not self._is_damage(error):
                    raise
                self._on_trouble(self._set_aside(error))
                self._path = self._new_path()
                return self._connect()

    def _connect(self) -> sqlite3.Connection:
        """Open the file in use; create its tables if it is new."""
        database = sqlite3.connect(
            self._path, timeout=self._wait, isolation_level=None, check_same_thread=False
        )
        # The users of a text check it for damage.
        database.text_factory = lossy_text
        try:
            # Small pages: a page is used again only when all of it is free.
            database.execute('PRAGMA page_size = 2048')
            database.execute('PRAGMA auto_vacuum = INCREMENTAL')
            database.execute('PRAGMA journal_mode = WAL')
            # When a transaction ends it is on disk, not only handed to the system.
            database.execute('PRAGMA synchronous = FULL')
            self._set_up(database)
        except BaseException:
            database.close()
            raise
        return database

    def _set_up(self, database: sqlite3.Connection) -> None:
        """Create the tables if the file is new; check that they are those of the schema."""
        version, due = database.execute('PRAGMA user_version').fetchone()[0], self._schema.version
        if version == 0 and not _tables(database):
            database.executescript(
                f'BEGIN IMMEDIATE; {self._schema.script} PRAGMA user_version = {due}; COMMIT'
            )
            sync_folder(self.folder)
        elif version == due - 1:
            self._migrate(database)
        elif version != due:
            raise sqlite3.DatabaseError(f'its version is {version}, not {due}')
        with closing(sqlite3.connect(':memory:')) as model:
            model.executescript(self._schema.script)
            if _tables(model) != _tables(database):
                raise sqlite3.DatabaseError('its tables are not those of its version')

    def _migrate(self, database: sqlite3.Connection) -> None:
        """Bring a database to the version in use, while no process uses it in any role."""
        with ExitStack() as locks:
            for path in self.folder.glob('*.lock'):
                if path.name == _OPENING:
                    continue
                lock = _locked(path)
                if lock is None:
                    raise sqlite3.OperationalError(
                        'a process of an earlier version uses it; stop that process'
                    )
                locks.callback(os.close, lock)
            with _transaction(database, write=True) as rows:
                self._schema.migrate(rows)
                rows.execute(f'PRAGMA user_version = {self._schema.version}')
        database.execute('PRAGMA wal_checkpoint(TRUNCATE)')

    def _failure(self, error: Exception) -> SpoolError:
        """Turn an error into one of ours; set the database aside if the error means damage."""
        if self._is_damage(error):
            try:
                return SpoolDamagedError(self._mend(error) or self._set_aside(error))
            except (OSError, sqlite3.OperationalError) as failure:
                error = failure
        elif isinstance(error, sqlite3.OperationalError) and 'locked' in str(error):
            # Another process holds the lock.
            self._set_wait(_IMPATIENCE)
        return SpoolError(f'{self.folder}: {error}')

    def _is_damage(self, error: Exception) -> bool:
        """Return whether an error means a damaged file, rather than a disk or another process."""
        if isinstance(error, sqlite3.OperationalError) and 'readonly' in str(error):
            return self._is_refused()
        return _is_damage(error)

    def _is_refused(self) -> bool:
        """Return whether SQLite does not write a file that may be written: by its header."""
        if not all(os.access(path, os.W_OK) for path in (self._path, self.folder)):
            return False
        # Another connection: the one in use may be older than the right to write.
        with closing(sqlite3.connect(self._path, self._wait, isolation_level=None)) as database:
            try:
                database.execute('BEGIN IMMEDIATE')
            except sqlite3.Error as error:
                return 'readonly' in str(error)
        return False

    def _mend(self, error: Exception) -> str:
        """
        Rebuild the indexes, once for a database; return a text that says so, '' if in vain.

        Raises
        ------
        OSError, sqlite3.OperationalError
            If that cannot be done now, or another process has just done it.
        """
        if isinstance(error, sqlite3.OperationalError):
            # A table is missing, or the header is damaged.
            return ''
        uri = f'{self._path.resolve().as_uri()}?mode=rw'
        with closing(
            sqlite3.connect(uri, timeout=self._wait, isolation_level=None, uri=True)
        ) as database:
            database.text_factory = lossy_text
            try:
                with _transaction(database, write=True) as rows:
                    if not self._may_rebuild():
                        return ''
                    rows.execute('REINDEX')
                    (text,) = rows.execute('PRAGMA integrity_check(1)').fetchone()
                    if text != 'ok':
                        raise sqlite3.DatabaseError(text)
                    self._schema.on_rebuilt(rows)
            except (sqlite3.Error, UnicodeDecodeError) as failure:
                if not _is_damage(failure):
                    raise
                return ''
        return f'{self._path} was damaged; its indexes were rebuilt'

    def _may_rebuild(self) -> bool:
        """Take the one chance to rebuild the indexes; False if it is taken."""
        mark = self._path.with_name(self._path.name + _REBUILT)
        if not mark.exists():
            mark.touch()
            self._rebuilt = self._path
            return True
        if self._rebuilt != self._path and abs(time.time() - mark.stat().st_mtime) < _AFTERMATH:
            raise SpoolError(f'{self._path} was damaged; another process rebuilds its indexes')
        return False

    def _set_aside(self, error: object) -> str:
        """Mark the database in use as damaged; return a text that says so."""
        self._path.with_name(self._path.name + DAMAGED).touch()
        return f'{self._path} is damaged and set aside: {error}'

    def _set_wait(self, seconds: float) -> None:
        """Set how long to wait for locks from now on."""
        if seconds != self._wait and self._database is not None:
            self._database.execute(f'PRAGMA busy_timeout = {1000.0 * seconds:.0f}')
        self._wait = seconds

    def _new_path(self) -> Path:
        """Return a name that no database has had."""
        number = max(map(_number, catalogue_files(self.folder)), default=0)
        name = f'{self._schema.content}_{number + 1:04d}_{secrets.token_hex(3)}.sqlite3'
        return self.folder / name


def catalogue_files(folder: Path) -> list[Path]:
    """List the databases of a folder, the oldest first, damaged ones as well."""
    paths = (path for path in folder.glob('*_*.sqlite3') if _NAME.fullmatch(path.name))
    return sorted((path for path in paths if path.is_file()), key=_number)


def is_in_use(path: Path) -> bool:
    """Return whether a database is not marked as damaged."""
    return not path.with_name(path.name + DAMAGED).exists()


def _number(path: Path) -> int:
    """Return the number of a database within its folder."""
    return int(path.name.split('_')[1])


def _identity(path: str) -> tuple[int, int] | None:
    """Identify a file; None if there is none."""
    try:
        status = os.stat(path)
    except FileNotFoundError:
        return None
    return status.st_dev, status.st_ino


def _is_damage(error: Exception) -> bool:
    """Return whether an error means a damaged file, rather than a disk or another process."""
    if isinstance(error, sqlite3.OperationalError):
        text = str(error)
        return text.startswith(('no such', 'unsupported file format')) or 'no column named' in text
    # Damaged names make messages of SQLite that Python cannot read.
    return isinstance(error, sqlite3.DatabaseError | UnicodeDecodeError) and not isinstance(
        error, sqlite3.ProgrammingError | sqlite3.NotSupportedError
    )


def _tables(database: sqlite3.Connection) -> list[tuple[str, ...]]:
    """List what a database consists of, in SQL, without what SQLite adds."""
    return database.execute(
        'SELECT type, name, tbl_name, sql FROM sqlite_master WHERE name NOT LIKE ? ORDER BY name',
        ('sqlite_%',),
    ).fetchall()


@contextmanager
def _transaction(database: sqlite3.Connection, write: bool) -> Iterator[sqlite3.Cursor]:
    """Commit a `with` block at its end; roll it back after any error."""
    rows = database.cursor()
    rows.execute('BEGIN IMMEDIATE' if write else 'BEGIN')
    try:
        yield rows
        rows.execute('COMMIT')
    except BaseException:
        with suppress(sqlite3.Error):
            rows.execute('ROLLBACK')
        raise
    finally:
        rows.close()


def _locked(path: Path) -> int | None:
    """Lock a file; the lock lasts until the descriptor is closed or the process ends."""
    lock = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o666)
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        os.close(lock)
        return None
    return lock


@contextmanager
def _exclusive(path: Path, patience: float) -> Iterator[None]:
    """Run a `with` block in one process at a time; OperationalError if the wait is too long."""
    deadline = time.monotonic() + patience
    while (lock := _locked(path)) is None:
        if time.monotonic() > deadline:
            raise sqlite3.OperationalError(f'{path.name} is locked by another process')
        time.sleep(0.01)
    try:
        yield
    finally:
        os.close(lock)
