# SPDX-License-Identifier: Apache-2.0
"""A ship list as a row of the catalogue of lists, and as a pair of files in the outbox."""

from __future__ import annotations

import hashlib
import re
from contextlib import suppress
from typing import NamedTuple
from typing import TypeAlias

from obbhbb_ros.reports.ship_geojson import GZIP_MAGIC
from obbhbb_ros.reports.ship_list import LIST_KIND
from obbhbb_ros.reports.ship_list import LIST_SUFFIXES
from obbhbb_ros.reports.ship_list import read_ship_list
from obbhbb_ros.reports.ship_report import ShipListError
from obbhbb_ros.reports.ship_report import ShipReport
from obbhbb_ros.spool.chip_rows import ChipState
from obbhbb_ros.spool.compact_json import compact_bytes
from obbhbb_ros.spool.seals import digest_of

_LIST_ID = re.compile(f'{LIST_KIND}_[0-9a-f]{{6}}_[0-9]{{1,18}}')
LIST_JSON_ROOM = 256
"""Maximum bytes of the JSON of a list."""

STATES = (ChipState.WAITING, ChipState.CLAIMED, ChipState.RELEASED)
"""The states of a list."""
Blob: TypeAlias = bytes


class ShipListFile(NamedTuple):
    """
    A list that is released.

    Attributes
    ----------
    id : str
        Name of its files without suffix.
    ships : int
        How many ships it has.
    content : bytes
        Its file.
    """

    id: str
    ships: int
    content: bytes

    @property
    def format(self) -> str:
        """`geojson` or `message`."""
        return 'geojson' if self.content.startswith(GZIP_MAGIC) else 'message'

    @property
    def suffix(self) -> str:
        """Suffix of its file."""
        return LIST_SUFFIXES[self.format]

    @property
    def size(self) -> int:
        """Bytes of file and JSON."""
        return len(self.content) + len(self.json_bytes())

    def json_bytes(self) -> bytes:
        """Return the content of the JSON file beside it."""
        return compact_bytes(
            {
                'id': self.id,
                'kind': LIST_KIND,
                'format': self.format,
                'ships': self.ships,
                'bytes': len(self.content),
                'sha256': hashlib.sha256(self.content).hexdigest(),
            }
        )


class StoredList(NamedTuple):
    """
    A list of the catalogue.

    Attributes
    ----------
    seq : int
        Number of its row.
    state : int
        A `ChipState`.
    ships : int
        How many ships it has.
    max_bytes : int
        Maximum size of a message; 0 if it is GeoJSON.
    bytes : int
        Size of its file.
    outbox : str
        Token of the outbox that it was released into; empty before.
    digest : str
        Digest of all the rest.
    data : bytes or None
        While it waits, all ships as GeoJSON; when it is claimed, its file; then nothing.
    """

    seq: int
    state: int
    ships: int
    max_bytes: int
    bytes: int
    outbox: str
    digest: str
    data: Blob | None

    def with_digest(self) -> StoredList:
        """Return the list with its digest."""
        return self._replace(digest=self.own_digest())

    def own_digest(self) -> str:
        """Compute the digest of what it is."""
        head = f'{self.seq} {self.state} {self.ships} {self.max_bytes} {self.bytes} {self.outbox} '
        return digest_of(head.encode(errors='surrogatepass') + (self.data or b''))

    def mended(self) -> StoredList | None:
        """Return the list in the state that its digest says; None if it is damaged otherwise."""
        # Damage may have turned a field into anything.
        with suppress(TypeError):
            for state in (self.state, *STATES):
                row = self._replace(state=state)
                if row.digest == row.own_digest():
                    return row
        return None

    def read(self) -> list[ShipReport] | None:
        """Read the ships; None if the row is damaged."""
        # Damage may have turned a number or the file into anything.
        with suppress(TypeError, AttributeError, ShipListError):
            if self.data is not None and self.digest == self.own_digest():
                return read_ship_list(self.data)
        return None


LIST_COLUMNS = ', '.join(StoredList._fields)
"""The columns of a `StoredList`, in their order."""
LIST_INSERT = f'INSERT INTO lists ({LIST_COLUMNS}) VALUES (?, ?, ?, ?, ?, ?, ?, ?)'
"""A statement that stores a `StoredList`."""


def names_list(file_id: str) -> bool:
    """Return whether an id is that of a ship list."""
    return _LIST_ID.fullmatch(file_id) is not None
