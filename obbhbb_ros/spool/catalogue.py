# SPDX-License-Identifier: Apache-2.0
"""
A database in a folder, that survives what happens to it: transactions, damage, deletion.

Several processes may use it at once. A database that is damaged is left where it is, with a mark,
and a new one begins. A new one never has the name of an old one: a process that still has the old
one open would delete the files of the new one.
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
from contextlib import contextmanager
from contextlib import suppress
from pathlib import Path
from typing import TypeVar

from obbhbb_ros.files import sync_folder

T = TypeVar('T')

_NAME = re.compile(r'chips_([0-9]+)_[0-9a-f]{6}\.sqlite3')
# Stands beside a database that is not used any more.
DAMAGED = '.damaged'
# Seconds to wait for a process that has it locked, and once that was in vain.
PATIENCE, _IMPATIENCE = 5.0, 0.05


class SpoolError(OSError):
    """The spool cannot be used now; the text says why."""


class Catalogue:
    """
    One process's access to the database of a folder, which it opens when it is first needed.

    It belongs to one thread at a time.

    Parameters
    ----------
    folder : Path
        Where it is; made if it is missing.
    schema : str
        SQL script that makes the tables.
    version : int
        Version of the schema; a database of another one is treated as damaged.
    on_trouble : callable
        Called with a text about everything that an operator should know.
    on_open : callable
        Called with a cursor in a transaction whenever the database is opened, if given.
    patience : float
        Seconds to wait for another process to unlock it; next to none until it is unlocked once
        that was in vain, so that nothing else is held up each time.

    Attributes
    ----------
    tag : str
        Six letters and figures that no other database has.
    """

    def __init__(
        self,
        folder: Path,
        schema: str,
        version: int,
        on_trouble: Callable[[str], object],
        on_open: Callable[[sqlite3.Cursor], object] | None = None,
        patience: float = PATIENCE,
    ) -> None:
        self._folder = folder
        self._patience = self._waits = patience
        self._schema, self._version = schema, version
        self._on_trouble, self._on_open = on_trouble, on_open
        self._database: sqlite3.Connection | None = None
        self._path, self._inode = folder, 0
        self._locks: list[int] = []
        self.tag = ''

    @property
    def set_aside(self) -> int:
        """Number of damaged databases in the folder."""
        return len(list(self._folder.glob(f'*{DAMAGED}')))

    def run(self, work: Callable[[sqlite3.Cursor], T], writing: bool = False) -> T:
        """
        Do some work in a transaction, in a new database if the one in use is damaged.

        Parameters
        ----------
        work : callable
            Called with a cursor; may be called twice.
        writing : bool
            Whether it changes anything.

        Returns
        -------
        T
            What the work returns. Its changes are on disk.

        Raises
        ------
        SpoolError
            If that is not possible. Then nothing has changed.
        """
        try:
            try:
                return self._transact(work, writing)
            except sqlite3.DatabaseError as error:
                if not _is_damage(error):
                    raise
                self._mark(self._path, error)
                return self._transact(work, writing)
        except SpoolError:
            raise
        except (sqlite3.Error, OSError) as error:
            if _is_locked(error):
                self._wait(_IMPATIENCE)
            raise SpoolError(f'{self._folder}: {error}') from error

    def lock(self, name: str) -> bool:
        """Lock a name as long as the database is open; False if another process has it."""
        lock = _locked(self._folder / f'{name}.lock')
        if lock is not None:
            self._locks.append(lock)
        return lock is not None

    def close(self) -> None:
        """Close the database and let go of the locks."""
        if self._database is not None:
            with suppress(sqlite3.Error):
                self._database.close()
        self._database = None
        for lock in self._locks:
            os.close(lock)
        self._locks.clear()

    def _transact(self, work: Callable[[sqlite3.Cursor], T], writing: bool) -> T:
        """Do some work in a transaction."""
        if self._database is None or not self._is_current():
            self.close()
            self._open()
        assert self._database is not None
        with _transaction(self._database, writing) as rows:
            result = work(rows)
        if writing:
            self._wait(self._patience)
        return result

    def _wait(self, seconds: float) -> None:
        """Set how long to wait for others from now on."""
        if seconds != self._waits and self._database is not None:
            self._database.execute(f'PRAGMA busy_timeout = {1000.0 * seconds:.0f}')
        self._waits = seconds

    def _is_current(self) -> bool:
        """Return whether the open file is still there and in use; say so if it is gone."""
        try:
            same = self._path.stat().st_ino == self._inode
        except OSError:
            same = False
        if not same:
            self._on_trouble(f'{self._path} was deleted or replaced, a new catalogue begins')
        return same and in_use(self._path)

    def _open(self) -> None:
        """Open the database in use, or a new one."""
        if not self._folder.exists():
            self._folder.mkdir(parents=True, exist_ok=True)
            sync_folder(self._folder.parent)
        with _alone(self._folder / 'open.lock', self._waits):
            path = self._in_use() or self._new_path()
            try:
                self._database = self._connected(path)
            except sqlite3.DatabaseError as error:
                if not _is_damage(error):
                    raise
                self._mark(path, error)
                path = self._new_path()
                self._database = self._connected(path)
        self._path, self._inode = path, path.stat().st_ino
        self.tag = path.stem.rpartition('_')[2]
        if self._on_open is not None:
            try:
                with _transaction(self._database, writing=True) as rows:
                    self._on_open(rows)
            except BaseException:
                self.close()
                raise

    def _connected(self, path: Path) -> sqlite3.Connection:
        """Open a file; make its tables if it is new."""
        database = sqlite3.connect(
            path, timeout=self._waits, isolation_level=None, check_same_thread=False
        )
        # Damaged text is found out where it is used.
        database.text_factory = lossy_text
        try:
            rows = database.cursor()
            # Small ones: a page is used again only when all of it is free.
            rows.execute('PRAGMA page_size = 2048')
            rows.execute('PRAGMA auto_vacuum = INCREMENTAL')
            rows.execute('PRAGMA journal_mode = WAL')
            # On disk, not only handed to the system, when a transaction ends.
            rows.execute('PRAGMA synchronous = FULL')
            (version,) = rows.execute('PRAGMA user_version').fetchone()
            if version == 0:
                with _transaction(database, writing=True) as rows:
                    for statement in _statements(self._schema):
                        rows.execute(statement)
                    rows.execute(f'PRAGMA user_version = {self._version}')
                sync_folder(path.parent)
            elif version != self._version:
                raise sqlite3.DatabaseError(f'its version is {version}, not {self._version}')
        except BaseException:
            database.close()
            raise
        return database

    def _in_use(self) -> Path | None:
        """Find the database in use."""
        return next((each for each in reversed(files(self._folder)) if in_use(each)), None)

    def _new_path(self) -> Path:
        """Make a name that no database had."""
        number = max(map(_number, files(self._folder)), default=0)
        return self._folder / f'chips_{number + 1:04d}_{secrets.token_hex(3)}.sqlite3'

    def _mark(self, path: Path, error: Exception) -> None:
        """Mark a database as damaged, once."""
        with suppress(FileExistsError):
            path.with_name(path.name + DAMAGED).touch(exist_ok=False)
            self._on_trouble(f'{path} is damaged and set aside: {error}')


def files(folder: Path) -> list[Path]:
    """List the databases of a folder, the oldest first, damaged ones as well."""
    found = (each for each in folder.glob('chips_*') if _NAME.fullmatch(each.name))
    return sorted((each for each in found if each.is_file()), key=_number)


def lossy_text(content: bytes) -> str:
    """Read a text, even if it is damaged."""
    return content.decode(errors='replace')


def _number(path: Path) -> int:
    """Return which database of its folder it is."""
    return int(path.name.split('_')[1])


def _is_damage(error: sqlite3.DatabaseError) -> bool:
    """Return whether an error means a damaged file; other errors have classes of their own."""
    return type(error) is sqlite3.DatabaseError


def _is_locked(error: Exception) -> bool:
    """Return whether an error means that another process has the database locked."""
    return isinstance(error, sqlite3.OperationalError) and 'locked' in str(error)


@contextmanager
def _transaction(database: sqlite3.Connection, writing: bool) -> Iterator[sqlite3.Cursor]:
    """Give a cursor; what is done with it is on disk at the end of the block, or not at all."""
    rows = database.cursor()
    rows.execute('BEGIN IMMEDIATE' if writing else 'BEGIN')
    try:
        yield rows
        rows.execute('COMMIT')
    except BaseException:
        with suppress(sqlite3.Error):
            rows.execute('ROLLBACK')
        raise
    finally:
        rows.close()


def _statements(script: str) -> Iterator[str]:
    """Split a script into statements; `executescript` would end the transaction."""
    statement = ''
    for line in script.splitlines(keepends=True):
        statement += line
        if sqlite3.complete_statement(statement):
            yield statement
            statement = ''


def in_use(path: Path) -> bool:
    """Return whether a database is not marked as damaged."""
    return not path.with_name(path.name + DAMAGED).exists()


def _locked(path: Path) -> int | None:
    """Lock a file until its descriptor is closed, at the end of the process at the latest."""
    lock = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o666)
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        os.close(lock)
        return None
    return lock


@contextmanager
def _alone(path: Path, patience: float) -> Iterator[None]:
    """Keep others out of a block; SpoolError if they do not leave it."""
    deadline = time.monotonic() + patience
    while (lock := _locked(path)) is None:
        if time.monotonic() > deadline:
            raise sqlite3.OperationalError(f'{path.name} is locked by another process')
        time.sleep(0.01)
    try:
        yield
    finally:
        os.close(lock)
