# SPDX-License-Identifier: Apache-2.0
"""The spool of the chip node: every planned chip is stored in it, or counted with its reason."""

from __future__ import annotations

from collections.abc import Mapping
from collections.abc import Sequence
from pathlib import Path

from obbhbb_ros.nodes.lifecycle.managed import ManagedNode
from obbhbb_ros.nodes.lifecycle.parts import Part
from obbhbb_ros.nodes.spool_report import SpoolReport
from obbhbb_ros.nodes.spool_report import kind_of
from obbhbb_ros.settings.chip_extractor import ChipSettings
from obbhbb_ros.spool.catalogue import SpoolError
from obbhbb_ros.spool.chip_rows import NewChip
from obbhbb_ros.spool.writer import FrameTicket
from obbhbb_ros.spool.writer import SpoolWriter


class ChipSpool(Part):
    """
    Stores chips, if `spool.path` is set.

    Parameters
    ----------
    node : ManagedNode
        The node, with the parameters `spool.*`.
    """

    def __init__(self, node: ManagedNode[ChipSettings]) -> None:
        self._node = node
        self._writer: SpoolWriter | None = None
        self._report: SpoolReport | None = None
        node.parts.append(self)

    def configure(self) -> None:
        """Open the spool."""
        path = self._node.parameters.settings.spool_path
        if path:
            self._writer = SpoolWriter(Path(path), self._warn)
            self._report = SpoolReport(self._node.reporter, self._writer)
            self.set_fade()

    def cleanup(self) -> None:
        """Close the spool."""
        if self._writer is not None:
            self._writer.close()
            self._writer = self._report = None

    def set_fade(self) -> None:
        """Write down how much less repeated views of a ship count."""
        if self._writer is not None:
            fade = self._node.parameters.settings.spool_fade
            self._writer.set_fade(fade, self._on_fade_changed)

    def plan(self, chips: int) -> FrameTicket | None:
        """Write down that a frame is planned; None without a spool, and for a frame of no chips."""
        return self._writer.plan(chips) if self._writer is not None and chips else None

    def store(
        self, ticket: FrameTicket | None, chips: Sequence[NewChip], refused: Mapping[str, int]
    ) -> None:
        """Store the chips of a frame, or of a part of it, and why others are missing."""
        if self._writer is None or ticket is None:
            return
        part = ticket.part(len(chips) + sum(refused.values()))
        if not part.chips:
            return
        max_bytes = self._node.parameters.settings.spool_max_bytes
        is_stored = self._writer.store(part, chips, refused, max_bytes)
        self._node.monitor.add('chips_stored' if is_stored else 'chips_not_stored', len(chips))

    def facts(self) -> dict[str, str]:
        """List the books of the spool, for the diagnostics."""
        if self._writer is None or self._report is None:
            return {}
        self._writer.catch_up()
        try:
            return self._report.facts()
        except SpoolError as error:
            self._warn(str(error))
            return {}

    def _on_fade_changed(self, before: float) -> None:
        """Log that the ranks of waiting chips have changed."""
        fade = self._node.parameters.settings.spool_fade
        self._node.get_logger().info(f'spool.fade of the spool is now {fade:g}; it was {before:g}')

    def _warn(self, text: str) -> None:
        """Report trouble with the spool."""
        self._node.monitor.add('spool_troubles')
        self._node.reporter.warn(kind_of(text), f'spool: {text}')
