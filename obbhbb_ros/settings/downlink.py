# SPDX-License-Identifier: Apache-2.0
"""Parameters and settings of the node `downlink`."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from obbhbb_ros.downlink.budget import LinkSettings
from obbhbb_ros.limits import MAX_BYTES
from obbhbb_ros.limits import Choices
from obbhbb_ros.limits import Range
from obbhbb_ros.settings.common import COMMON
from obbhbb_ros.settings.common import folder_of
from obbhbb_ros.settings.parameters import Parameter
from obbhbb_ros.settings.parameters import ParameterTable
from obbhbb_ros.settings.parameters import rows_of
from obbhbb_ros.settings.parameters import settings_of
from obbhbb_ros.spool.feeder import ReleaseSettings


@dataclass(frozen=True)
class DownlinkSettings:
    """Where chips come from, where they go, and how they are released."""

    spool_path: str
    outbox_path: str
    always_in_contact: bool
    contact_timeout: float
    release: ReleaseSettings


def _downlink_settings(values: Mapping[str, Any]) -> DownlinkSettings:
    """Make settings for `downlink`."""
    spool, outbox = (folder_of(values, name) for name in ('spool.path', 'outbox.path'))
    for name, path in (('spool.path', spool), ('outbox.path', outbox)):
        if not path:
            raise ValueError(f'{name} is missing: name a folder')
    if os.path.commonpath((spool, outbox)) in (spool, outbox):
        raise ValueError(
            f'outbox.path and spool.path must be separate folders, not {outbox} and {spool}'
        )
    levels = values['outbox.levels']
    if any(math.isnan(level) for level in levels):
        raise ValueError('outbox.levels must be numbers, not nan')
    return DownlinkSettings(
        spool_path=spool,
        outbox_path=outbox,
        always_in_contact=values['contact'] == 'always',
        contact_timeout=values['contact_timeout'],
        release=ReleaseSettings(
            budget=settings_of(LinkSettings, values, 'budget.'),
            levels=tuple(levels),
            removal=values['acknowledge'] == 'removal',
            max_bytes=values['outbox.max_bytes'],
            is_compact=values['outbox.json'] == 'compact',
        ),
    )


DOWNLINK = ParameterTable(
    (
        *COMMON,
        Parameter(
            'contact',
            'always',
            'When chips are released: `always`, or while the topic `contact` is true.',
            Choices(('always', 'topic')),
        ),
        Parameter(
            'contact_timeout',
            0.0,
            'With `contact: topic`, contact counts as lost if no message renews it for this many '
            'seconds. 0: it lasts until a message ends it.',
            Range(0.0, 1e6),
        ),
        Parameter(
            'acknowledge',
            'release',
            'When a chip counts as delivered: on its `release` into the outbox, or on its '
            '`removal` from there.',
            Choices(('release', 'removal')),
        ),
        *rows_of(LinkSettings, 'budget.'),
        Parameter(
            'spool.path', '', 'Folder in which chip_extractor stores the chips.', read_only=True
        ),
        Parameter('outbox.path', '', 'Folder from which the bus takes the chips.', read_only=True),
        Parameter(
            'outbox.levels',
            [0.0],
            'Rank thresholds of the priority folders. Folder 0 takes chips at or above the '
            'highest threshold, folder 1 those at or above the next, and so on.',
        ),
        Parameter(
            'outbox.max_bytes',
            1e9,
            'Maximum bytes in the outbox; while it is full, chips wait in the spool. 0: unlimited.',
            Range(0.0, MAX_BYTES),
        ),
        Parameter(
            'outbox.json',
            'full',
            'Form of the JSON of chips: `full`; or `compact`, with no spaces, short numbers, and '
            'separate files for cameras.',
            Choices(('full', 'compact')),
        ),
    ),
    _downlink_settings,
)
"""Parameters of the node `downlink`."""
