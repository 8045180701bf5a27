# SPDX-License-Identifier: Apache-2.0
"""The ship lists of a node: every period, it puts the ships that it has seen into the spool."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from obbhbb_ros.nodes.list_report import list_facts
from obbhbb_ros.nodes.managed import ManagedNode
from obbhbb_ros.nodes.parts import Part
from obbhbb_ros.nodes.parts import steady_timer
from obbhbb_ros.nodes.spool_report import kind_of
from obbhbb_ros.reports.seen_ships import ShipCollector
from obbhbb_ros.reports.ship_report import MAX_SHIPS
from obbhbb_ros.reports.ship_report import ShipReport
from obbhbb_ros.reports.ship_report import most_valuable
from obbhbb_ros.settings.ship_tracker import TrackerSettings
from obbhbb_ros.spool.catalogue import SpoolError
from obbhbb_ros.spool.list_spool import ListSpool


class ShipLists(Part):
    """
    Puts the ships of a period into the spool, as one list.

    It keeps what it cannot store for the next period.

    Parameters
    ----------
    node : ManagedNode
        The node, with `report_period`.

    Attributes
    ----------
    collector : ShipCollector
        Takes note of the ships of an image.
    """

    def __init__(self, node: ManagedNode[TrackerSettings]) -> None:
        self.collector = ShipCollector()
        self._node = node
        self._spool: ListSpool | None = None
        self._timer: Any = None
        self._kept: list[ShipReport] = []
        node.parts.append(self)
        node.reporter.add_facts(self._facts)

    def configure(self) -> None:
        """Forget all ships."""
        self.collector.take()
        self._spool = ListSpool(Path(self._node.parameters.settings.reports.spool_path), self._warn)

    def activate(self) -> None:
        """Begin a period."""
        self._timer = steady_timer(
            self._node, self._node.parameters.settings.reports.period, self._store
        )

    def deactivate(self) -> None:
        """End the period, and list its ships."""
        if self._timer is not None:
            self._node.destroy_timer(self._timer)
            self._timer = None
        self._store()

    def cleanup(self) -> None:
        """Close the spool."""
        if self._spool is not None:
            self._spool.close()
            self._spool = None

    def _store(self) -> None:
        """Put the ships since the last list into the spool."""
        ships = [*self._kept, *self.collector.take()]
        if self._spool is None or not ships:
            return
        try:
            self._spool.add(ships, self._node.parameters.settings.reports.max_bytes)
            self._kept = []
        except SpoolError as error:
            self._warn(str(error))
            self._kept = most_valuable(ships, MAX_SHIPS)
            self._node.monitor.add('ships_dropped', len(ships) - len(self._kept))

    def _facts(self) -> dict[str, str]:
        """Report how many ships the next list has, and the books of the lists."""
        facts = {'ships_to_list': str(len(self.collector) + len(self._kept))}
        if self._spool is not None:
            try:
                facts |= list_facts(self._spool)
            except SpoolError as error:
                self._warn(str(error))
        return facts

    def _warn(self, text: str) -> None:
        """Report trouble with the spool."""
        self._node.monitor.add('spool_troubles')
        self._node.reporter.warn(kind_of(text), f'spool: {text}')
