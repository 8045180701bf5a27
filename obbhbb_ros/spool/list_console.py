# SPDX-License-Identifier: Apache-2.0
"""The operator's view of the ship lists of a spool."""

from __future__ import annotations

from collections.abc import Iterator

from obbhbb_ros.spool.chip_rows import ChipState
from obbhbb_ros.spool.list_rows import ShipListFile
from obbhbb_ros.spool.list_rows import StoredList
from obbhbb_ros.spool.list_spool import ListSpool


class ListConsole(ListSpool):
    """Shows the ship lists of a spool while others add and release them."""

    def files(self) -> Iterator[ShipListFile]:
        """Read the lists that the outbox does not have, as files; without damaged ones."""
        for row in self._unreleased():
            if row.read() is not None and row.data is not None:
                yield ShipListFile(self._id_of(row.seq), row.ships, row.data)

    def integrity(self) -> list[str]:
        """Check the structure of the catalogue and the lists in it; list what is wrong."""
        with self._catalogue.transaction() as rows:
            wrong = [text for (text,) in rows.execute('PRAGMA integrity_check') if text != 'ok']
        damaged = [row for row in self._unreleased() if row.read() is None]
        return wrong + [f'{self._id_of(row.seq)}: the list is damaged' for row in damaged]

    def _unreleased(self) -> list[StoredList]:
        """Read the lists that wait or are claimed."""
        with self._catalogue.transaction() as rows:
            return self._rows(rows, ChipState.CLAIMED) + self._rows(rows, ChipState.WAITING)
