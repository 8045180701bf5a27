# SPDX-License-Identifier: Apache-2.0
"""The parameters of all nodes of the package."""

from __future__ import annotations

from typing import Any

from obbhbb_ros.settings.chip_extractor import CHIP_EXTRACTOR
from obbhbb_ros.settings.downlink import DOWNLINK
from obbhbb_ros.settings.obb_to_hbb import OBB_TO_HBB
from obbhbb_ros.settings.overlay import OVERLAY
from obbhbb_ros.settings.parameters import ParameterTable
from obbhbb_ros.settings.play_detections import PLAY_DETECTIONS
from obbhbb_ros.settings.ship_tracker import SHIP_TRACKER

NODE_TABLES: dict[str, ParameterTable[Any]] = {
    'obb_to_hbb': OBB_TO_HBB,
    'chip_extractor': CHIP_EXTRACTOR,
    'downlink': DOWNLINK,
    'overlay': OVERLAY,
    'ship_tracker': SHIP_TRACKER,
    'play_detections': PLAY_DETECTIONS,
}
"""The parameter table of each node."""
