# SPDX-License-Identifier: Apache-2.0
"""Parameters and settings of the node `chip_extractor`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from obbhbb_ros.downlink.budget import BudgetSettings
from obbhbb_ros.downlink.chips import CODECS
from obbhbb_ros.downlink.chips import CodecSettings
from obbhbb_ros.downlink.joiner import PairLimits
from obbhbb_ros.downlink.joiner import PartLimits
from obbhbb_ros.settings.common import COMMON
from obbhbb_ros.settings.common import IMAGES_KEPT
from obbhbb_ros.settings.common import INPUT_TIMEOUT
from obbhbb_ros.settings.common import LINK
from obbhbb_ros.settings.common import PLANS_KEPT
from obbhbb_ros.settings.common import folder_of
from obbhbb_ros.settings.parameters import MAX_BYTES
from obbhbb_ros.settings.parameters import MAX_INT
from obbhbb_ros.settings.parameters import Parameter
from obbhbb_ros.settings.parameters import ParameterTable
from obbhbb_ros.settings.parameters import group_of


@dataclass(frozen=True)
class ChipSettings:
    """What one image is cut under: encoding, budget, how long its parts may wait, and the spool."""

    codec: CodecSettings
    budget: BudgetSettings
    pairing: PairLimits
    spool_path: str
    spool_max_bytes: float


def _chip_settings(values: Mapping[str, Any]) -> ChipSettings:
    """Make settings for `chip_extractor`."""
    return ChipSettings(
        codec=group_of(CodecSettings, values, ''),
        budget=group_of(BudgetSettings, values, 'budget.'),
        pairing=PairLimits(
            images=PartLimits(values['cache.images'], values['cache.max_age']),
            plans=PartLimits(values['cache.regions'], values['cache.max_age']),
            slop=values['cache.slop'],
        ),
        spool_path=folder_of(values, 'spool.path'),
        spool_max_bytes=values['spool.max_bytes'],
    )


CHIP_EXTRACTOR = ParameterTable(
    (
        *COMMON,
        INPUT_TIMEOUT,
        Parameter('codec', CodecSettings.codec, 'File format of the chips.', choices=tuple(CODECS)),
        Parameter(
            'quality',
            CodecSettings.quality,
            'Quality of jpeg and webp; for jpeg2000, percent of the size of the raw pixels.',
            1,
            100,
        ),
        Parameter(
            'lossless',
            CodecSettings.lossless,
            'Lossless compression; for webp and jpeg2000. png always is lossless.',
        ),
        *LINK,
        Parameter('budget.max_chips', 0, 'Maximum chips per image (0: unlimited).', 0, 1_000_000),
        Parameter('budget.max_bytes', 0, 'Maximum bytes per image (0: unlimited).', 0, MAX_INT),
        Parameter(
            'budget.min_quality',
            0,
            'A chip that does not fit is encoded again, down to this quality (0: dropped at once).',
            0,
            100,
        ),
        Parameter(
            'cache.images',
            IMAGES_KEPT,
            'Maximum images that wait for their regions; the oldest is dropped first.',
            1,
            1000,
        ),
        Parameter(
            'cache.regions',
            PLANS_KEPT,
            'Maximum crop plans that wait for their image; the oldest is dropped first.',
            1,
            100_000,
        ),
        Parameter(
            'cache.max_age',
            2.0,
            'How long images and crop plans wait for each other, seconds.',
            0.0,
            3600.0,
        ),
        Parameter(
            'cache.slop',
            0.0,
            'Maximum difference between the stamps of an image and its crop plan, seconds.',
            0.0,
            3600.0,
        ),
        Parameter(
            'spool.path',
            '',
            'Folder in which every planned chip is stored for the node downlink (empty: none).',
            read_only=True,
        ),
        Parameter(
            'spool.max_bytes',
            1e9,
            'Maximum size of the spool, bytes; the least valuable chips are evicted first '
            '(0: unlimited).',
            0.0,
            MAX_BYTES,
        ),
    ),
    _chip_settings,
)
"""Parameters of the node `chip_extractor`."""
