# SPDX-License-Identifier: Apache-2.0
"""The names of the executables. It imports nothing else of the package."""

from __future__ import annotations

NODES = {
    'obb_to_hbb': 'ObbToHbb',
    'chip_extractor': 'ChipExtractor',
    'downlink': 'Downlink',
    'overlay': 'Overlay',
    'play_detections': 'PlayDetections',
    'ship_tracker': 'ShipTracker',
}
"""The class of the node of each executable; its module has the name of the executable."""

PAYLOAD = 'payload'
"""The executable that runs several nodes in one process."""

PAYLOAD_NODES = tuple(name for name in NODES if name != 'play_detections')
"""The nodes that it runs: those that a payload has."""
