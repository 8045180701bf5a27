# SPDX-License-Identifier: Apache-2.0
"""Parameters and settings of the node `ship_tracker`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from obbhbb_ros.geometry.input_frame import InputFrame
from obbhbb_ros.limits import Choices
from obbhbb_ros.limits import Range
from obbhbb_ros.settings.common import COMMON_WITH_INPUT
from obbhbb_ros.settings.common import IMAGE_SIZE
from obbhbb_ros.settings.detection_input import DETECTION_INPUT
from obbhbb_ros.settings.detection_input import input_frame
from obbhbb_ros.settings.parameters import Parameter
from obbhbb_ros.settings.parameters import ParameterTable


@dataclass(frozen=True)
class TrackerSettings:
    """
    How detections get the ids of ships.

    Attributes
    ----------
    keeps_ids : bool
        Whether ids of the input are kept.
    memory : float
        For how long a ship that is not seen is remembered, seconds.
    image_size : tuple of int
        Width and height from the parameters, pixels; 0 where `camera_info` decides.
    input_frame : InputFrame
        Coordinates of the input.
    """

    keeps_ids: bool
    memory: float
    image_size: tuple[int, int]
    input_frame: InputFrame


def _tracker_settings(values: Mapping[str, Any]) -> TrackerSettings:
    """Make settings for `ship_tracker`."""
    return TrackerSettings(
        keeps_ids=values['ids'] == 'keep',
        memory=values['memory'],
        image_size=(values['image_width'], values['image_height']),
        input_frame=input_frame(values),
    )


SHIP_TRACKER = ParameterTable(
    (
        *COMMON_WITH_INPUT,
        *DETECTION_INPUT,
        Parameter(
            'ids',
            'keep',
            'What becomes of ids in the input: `keep` them, and give ids to detections without '
            'one; or `assign` ids to all.',
            Choices(('keep', 'assign')),
        ),
        Parameter(
            'memory',
            30.0,
            'For how long a ship that is not seen keeps its id, seconds.',
            Range(0.0, 1e6),
        ),
        *IMAGE_SIZE,
    ),
    _tracker_settings,
)
"""Parameters of the node `ship_tracker`."""
