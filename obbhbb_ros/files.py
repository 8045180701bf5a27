# SPDX-License-Identifier: Apache-2.0
"""Atomic file writing: a file is written completely or not at all."""

from __future__ import annotations

import errno
import glob
import os
import secrets
import shutil
import tempfile
from collections.abc import Collection
from collections.abc import Iterable
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


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
    # Not before: that of a pipe behind /dev/stdout is no path.
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

    The others have the name of `path` with other suffixes. Existing files of that name with a
    suffix in `stale` do not fit the new file and are deleted.
    """
    path = Path(os.path.realpath(path))
    _prepare(path)
    with tempfile.TemporaryDirectory(prefix='.', dir=path.parent) as folder:
        main = Path(folder) / path.name
        yield main
        made = set(Path(folder).iterdir())
        # Readers would trust the index of the previous file.
        for old in path.parent.glob(f'{glob.escape(path.stem)}.*'):
            if old.suffix.lower() in stale and Path(folder) / old.name not in made:
                old.unlink()
        # Readers open the main file, so it comes last.
        for each in sorted(made, key=lambda each: each == main):
            _put_in_place(each, path.with_name(each.name))


@contextmanager
def making(path: Path) -> Iterator[Path]:
    """
    Provide the name of a temporary folder in a `with` block that becomes `path` if it succeeds.

    The block makes the folder. Missing parent folders are created. After any failure neither
    `path` nor anything temporary is there. The temporary folder has the same name, in another
    temporary folder beside `path`, where the block may put what it needs meanwhile.

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
        for made in partial.iterdir():
            with made.open('rb') as stream:
                os.fsync(stream.fileno())
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


def sync_folder(folder: Path) -> None:
    """Have the names of the files in a folder on disk."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _prepare(path: Path) -> None:
    """Create the parent folders, and refuse to replace a file without write permission."""
    if path.exists() and not os.access(path, os.W_OK):
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(path))
    path.parent.mkdir(parents=True, exist_ok=True)


def _put_in_place(made: Path, path: Path) -> None:
    """Flush a file to disk and move it to `path`, with the mode of the file it replaces."""
    with made.open('rb') as stream:
        os.fsync(stream.fileno())
    if path.exists():
        shutil.copymode(path, made)
    os.replace(made, path)
