# SPDX-License-Identifier: Apache-2.0
"""Colours of methods and layers, in charts, in the report and in the nodes."""

from __future__ import annotations

METHOD_COLORS = {
    'superellipse': '#0b7d3e',
    'shape_aware': '#e08a00',
    'outer': '#1f5fbf',
    'midpoint': '#b0389b',
    'gaussian': '#d03b2a',
    'area_equivalent': '#5f6a72',
    'gaussian_published': '#e79a90',
    'area_equivalent_published': '#a9b1b7',
}
ORIENTED_COLOR = '#000000'
"""Colour of oriented boxes."""
LAYER_COLORS = {
    'crop_regions': METHOD_COLORS['outer'],
    'boxes': METHOD_COLORS['superellipse'],
    'detections': ORIENTED_COLOR,
}
"""Colours of the layers that can be drawn over an image, by topic, the first at the bottom."""
