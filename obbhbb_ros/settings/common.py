# SPDX-License-Identifier: Apache-2.0
"""Parameters that several nodes have."""

from __future__ import annotations

import os
from collections.abc import Mapping
from typing import Any

from obbhbb_ros.limits import Choices
from obbhbb_ros.limits import Range
from obbhbb_ros.settings.parameters import Parameter
from obbhbb_ros.wire.image import IMAGE_SIZE_LIMIT

AUTOSTART = Parameter(
    'autostart',
    True,
    'Configure and activate the node at start. If false, a lifecycle manager does it.',
    read_only=True,
)
LOCK = Parameter(
    'lock_parameters',
    False,
    'Refuse all parameter changes after start. If false, anyone on the DDS domain can change them.',
    read_only=True,
)
HARDWARE_ID = Parameter(
    'hardware_id', '', "hardware_id in the diagnostics. Empty: the node's full name."
)
STATE_PATH = Parameter(
    'state.path',
    '',
    'Absolute path of a file in which the node records its counters and how it ended, for the next '
    'run to report. One file per node. Empty: off.',
    read_only=True,
)
WATCHDOG = Parameter(
    'watchdog_timeout',
    0.0,
    'If the executor is blocked for this many seconds (at least 2), the process exits with code 70 '
    'so that launch restarts it. 0: off.',
    Range(0.0, 1e6),
    read_only=True,
)
INPUT_TIMEOUT = Parameter(
    'input_timeout',
    0.0,
    'Without input for this many seconds the diagnostics report ERROR, and after three times as '
    'long STALE. 0: off.',
    Range(0.0, 1e6),
)
IMAGE_TRANSPORT = Parameter(
    'image_transport',
    'raw',
    'How images travel: `raw` on the topic `image`, or `compressed` as JPEG or PNG on the topic '
    '`<image>/compressed`.',
    Choices(('raw', 'compressed')),
    read_only=True,
)
COMMON = (AUTOSTART, LOCK, HARDWARE_ID, STATE_PATH, WATCHDOG)
"""Parameters of every managed node."""
COMMON_WITH_INPUT = (*COMMON, INPUT_TIMEOUT)
"""Parameters of every managed node that has an input."""


def size_rows(prefix: str, what: str) -> tuple[Parameter, ...]:
    """Make the parameters for the width and the height of something, pixels; 0 if it is unset."""
    return tuple(
        Parameter(
            f'{prefix}_{side}', 0, f'{side.capitalize()} of {what}', Range(0, IMAGE_SIZE_LIMIT)
        )
        for side in ('width', 'height')
    )


def folder_of(values: Mapping[str, Any], name: str) -> str:
    """
    Return the folder that a parameter names, an absolute path; empty if it names none.

    Raises
    ------
    ValueError
        If the path is not absolute; the message begins with the name of the parameter.
    """
    path = os.path.expanduser(values[name].strip())
    if path and not os.path.isabs(path):
        raise ValueError(f'{name} must be an absolute path, not {path}')
    return os.path.normpath(path) if path else ''


IMAGE_SIZE = size_rows('image', 'the image, pixels. 0: from `camera_info`.')
"""Size of the image in which detections lie."""
