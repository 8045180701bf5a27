# SPDX-License-Identifier: Apache-2.0
"""The chip node's parameter table, and the snapshot that one frame is cut under."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from obbhbb_ros.downlink.budget import BudgetSettings
from obbhbb_ros.downlink.chips import CODECS
from obbhbb_ros.downlink.chips import CodecSettings
from obbhbb_ros.downlink.pairing import PairingLimits
from obbhbb_ros.nodes.managed import AUTOSTART
from obbhbb_ros.nodes.parameters import INT_LIMIT
from obbhbb_ros.nodes.parameters import LOCK
from obbhbb_ros.nodes.parameters import ParameterSpec
from obbhbb_ros.nodes.parameters import Values

_MOST_BYTES = 1e12

# What the middleware keeps through a stall, 1.6 s of images at 10 Hz, and then hands over at once,
# images and plans in any order: the cache holds as much.
IMAGES_KEPT = 16
PLANS_KEPT = 100

CHIP_TABLE: tuple[ParameterSpec, ...] = (
    AUTOSTART,
    LOCK,
    ParameterSpec('codec', 'jpeg', 'File format of the chips.', choices=tuple(CODECS)),
    ParameterSpec(
        'quality', 85,
        'Quality of jpeg and webp; for jpeg2000 percent of the size of the bare pixels.', 1, 100,
    ),
    ParameterSpec(
        'lossless', False,
        'Chips are exact to the bit; webp and jpeg2000 can be, png always is.',
    ),
    ParameterSpec(
        'budget.bytes_per_second', 0.0, 'What the link carries, bytes a second; 0 for no bound.',
        0.0, _MOST_BYTES,
    ),
    ParameterSpec(
        'budget.burst', 0.0,
        'What may be sent at once after a pause, bytes; 0 for what the link carries in a second.',
        0.0, _MOST_BYTES,
    ),
    ParameterSpec(
        'budget.overhead', 0,
        'What each chip costs the link besides its file, bytes.', 0, 1_000_000,
    ),
    ParameterSpec(
        'budget.max_chips', 0, 'At most so many chips a frame; 0 for no bound.', 0, 1_000_000,
    ),
    ParameterSpec(
        'budget.max_bytes', 0, 'Maximum bytes per frame (0: unlimited).',
        0, INT_LIMIT,
    ),
    ParameterSpec(
        'budget.min_quality', 0,
        'A chip that does not fit is encoded again, down to this quality; 0 to drop it at once.',
        0, 100,
    ),
    ParameterSpec(
        'cache.images', IMAGES_KEPT,
        'Maximum images that wait for their regions; the oldest is dropped first.', 1, 1000,
    ),
    ParameterSpec(
        'cache.regions', PLANS_KEPT,
        'Maximum crop plans that wait for their image; the oldest is dropped first.', 1, 100_000,
    ),
    ParameterSpec(
        'cache.max_age', 2.0,
        'For how long an image waits for its regions, and they for it, seconds.', 0.0, 3600.0,
    ),
)


@dataclass(frozen=True)
class ChipSettings:
    """What one frame is cut under: encoding, budget, and how long its parts may wait."""

    codec: CodecSettings
    budget: BudgetSettings
    pairing: PairingLimits


def build_chip_settings(values: Values | Mapping[str, Any]) -> ChipSettings:
    """
    Make a snapshot of parameter values.

    Parameters
    ----------
    values : mapping of str to value
        A value for each row of `CHIP_TABLE`.

    Returns
    -------
    ChipSettings
        The snapshot.

    Raises
    ------
    ValueError
        If the values do not fit together; the message names the parameter.
    """
    v: Mapping[str, Any] = values
    prefix = 'budget.'
    budget = {name[len(prefix):]: value for name, value in v.items() if name.startswith(prefix)}
    return ChipSettings(
        codec=CodecSettings(v['codec'], v['quality'], v['lossless']),
        budget=BudgetSettings(**budget),
        pairing=PairingLimits((v['cache.images'], v['cache.regions']), v['cache.max_age']),
    )
