# SPDX-License-Identifier: Apache-2.0
"""Parameters that several nodes have."""

from __future__ import annotations

import os
from collections.abc import Mapping
from typing import Any

from obbhbb_ros.settings.parameters import MAX_BYTES
from obbhbb_ros.settings.parameters import Parameter

# What the middleware keeps through a stall, 1.6 s of images at 10 Hz, and then hands over at once,
# images and plans in any order: the cache holds as much.
IMAGES_KEPT = 16
PLANS_KEPT = 100

AUTOSTART = Parameter(
    'autostart',
    True,
    'Configure and activate the node at start. If false, a lifecycle manager does it.',
    read_only=True,
)
LOCK = Parameter(
    'lock_parameters',
    False,
    'Refuse every parameter change after start. Anyone on the DDS domain can make one.',
    read_only=True,
)
INPUT_TIMEOUT = Parameter(
    'input_timeout',
    0.0,
    'Seconds without input after which the diagnostics report ERROR, and after three times as long '
    'STALE (0: never).',
    0.0,
    1e6,
)
HARDWARE_ID = Parameter(
    'hardware_id',
    '',
    "hardware_id in the diagnostics (empty: the node's full name).",
)
STATE_PATH = Parameter(
    'state.path',
    '',
    'File that tells the next run how this one ended, and its counters, as an absolute path; each '
    'node needs one of its own (empty: none).',
    read_only=True,
)
WATCHDOG = Parameter(
    'watchdog_timeout',
    0.0,
    'Seconds without a turn of the executor, 2 or more, after which the process ends with exit '
    'code 70, to be started again (0: never).',
    0.0,
    1e6,
    read_only=True,
)
COMMON = (AUTOSTART, LOCK, HARDWARE_ID, STATE_PATH, WATCHDOG)
"""Parameters of every managed node."""

LINK = (
    Parameter(
        'budget.bytes_per_second',
        0.0,
        'Rate of the link, bytes per second (0: unlimited).',
        0.0,
        MAX_BYTES,
    ),
    Parameter(
        'budget.burst',
        0.0,
        'Maximum bytes sent at once after a pause (0: one second at the rate of the link).',
        0.0,
        MAX_BYTES,
    ),
    Parameter(
        'budget.overhead',
        0,
        'Bytes that each chip costs the link besides its file.',
        0,
        1_000_000,
    ),
)
"""Parameters of the link, in every node that sends something over it."""


def folder_of(values: Mapping[str, Any], name: str) -> str:
    """Return the folder that a parameter names; empty if it names none."""
    path = os.path.expanduser(values[name].strip())
    if path and not os.path.isabs(path):
        raise ValueError(f'{name} must be an absolute path, not {path}')
    return os.path.normpath(path) if path else ''
