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
LAYER_COLORS = {'crop_regions': '#3c88dc', 'boxes': '#c0ff50', 'detections': ORIENTED_COLOR}
"""
Colours of the layers that can be drawn over an image, by topic, the first at the bottom.

As in the report they are blue, green and black, but bright, as water is dark: of any two, one is at
least three times as light as the other (the contrast of WCAG). The rim of each is white or black.
"""
DASHED_LAYERS = frozenset({'crop_regions'})
"""Layers with dashed lines."""
