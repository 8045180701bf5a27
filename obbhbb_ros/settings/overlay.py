# SPDX-License-Identifier: Apache-2.0
"""Parameters and settings of the node `overlay`."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from obbhbb_ros.colors import LAYER_COLORS
from obbhbb_ros.overlay.collector import CollectorLimits
from obbhbb_ros.overlay.drawing import Style
from obbhbb_ros.overlay.overlay_frame import FrameSettings
from obbhbb_ros.settings.common import COMMON_WITH_INPUT
from obbhbb_ros.settings.common import IMAGE_TRANSPORT
from obbhbb_ros.settings.detection_input import DETECTION_INPUT
from obbhbb_ros.settings.detection_input import input_frame
from obbhbb_ros.settings.parameters import Parameter
from obbhbb_ros.settings.parameters import ParameterTable
from obbhbb_ros.settings.parameters import rows_of
from obbhbb_ros.settings.parameters import settings_of

ANNOTATIONS = Parameter(
    'annotations',
    False,
    'Publish `overlay/annotations` for Foxglove: lines and texts, which `overlay/markers` cannot '
    'hold. Needs the ROS package foxglove_msgs.',
    read_only=True,
)


@dataclass(frozen=True)
class OverlaySettings:
    """How images are drawn, and how long they and their layers wait for each other."""

    frame: FrameSettings
    limits: CollectorLimits


def _overlay_settings(values: Mapping[str, Any]) -> OverlaySettings:
    """Make settings for `overlay`."""
    layers = list(filter(None, values['layers']))
    if unknown := ', '.join(layer for layer in layers if layer not in LAYER_COLORS):
        raise ValueError(f'layers can be {", ".join(LAYER_COLORS)}, not {unknown}')
    colors = {layer: values[f'color.{layer}'] for layer in layers}
    for layer, color in colors.items():
        if not re.fullmatch('#[0-9a-fA-F]{6}', color):
            raise ValueError(f'color.{layer} must be #rrggbb, not {color!r}')
    return OverlaySettings(
        FrameSettings(colors, settings_of(Style, values), input_frame(values)),
        settings_of(CollectorLimits, values),
    )


OVERLAY = ParameterTable(
    (
        *COMMON_WITH_INPUT,
        *DETECTION_INPUT,
        IMAGE_TRANSPORT,
        ANNOTATIONS,
        Parameter(
            'layers',
            list(LAYER_COLORS),
            'What is drawn, the first at the bottom. Empty strings are ignored.',
        ),
        *rows_of(Style),
        *rows_of(CollectorLimits),
        *(
            Parameter(f'color.{layer}', color, f'Colour of {layer.replace("_", " ")}, #rrggbb.')
            for layer, color in LAYER_COLORS.items()
        ),
    ),
    _overlay_settings,
)
"""Parameters of the node `overlay`."""
