# SPDX-License-Identifier: Apache-2.0
"""Files are written whole or not at all."""

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
    Give a file to write in a `with` block; it takes the place of another when the block ends well.

    Folders above are made. Whatever fails, also a disk that fills up, leaves an older file as it
    was and nothing beside it.

    Parameters
    ----------
    path : Path
        The file that is wanted. A device or a pipe is written to as it is.

    Yields
    ------
    Path
        A file beside it that does not exist yet, with the same suffix.

    Raises
    ------
    OSError
        If it cannot be written; it names `path`.
    """
    path = Path(os.path.realpath(path))
    if path.exists() and not path.is_file():
        yield path
        return
    _check_writable(path)
    path.parent.mkdir(parents=True, exist_ok=True)
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
    Give a file to write, as `replacing` does, for formats that put more files beside it.

    Parameters
    ----------
    path : Path
        The file that is wanted; the others have its name with suffixes of their own.
    stale : collection of str
        Suffixes of files beside an older file that do not fit a new one, and go with it.

    Yields
    ------
    Path
        A file of that name in a folder of its own.

    Raises
    ------
    OSError
        If one of them cannot be written.
    """
    path = Path(os.path.realpath(path))
    _check_writable(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix='.', dir=path.parent) as folder:
        wanted = Path(folder) / path.name
        yield wanted
        made = set(Path(folder).iterdir())
        # An index of the file that was there before would be believed.
        for old in path.parent.glob(f'{glob.escape(path.stem)}.*'):
            if old.suffix.lower() in stale and Path(folder) / old.name not in made:
                old.unlink()
        # The one that readers open comes last.
        for each in sorted(made, key=lambda each: each == wanted):
            _put_in_place(each, path.with_name(each.name))


def write_text(path: Path, text: str) -> None:
    """Write a text as UTF-8, whole or not at all, see `replacing`."""
    write_pieces(path, (text,))


def write_pieces(path: Path, pieces: Iterable[str]) -> None:
    """Write a text piece by piece, as `write_text` does; a long one is never in memory at once."""
    with replacing(path) as partial, partial.open('w', encoding='utf-8', newline='') as stream:
        stream.writelines(pieces)


def _check_writable(path: Path) -> None:
    """Refuse to replace a file that may not be written to."""
    if path.exists() and not os.access(path, os.W_OK):
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(path))


def _put_in_place(made: Path, path: Path) -> None:
    """Replace a file by one that is safe on the disk."""
    with made.open('rb') as stream:
        os.fsync(stream.fileno())
    if path.exists():
        shutil.copymode(path, made)
    os.replace(made, path)
