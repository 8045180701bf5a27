# SPDX-License-Identifier: Apache-2.0
"""What labels cannot tell, however exact the figures look."""

from __future__ import annotations

import numpy as np

from obbhbb_ros.geometry.converter import HullRule
from obbhbb_ros.geometry.converter import convert_by_rule
from obbhbb_ros.study.ships import Ships

# Pixels. Of separately drawn boxes of tilted ships 3 % at most are that close to the outer boxes
# (HRSC2016, DIOR, SSDD, iSAID); whole pixels and an inclusive maximum differ by less.
_EQUAL = 1.0
# Degrees; the outer box of an upright one is that box, whatever the reference means.
_TILTED = 10.0


def cautions(ships: Ships) -> list[str]:
    """
    Say what figures about ships do not hold: one line each.

    Examples
    --------
    >>> from obbhbb_ros.study.hulls import synthetic_ships
    >>> cautions(synthetic_ships(aspects=2, angles=9))
    []
    """
    notes = []
    if ships.image_count == 1:
        notes.append(
            'note: all ships are in one image: there are no intervals, and nothing is significant'
        )
    tilted = ships.with_reference & (ships.tilt > _TILTED)
    rows = np.flatnonzero(tilted if tilted.any() else ships.with_reference)
    outer = convert_by_rule(ships.boxes[rows], HullRule('outer'))
    equal = np.count_nonzero((np.abs(outer - ships.reference[rows]) <= _EQUAL).all(axis=1))
    if 2 * equal > len(rows):
        which = f' of ships tilted by more than {_TILTED:g}°' if tilted.any() else ''
        notes.append(
            f'note: {equal} of {len(rows)} reference boxes{which} are the outer boxes of the '
            'oriented ones: they say nothing about hulls, and the best q for them is infinite'
        )
    return notes
