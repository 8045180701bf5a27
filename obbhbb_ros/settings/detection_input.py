# SPDX-License-Identifier: Apache-2.0
"""Parameters of the nodes that read oriented detections."""

from __future__ import annotations

import math
from collections.abc import Mapping
from itertools import groupby
from typing import Any

from obbhbb_ros.geometry.input_frame import FITS
from obbhbb_ros.geometry.input_frame import InputFrame
from obbhbb_ros.limits import Choices
from obbhbb_ros.settings.common import size_rows
from obbhbb_ros.settings.parameters import Parameter
from obbhbb_ros.wire.layouts import INPUT_TYPES

TOPICS = ' or '.join(
    f'`{topic}` ({", ".join(kind.name for kind in kinds)})'
    for topic, kinds in groupby(INPUT_TYPES.values(), lambda kind: kind.topic)
)
"""The topics of detections, each with its message types."""

DETECTION_INPUT = (
    Parameter(
        'input_type',
        next(iter(INPUT_TYPES)),
        f'Message type of the input. The topic is {TOPICS}.',
        Choices(tuple(INPUT_TYPES)),
        read_only=True,
    ),
    Parameter(
        'angle_unit', 'rad', 'Unit of bbox.center.theta in the input.', Choices(('rad', 'deg'))
    ),
    *size_rows('input', "the network's input, pixels, if the detections are in its coordinates."),
    Parameter(
        'input_fit',
        'none',
        "How the image was fitted to the network's input: `none`, the detections are in image "
        'coordinates; `stretch`; or `letterbox`, scaled with equal margins on two sides.',
        Choices(FITS),
    ),
)
"""Type and coordinates of the detections."""


def input_frame(values: Mapping[str, Any]) -> InputFrame:
    """Return the coordinates of the detections."""
    size = (values['input_width'], values['input_height'])
    theta_scale = math.pi / 180.0 if values['angle_unit'] == 'deg' else 1.0
    return InputFrame(size, values['input_fit'], theta_scale)
