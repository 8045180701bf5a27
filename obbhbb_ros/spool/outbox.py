# SPDX-License-Identifier: Apache-2.0
"""
The outbox: a folder from which the bus takes chips, each with a JSON file that describes it.

A chip is complete when its JSON is there: both are written under other names, and the JSON gets
its name last.
"""

from __future__ import annotations

import json
import os
import re
import secrets
from collections.abc import Collection
from collections.abc import Sequence
from dataclasses import dataclass
from dataclasses import field
from pathlib import Path
from typing import Any

from obbhbb_ros.files import replacing
from obbhbb_ros.files import sync_folder
from obbhbb_ros.spool.seals import sealed

JSON_SUFFIX = '.json'
# Prefix of hidden files, such as unfinished ones.
_HIDDEN = '.'
_TOKEN = '.outbox'
# Unfinished files, as `replacing` names them.
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
        folder = self.folder / str(level)
        if not folder.exists():
            # The outbox itself is not created here: if it is gone, it may be unmounted.
            folder.mkdir(exist_ok=True)
            sync_folder(self.folder)
        chip, described = folder / f'{chip_id}.{suffix}', folder / f'{chip_id}{JSON_SUFFIX}'
        try:
            for path, content in ((chip, data), (described, json_bytes(description))):
                with replacing(path) as partial:
                    partial.write_bytes(content)
                # The name of the chip must be on disk before that of its JSON.
                sync_folder(folder)
        except OSError:
            if not described.exists():
                chip.unlink(missing_ok=True)
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
                    contents.bytes += entry.stat().st_size
                except FileNotFoundError:
                    # The bus has just taken it.
                    continue
                chip_id, suffix = os.path.splitext(entry.name)
                contents.ids.add(chip_id)
                if suffix == JSON_SUFFIX:
                    contents.complete.add(chip_id)
        return contents

    def remove_unfinished(self, ids: Collection[str]) -> None:
        """Remove files without a final name, and the files of some chips."""
        for folder in self._levels():
            for path in list(folder.iterdir()):
                if _UNFINISHED.fullmatch(path.name) or path.stem in ids:
                    path.unlink(missing_ok=True)

    def token(self) -> str:
        """Return an identifier of this outbox, which an empty mount point does not have."""
        path = self.folder / _TOKEN
        if not path.exists():
            with replacing(path) as partial:
                partial.write_text(secrets.token_hex(8), encoding='ascii')
            sync_folder(self.folder)
        return path.read_text(encoding='ascii', errors='replace')

    def _levels(self) -> list[Path]:
        """List the subfolders."""
        return [path for path in self.folder.iterdir() if path.name.isdigit() and path.is_dir()]


def json_bytes(description: dict[str, Any]) -> bytes:
    """Return the content of the JSON file of a chip; it ends with a digest of itself."""
    return sealed(json.dumps(description, ensure_ascii=False).encode(errors='replace'))


def level_of(value: float, thresholds: Sequence[float]) -> int:
    """
    Return the level of priority of a value: how many thresholds are above it.

    Examples
    --------
    >>> [level_of(value, (0.5, 0.8)) for value in (0.9, 0.8, 0.6, 0.1)]
    [0, 0, 1, 2]
    """
    return sum(value < threshold for threshold in thresholds)
