# SPDX-License-Identifier: Apache-2.0
"""The colours of the methods and of what is drawn over images: in charts, the report and nodes."""

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
"""Oriented boxes."""
LAYER_COLORS = {
    'crop_regions': METHOD_COLORS['outer'],
    'boxes': METHOD_COLORS['superellipse'],
    'detections': ORIENTED_COLOR,
}
"""What can be drawn over an image, by its topic; the first below the others."""
