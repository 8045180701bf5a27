# SPDX-License-Identifier: Apache-2.0
"""Parameters of the nodes that read oriented detections."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from obbhbb_ros.geometry.input_frame import FITS
from obbhbb_ros.geometry.input_frame import InputFrame
from obbhbb_ros.settings.parameters import Parameter
from obbhbb_ros.wire.image import IMAGE_SIZE_LIMIT
from obbhbb_ros.wire.layouts import INPUT_TYPES

INPUT_TYPE = Parameter(
    'input_type',
    next(iter(INPUT_TYPES)),
    'Message type of the input; the topic is '
    + ', '.join(f'`{each.topic}` for {each.name}' for each in INPUT_TYPES.values())
    + '.',
    choices=tuple(INPUT_TYPES),
    read_only=True,
)
INPUT_COORDINATES = (
    Parameter(
        'angle_unit', 'rad', 'Unit of bbox.center.theta in the input.', choices=('rad', 'deg')
    ),
    Parameter(
        'input_width',
        0,
        "Width of the network's input, pixels, if detections are in its coordinates.",
        0,
        IMAGE_SIZE_LIMIT,
    ),
    Parameter(
        'input_height',
        0,
        "Height of the network's input, pixels, if detections are in its coordinates.",
        0,
        IMAGE_SIZE_LIMIT,
    ),
    Parameter(
        'input_fit',
        'none',
        'How the image was fitted to the input of the network: not at all, stretched, or '
        'scaled with equal margins on two sides.',
        choices=FITS,
    ),
)


def theta_scale(values: Mapping[str, Any]) -> float:
    """Return the factor from the input's angle unit to radians."""
    return math.pi / 180.0 if values['angle_unit'] == 'deg' else 1.0


def input_frame(values: Mapping[str, Any]) -> InputFrame:
    """Make the coordinates of the input."""
    return InputFrame((values['input_width'], values['input_height']), values['input_fit'])
