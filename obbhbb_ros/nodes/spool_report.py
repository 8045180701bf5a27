# SPDX-License-Identifier: Apache-2.0
"""The books of a spool, for the diagnostics of the nodes that use it."""

from __future__ import annotations

from obbhbb_ros.spool.books import Status


def kind_of(text: str) -> str:
    """Return the kind of a message about a spool: its text without paths and numbers."""
    return ' '.join(word for word in text.split() if not any(map(str.isdigit, word)))


def facts_of(status: Status) -> dict[str, str]:
    """List what the diagnostics say of a spool."""
    counts = dict(status.counts)
    facts = {
        'spool.planned': counts.pop('planned', 0),
        'spool.released': counts.pop('released', 0),
        'spool.delivered': counts.pop('delivered', 0),
        'spool.delivered_bytes': counts.pop('delivered_bytes', 0),
        'spool.waiting': status.waiting,
        'spool.waiting_bytes': status.waiting_bytes,
        'spool.in_outbox': status.in_outbox,
        'spool.in_work': status.in_work,
        'spool.file_bytes': status.file_bytes,
        'spool.set_aside': status.set_aside,
    }
    facts.update({f'spool.{name}': count for name, count in sorted(counts.items())})
    return {name: str(value) for name, value in facts.items()}
