# SPDX-License-Identifier: Apache-2.0
"""The books of a spool, for the diagnostics of the nodes that use it."""

from __future__ import annotations

from obbhbb_ros.nodes.reporter import Reporter
from obbhbb_ros.spool.access import SpoolAccess
from obbhbb_ros.spool.books import Status

_EVICTED = 'evicted.max_bytes'


class SpoolReport:
    """
    Reports the books of a spool, and warns while it is full and chips are evicted.

    Parameters
    ----------
    reporter : Reporter
        Receives the warnings.
    spool : SpoolAccess
        The spool.
    """

    def __init__(self, reporter: Reporter, spool: SpoolAccess) -> None:
        self._reporter, self._spool = reporter, spool
        # Unknown before the first report: earlier runs may have evicted chips, too.
        self._evicted: int | None = None

    def facts(self) -> dict[str, str]:
        """
        List what the diagnostics say of the spool.

        Raises
        ------
        obbhbb_ros.spool.catalogue.SpoolError
            If the spool cannot be read now.
        """
        status = self._spool.status()
        self._warn_of_evictions(status)
        facts = dict.fromkeys(('planned', 'released', 'delivered', 'delivered_bytes'), 0)
        facts |= vars(status) | dict(sorted(status.counts.items()))
        del facts['counts']
        return {
            f'spool.{name}': '' if value is None else str(value) for name, value in facts.items()
        }

    def _warn_of_evictions(self, status: Status) -> None:
        """Warn if chips were evicted since the last report."""
        total = status.counts.get(_EVICTED, 0)
        before, self._evicted = total if self._evicted is None else self._evicted, total
        # A catalogue that has just replaced another one counts from 0.
        evicted = total - before if total >= before else total
        if not evicted:
            return
        least = status.least_rank
        rest = 'no chip waits' if least is None else f'the lowest rank that waits is {least:.3g}'
        self._reporter.warn(
            'spool full',
            f'the spool is full: evicted {evicted} chips since the last report, {total} in all; '
            f'{rest}; see spool.max_bytes of chip_extractor',
        )


def kind_of(text: str) -> str:
    """Return the kind of a message about a spool: its text without paths and numbers."""
    return ' '.join(word for word in text.split() if not any(map(str.isdigit, word)))
