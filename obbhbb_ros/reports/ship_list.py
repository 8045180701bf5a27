# SPDX-License-Identifier: Apache-2.0
"""Read ship lists in any of their formats."""

from __future__ import annotations

from obbhbb_ros.reports.ship_geojson import GZIP_MAGIC
from obbhbb_ros.reports.ship_geojson import read_ship_geojson
from obbhbb_ros.reports.ship_message import MESSAGE_MAGIC
from obbhbb_ros.reports.ship_message import read_ship_message
from obbhbb_ros.reports.ship_report import ShipListError
from obbhbb_ros.reports.ship_report import ShipReport

__all__ = ['LIST_KIND', 'LIST_SUFFIXES', 'read_ship_list']

LIST_KIND = 'ships'
"""`kind` in the JSON of a ship list."""
LIST_SUFFIXES = {'geojson': 'geojson.gz', 'message': 'ships'}
"""Suffixes of the files of ship lists, by their `format` in the JSON."""


def read_ship_list(content: bytes) -> list[ShipReport]:
    """
    Read a ship list, gzipped GeoJSON or a binary message.

    Parameters
    ----------
    content : bytes
        The file.

    Raises
    ------
    ShipListError
        If it is neither, or damaged; nothing else, whatever the bytes.
    """
    if content.startswith(GZIP_MAGIC):
        return read_ship_geojson(content)
    if content.startswith(MESSAGE_MAGIC[:2]):
        return read_ship_message(content)
    raise ShipListError('not a ship list')
