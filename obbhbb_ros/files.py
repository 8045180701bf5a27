# SPDX-License-Identifier: Apache-2.0
"""Files that are written completely or not at all, and read within bounds."""

from __future__ import annotations

import errno
import glob
import os
import secrets
import shutil
import stat
import tempfile
from collections.abc import Collection
from collections.abc import Iterable
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

# Files of some file systems say that they have no bytes.
SMALL_BYTES = 1 << 16


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """
    Provide a temporary file in a `with` block that replaces `path` if the block succeeds.

    Missing parent folders are created. After any failure, including a full disk, an existing file
    is unchanged, no temporary file remains, and the OSError names `path`. The temporary file is in
    the same folder and has the same suffix; a device or pipe is written directly.

    Examples
    --------
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     with replacing(Path(folder) / 'a' / 'labels.txt') as partial:
    ...         _ = partial.write_text('ship')
    ...     (Path(folder) / 'a' / 'labels.txt').read_text()
    'ship'
    """
    if path.exists() and not path.is_file():
        yield path
        return
    # Only now: a pipe behind /dev/stdout has no real path.
    path = Path(os.path.realpath(path))
    _prepare(path)
    partial = path.with_name(f'.{secrets.token_hex(4)}{path.suffix}')
    try:
        yield partial
        _put_in_place(partial, path)
    except OSError as error:
        raise OSError(error.errno, error.strerror or str(error), str(path)) from error
    finally:
        partial.unlink(missing_ok=True)


@contextmanager
def replacing_all(path: Path, stale: Collection[str] = ()) -> Iterator[Path]:
    """
    Provide a temporary file as `replacing` does, for formats that write several files.

    The other files have the name of `path` with other suffixes. Existing files of that name with a
    suffix in `stale` would not match the new file and are deleted.
    """
    path = Path(os.path.realpath(path))
    _prepare(path)
    with tempfile.TemporaryDirectory(prefix='.', dir=path.parent) as folder:
        main = Path(folder) / path.name
        yield main
        partials = set(Path(folder).iterdir())
        # Readers would trust the index of the previous file.
        for old in path.parent.glob(f'{glob.escape(path.stem)}.*'):
            if old.suffix.lower() in stale and Path(folder) / old.name not in partials:
                old.unlink()
        # Readers open the main file, so it comes last.
        for partial in sorted(partials, key=lambda partial: partial == main):
            _put_in_place(partial, path.with_name(partial.name))


@contextmanager
def making(path: Path) -> Iterator[Path]:
    """
    Provide the path of a temporary folder in a `with` block that becomes `path` if it succeeds.

    The block creates the folder; missing parent folders are created. After a failure neither
    `path` nor a temporary file remains. The temporary folder has the same name and is in another
    temporary folder beside `path`, where the block may put other temporary files.

    Raises
    ------
    FileExistsError
        If `path` exists.
    """
    if path.exists():
        raise FileExistsError(errno.EEXIST, os.strerror(errno.EEXIST), str(path))
    path = Path(os.path.realpath(path))
    path.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix='.', dir=path.parent) as folder:
        partial = Path(folder) / path.name
        yield partial
        for file in partial.iterdir():
            _flush(file)
        partial.rename(path)


def write_text(path: Path, text: str) -> None:
    """Write a text as UTF-8 with `replacing`."""
    write_pieces(path, (text,))


def write_bytes(path: Path, data: bytes) -> None:
    """Write a file with `replacing`."""
    with replacing(path) as partial:
        partial.write_bytes(data)


def write_pieces(path: Path, pieces: Iterable[str]) -> None:
    """Write a text as UTF-8 with `replacing`, piece by piece to save memory."""
    with replacing(path) as partial, partial.open('w', encoding='utf-8', newline='') as stream:
        stream.writelines(pieces)


def read_bounded(path: Path, max_bytes: int) -> bytes:
    """
    Read a regular file that may be of any size or kind.

    Raises ValueError, without the name of the file, if it is a pipe or device, which could block or
    have no end, or larger than `max_bytes`.
    """
    # Without waiting for the other end of a pipe.
    descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    try:
        status = os.fstat(descriptor)
        if not stat.S_ISREG(status.st_mode):
            raise ValueError('not a regular file')
        if status.st_size > max_bytes:
            raise ValueError(f'{status.st_size} bytes, the maximum is {max_bytes}')
        with open(descriptor, 'rb', closefd=False) as stream:
            # All that is asked for is allocated at once.
            return stream.read(min(max_bytes, max(status.st_size, SMALL_BYTES)))
    finally:
        os.close(descriptor)


def sync_folder(folder: Path) -> None:
    """Flush the entries of a folder, the names of its files, to disk."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _prepare(path: Path) -> None:
    """Create the parent folders; raise PermissionError if an existing file is read-only."""
    if path.exists() and not os.access(path, os.W_OK):
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(path))
    path.parent.mkdir(parents=True, exist_ok=True)


def _put_in_place(partial: Path, path: Path) -> None:
    """Flush a file to disk and move it to `path`, with the mode of the file it replaces."""
    _flush(partial)
    if path.exists():
        shutil.copymode(path, partial)
    os.replace(partial, path)


def _flush(file: Path) -> None:
    """Flush a file to disk."""
    with file.open('rb') as stream:
        os.fsync(stream.fileno())
