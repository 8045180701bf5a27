# SPDX-License-Identifier: Apache-2.0
"""The books of the ship lists, for the diagnostics of the nodes that use them."""

from __future__ import annotations

from obbhbb_ros.spool.list_spool import ListSpool

_ALWAYS = ('ships_added', 'ships_released', 'released', 'delivered', 'delivered_bytes')


def list_facts(lists: ListSpool) -> dict[str, str]:
    """
    List what the diagnostics say of ship lists.

    Raises
    ------
    obbhbb_ros.spool.catalogue.SpoolError
        If their books cannot be read now.
    """
    status = lists.status()
    facts = {
        'ships_waiting': status.ships_waiting + status.ships_claimed,
        'in_outbox': status.in_outbox,
        'set_aside': status.set_aside,
        **dict.fromkeys(_ALWAYS, 0),
        **dict(sorted(status.counts.items())),
    }
    return {f'lists.{name}': str(value) for name, value in facts.items()}
