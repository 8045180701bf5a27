# SPDX-License-Identifier: Apache-2.0
"""The books of a spool, for the diagnostics of the nodes that use it."""

from __future__ import annotations

from obbhbb_ros.spool.books import Status

# Counts to report even if they are 0.
_ALWAYS = ('planned', 'released', 'delivered', 'delivered_bytes')


def kind_of(text: str) -> str:
    """Return what a message about a spool has in common with others: all but names and numbers."""
    return ' '.join(word for word in text.split() if not any(map(str.isdigit, word)))


def facts_of(status: Status) -> dict[str, str]:
    """List what the diagnostics say of a spool."""
    facts = dict.fromkeys(_ALWAYS, 0) | dict(vars(status)) | dict(sorted(status.counts.items()))
    del facts['counts']
    return {f'spool.{name}': str(value) for name, value in facts.items()}
