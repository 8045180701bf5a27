# SPDX-License-Identifier: Apache-2.0
"""The books of a spool, for the diagnostics of the nodes that use it."""

from __future__ import annotations

from obbhbb_ros.spool.books import Status


def kind_of(text: str) -> str:
    """Return the kind of a message about a spool: its text without paths and numbers."""
    return ' '.join(word for word in text.split() if not any(map(str.isdigit, word)))


def facts_of(status: Status) -> dict[str, str]:
    """List what the diagnostics say of a spool."""
    facts = dict.fromkeys(('planned', 'released', 'delivered', 'delivered_bytes'), 0)
    facts |= vars(status) | dict(sorted(status.counts.items()))
    del facts['counts']
    return {f'spool.{name}': str(value) for name, value in facts.items()}
