# SPDX-License-Identifier: Apache-2.0
"""Parameters and settings of the node `chip_extractor`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from obbhbb_ros.downlink.budget import BudgetSettings
from obbhbb_ros.downlink.chips import CodecSettings
from obbhbb_ros.downlink.joiner import PairLimits
from obbhbb_ros.limits import MAX_BYTES
from obbhbb_ros.limits import Range
from obbhbb_ros.settings.common import COMMON_WITH_INPUT
from obbhbb_ros.settings.common import IMAGE_TRANSPORT
from obbhbb_ros.settings.common import folder_of
from obbhbb_ros.settings.parameters import Parameter
from obbhbb_ros.settings.parameters import ParameterTable
from obbhbb_ros.settings.parameters import rows_of
from obbhbb_ros.settings.parameters import settings_of
from obbhbb_ros.spool.ranking import FADE


@dataclass(frozen=True)
class ChipSettings:
    """How one image is cut: encoding, budget, how long its parts wait, and the spool."""

    codec: CodecSettings
    budget: BudgetSettings
    pairing: PairLimits
    spool_path: str
    spool_max_bytes: float
    spool_fade: float


def _chip_settings(values: Mapping[str, Any]) -> ChipSettings:
    """Make settings for `chip_extractor`."""
    return ChipSettings(
        codec=settings_of(CodecSettings, values),
        budget=settings_of(BudgetSettings, values, 'budget.'),
        pairing=settings_of(PairLimits, values, 'cache.'),
        spool_path=folder_of(values, 'spool.path'),
        spool_max_bytes=values['spool.max_bytes'],
        spool_fade=values['spool.fade'],
    )


CHIP_EXTRACTOR = ParameterTable(
    (
        *COMMON_WITH_INPUT,
        IMAGE_TRANSPORT,
        *rows_of(CodecSettings),
        *rows_of(BudgetSettings, 'budget.'),
        *rows_of(PairLimits, 'cache.'),
        Parameter(
            'spool.path',
            '',
            'Folder in which every planned chip is stored for the node downlink. Empty: off.',
            read_only=True,
        ),
        Parameter(
            'spool.max_bytes',
            1e9,
            'Maximum size of the spool, bytes; a full spool evicts the chips of the lowest rank '
            'first. 0: unlimited.',
            Range(0.0, MAX_BYTES),
        ),
        Parameter(
            'spool.fade',
            FADE,
            'Factor on the value of a view for each better view of the same ship that waits or '
            'was released. 1: all views count in full.',
            Range(0.0, 1.0),
        ),
    ),
    _chip_settings,
)
"""Parameters of the node `chip_extractor`."""
