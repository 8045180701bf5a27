# SPDX-License-Identifier: Apache-2.0
"""Parameters and settings of the node `overlay`."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from obbhbb_ros.colors import LAYER_COLORS
from obbhbb_ros.geometry.input_frame import InputFrame
from obbhbb_ros.overlay.collector import CollectorLimits
from obbhbb_ros.overlay.drawing import Style
from obbhbb_ros.settings.common import COMMON
from obbhbb_ros.settings.common import IMAGES_KEPT
from obbhbb_ros.settings.common import INPUT_TIMEOUT
from obbhbb_ros.settings.detection_input import INPUT_COORDINATES
from obbhbb_ros.settings.detection_input import INPUT_TYPE
from obbhbb_ros.settings.detection_input import input_frame
from obbhbb_ros.settings.detection_input import theta_scale
from obbhbb_ros.settings.parameters import Parameter
from obbhbb_ros.settings.parameters import ParameterTable
from obbhbb_ros.settings.parameters import group_of


@dataclass(frozen=True)
class OverlaySettings:
    """
    What one image is drawn under.

    Attributes
    ----------
    colors : mapping of str to str
        The layers that are drawn and their colours, '#rrggbb', the first below the others.
    style : Style
        How they are drawn.
    theta_scale : float
        Factor from the input's angle unit to radians.
    input_frame : InputFrame
        Coordinates of the detections.
    limits : CollectorLimits
        For how long an image waits for its layers.
    """

    colors: Mapping[str, str]
    style: Style
    theta_scale: float
    input_frame: InputFrame
    limits: CollectorLimits


def _overlay_settings(values: Mapping[str, Any]) -> OverlaySettings:
    """Make settings for `overlay`."""
    layers = [layer for layer in values['layers'] if layer]
    unknown = ', '.join(layer for layer in layers if layer not in LAYER_COLORS)
    if unknown:
        raise ValueError(f'layers can be {", ".join(LAYER_COLORS)}, not {unknown}')
    colors = {layer: values[f'color.{layer}'] for layer in layers}
    for layer, color in colors.items():
        if not re.fullmatch('#[0-9a-fA-F]{6}', color):
            raise ValueError(f'color.{layer} must be #rrggbb, not {color!r}')
    return OverlaySettings(
        colors=colors,
        style=group_of(Style, values, ''),
        theta_scale=theta_scale(values),
        input_frame=input_frame(values),
        limits=CollectorLimits(values['max_wait'], values['max_age'], values['max_images']),
    )


OVERLAY = ParameterTable(
    (
        *COMMON,
        INPUT_TIMEOUT,
        INPUT_TYPE,
        *INPUT_COORDINATES,
        Parameter(
            'layers',
            list(LAYER_COLORS),
            'What is drawn, the first below the others; empty strings are ignored.',
        ),
        Parameter(
            'labels',
            Style.labels,
            'Write class and score beside the detections, best score first, where there is room.',
        ),
        Parameter(
            'scale',
            Style.scale,
            'Size of the picture relative to the image; a small one suits a thin link.',
            0.01,
            1.0,
        ),
        Parameter('quality', Style.quality, 'Quality of the JPEG.', 1, 100),
        Parameter(
            'line_width',
            Style.line_width,
            'Line width, pixels of the picture (0: what suits its size).',
            0,
            1000,
        ),
        Parameter(
            'text_size',
            Style.text_size,
            'Text size, pixels of the picture (0: what suits its size).',
            0,
            500,
        ),
        Parameter(
            'max_wait',
            0.5,
            'How long an image waits for its layers, seconds; then it is drawn with those that are '
            'there.',
            0.0,
            60.0,
        ),
        Parameter(
            'max_age',
            5.0,
            'How long layers wait for their image, seconds; a large one takes a while to arrive.',
            0.0,
            3600.0,
        ),
        Parameter(
            'max_images',
            IMAGES_KEPT,
            'Maximum images that wait for their layers; the oldest is dropped first.',
            1,
            1000,
        ),
        *(
            Parameter(f'color.{layer}', color, f'Colour of {layer.replace("_", " ")}, #rrggbb.')
            for layer, color in LAYER_COLORS.items()
        ),
    ),
    _overlay_settings,
)
"""Parameters of the node `overlay`."""
