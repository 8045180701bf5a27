# SPDX-License-Identifier: Apache-2.0
"""
The outbox: a folder from which the bus takes chips, each with a JSON file that describes it.

A chip is complete when its JSON is there: both are written under other names, and the JSON gets
its name last.
"""

from __future__ import annotations

import errno
import fcntl
import json
import os
import re
import secrets
import stat
from collections.abc import Collection
from collections.abc import Iterator
from collections.abc import Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from dataclasses import field
from pathlib import Path
from typing import Any

from obbhbb_ros.files import sync_folder
from obbhbb_ros.spool.seals import sealed

JSON_SUFFIX = '.json'
# Prefix of hidden files, such as unfinished ones.
_HIDDEN = '.'
_TOKEN = '.outbox'
# A token has 16 characters; anything else in its place may be endless.
_MAX_TOKEN = 64
# Unfinished files, as `_hidden_name` names them.
_UNFINISHED = re.compile(r'\.[0-9a-f]{8}\.\w+')


@dataclass
class Contents:
    """
    What is in an outbox.

    Attributes
    ----------
    ids : set of str
        Ids of the chips of which any file is there.
    complete : set of str
        Ids of the chips with JSON; without a chip file, the bus is removing them.
    bytes : int
        Bytes of all files.
    """

    ids: set[str] = field(default_factory=set)
    complete: set[str] = field(default_factory=set)
    bytes: int = 0


class Outbox:
    """
    An outbox folder, with a subfolder for each level of priority, '0' for the most valuable.

    Parameters
    ----------
    folder : Path
        The folder; `token` creates it if it is missing.

    Examples
    --------
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     outbox = Outbox(Path(folder))
    ...     outbox.put('5_000000000_a1b2c3_1', 'jpg', b'...', {'value': 0.7}, level=1)
    ...     sorted(str(path.relative_to(folder)) for path in Path(folder).glob('*/*'))
    ['1/5_000000000_a1b2c3_1.jpg', '1/5_000000000_a1b2c3_1.json']
    """

    def __init__(self, folder: Path) -> None:
        self.folder = Path(folder)
        # Hidden JSON files, and the names that they get.
        self._unnamed: list[tuple[Path, Path]] = []
        self._lock: int | None = None

    def put(
        self, chip_id: str, suffix: str, data: bytes, description: dict[str, Any], level: int
    ) -> None:
        """
        Write a chip and its JSON; both are on disk when this returns.

        Raises
        ------
        OSError
            If it cannot be written.
        """
        self.add(chip_id, suffix, data, json_bytes(description), level)
        self.finish()

    def add(self, chip_id: str, suffix: str, data: bytes, description: bytes, level: int) -> None:
        """
        Write a chip and its JSON, as bytes; until `finish` gives that its name, nobody takes it.

        Raises
        ------
        OSError
            If it cannot be written.
        """
        folder = self.folder / str(level)
        if not folder.exists():
            # The outbox itself is not created here: if it is gone, it may be unmounted.
            folder.mkdir(exist_ok=True)
            sync_folder(self.folder)
        chip, described = folder / f'{chip_id}.{suffix}', folder / f'{chip_id}{JSON_SUFFIX}'
        partials = [_hidden_name(chip), _hidden_name(described)]
        try:
            for partial, content in zip(partials, (data, description), strict=True):
                _write(partial, content)
            _name(partials[0], chip)
        except OSError:
            for path in (*partials, *([] if described.exists() else [chip])):
                path.unlink(missing_ok=True)
            raise
        self._unnamed.append((partials[1], described))

    def finish(self) -> None:
        """
        Complete the chips that were added; they are on disk when this returns.

        Raises
        ------
        OSError
            If that cannot be done; then some of them may be complete.
        """
        unnamed, self._unnamed = self._unnamed, []
        folders = {described.parent for _, described in unnamed}
        try:
            # The names of the chips must be on disk before those of their JSON.
            for folder in folders:
                sync_folder(folder)
            for partial, described in unnamed:
                _name(partial, described)
            for folder in folders:
                sync_folder(folder)
        except OSError:
            for partial, described in unnamed:
                if not described.exists():
                    partial.unlink(missing_ok=True)
                    self._remove(described.parent, {described.stem})
            raise

    def holds(self, chip_id: str, level: int) -> bool:
        """Return whether a chip is complete in the folder of a level."""
        return (self.folder / str(level) / f'{chip_id}{JSON_SUFFIX}').exists()

    def contents(self) -> Contents:
        """List what is in the outbox; OSError if it cannot be read."""
        contents = Contents()
        for folder in self._levels():
            for entry in os.scandir(folder):
                if entry.name.startswith(_HIDDEN):
                    continue
                try:
                    status = entry.stat(follow_symlinks=False)
                except FileNotFoundError:
                    # The bus has just taken it.
                    continue
                # Folders and links are not ours.
                if not stat.S_ISREG(status.st_mode):
                    continue
                contents.bytes += status.st_size
                chip_id, _, suffix = entry.name.partition('.')
                contents.ids.add(chip_id)
                if f'.{suffix}' == JSON_SUFFIX:
                    contents.complete.add(chip_id)
        return contents

    def remove_unfinished(self, ids: Collection[str]) -> None:
        """Remove files without a final name, and the files of some chips."""
        for folder in self._levels():
            self._remove(folder, ids, _UNFINISHED)

    def token(self) -> str:
        """Return an identifier of this outbox, which an empty mount point does not have."""
        path = self.folder / _TOKEN
        if not os.path.lexists(path):
            self.folder.mkdir(parents=True, exist_ok=True)
            partial = _hidden_name(path)
            _write(partial, secrets.token_hex(8).encode('ascii'))
            _name(partial, path)
            sync_folder(self.folder)
        with _opened_token(path) as descriptor:
            return os.read(descriptor, _MAX_TOKEN).decode('ascii', errors='replace')

    def lock(self) -> None:
        """
        Lock the outbox until `close`, so that no other process releases into it.

        Raises
        ------
        OSError
            If another process does.
        """
        with _opened_token(self.folder / _TOKEN) as descriptor:
            if self._lock is not None and os.path.samestat(
                os.fstat(descriptor), os.fstat(self._lock)
            ):
                return
            try:
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                raise OSError(
                    f'{self.folder}: another process releases into this outbox; each chain needs '
                    'its own spool.path and outbox.path'
                ) from None
            self.close()
            self._lock = os.dup(descriptor)

    def close(self) -> None:
        """Release the lock."""
        if self._lock is not None:
            os.close(self._lock)
        self._lock = None

    def _levels(self) -> list[Path]:
        """List the subfolders."""
        return [path for path in self.folder.iterdir() if path.name.isdigit() and path.is_dir()]

    @staticmethod
    def _remove(
        folder: Path, ids: Collection[str], others: re.Pattern[str] = re.compile('(?!)')
    ) -> None:
        """Remove the files of chips, and files whose name matches a pattern, but no folder."""
        for path in list(folder.iterdir()):
            is_unwanted = path.name.partition('.')[0] in ids or others.fullmatch(path.name)
            if is_unwanted and (path.is_symlink() or not path.is_dir()):
                path.unlink(missing_ok=True)


def _hidden_name(path: Path) -> Path:
    """Return the name of a file that is not finished."""
    return path.with_name(f'{_HIDDEN}{secrets.token_hex(4)}{path.suffix or ".tmp"}')


def _write(path: Path, content: bytes) -> None:
    """Write a new file and flush it to disk."""
    with path.open('xb') as stream:
        stream.write(content)
        stream.flush()
        os.fsync(stream.fileno())


def _name(partial: Path, path: Path) -> None:
    """Give a finished file its name; replace a file that has it, move a folder out of the way."""
    try:
        os.replace(partial, path)
    except IsADirectoryError:
        os.rename(path, path.with_name(f'{_HIDDEN}{secrets.token_hex(4)}{_HIDDEN}{path.name}'))
        os.replace(partial, path)


@contextmanager
def _opened_token(path: Path) -> Iterator[int]:
    """Open the file of a token for a `with` block, without following a link or waiting."""
    descriptor = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC)
    try:
        if not stat.S_ISREG(os.fstat(descriptor).st_mode):
            raise OSError(errno.EINVAL, 'not a regular file; remove it', str(path))
        yield descriptor
    finally:
        os.close(descriptor)


def json_bytes(description: dict[str, Any]) -> bytes:
    """Return the content of the JSON file of a chip; it ends with a digest of itself."""
    return sealed(json.dumps(description, ensure_ascii=False).encode(errors='replace'))


def level_of(rank: float, thresholds: Sequence[float]) -> int:
    """
    Return the level of priority of a rank: how many thresholds are above it.

    Examples
    --------
    >>> [level_of(rank, (0.5, 0.8)) for rank in (0.9, 0.8, 0.6, 0.1)]
    [0, 0, 1, 2]
    """
    return sum(rank < threshold for threshold in thresholds)
