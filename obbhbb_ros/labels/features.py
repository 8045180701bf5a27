# SPDX-License-Identifier: Apache-2.0
"""Geographic features, whatever file they come from: properties and polygons to records."""

from __future__ import annotations

from collections.abc import Mapping
from collections.abc import Sequence
from typing import Any

import numpy as np
import shapely

from obbhbb_ros.labels.converted import ConvertedImage
from obbhbb_ros.labels.converted import converted_boxes
from obbhbb_ros.labels.documents import plain_text
from obbhbb_ros.labels.records import Box
from obbhbb_ros.labels.records import FloatArray
from obbhbb_ros.labels.shapes import Outlined
from obbhbb_ros.labels.shapes import outline
from obbhbb_ros.labels.text import parse_numbers

# Names that tools give to the same thing, in any case; the first one that is there counts.
IMAGE = ('image', 'image_id', 'file_name', 'filename')
CLASS = ('class', 'class_id', 'category', 'label', 'name')
SCORE = ('score', 'confidence')
INSTANCE = ('instance', 'id')


def feature_record(
    default_image: str,
    place: str,
    line: int | None,
    properties: Mapping[str, Any],
    rings: Sequence[FloatArray],
) -> Outlined:
    """
    Make a record of a feature.

    Parameters
    ----------
    default_image : str
        Image of features that name none.
    place : str
        Put before what is wrong with the feature.
    line : int or None
        Its line where known.
    properties : mapping
        Its properties or the fields of its row; unknown ones are ignored.
    rings : sequence of ndarray, each of shape (K, 2)
        The outer ring of each of its polygons.

    Returns
    -------
    Outlined
        The record, its box still to be laid around.

    Raises
    ------
    ValueError
        If there is no ring, or a number is not one.
    """
    lower = {str(name).lower(): value for name, value in properties.items()}
    score = _first(lower, SCORE)
    box = Box(
        corners=(),
        class_id=_first(lower, CLASS),
        id=_first(lower, INSTANCE),
        score=parse_numbers([score])[0] if score else 1.0,
    )
    box, points = outline(rings, box)
    return Outlined(_first(lower, IMAGE) or default_image, place, line, box, points)


def _first(properties: Mapping[str, Any], names: Sequence[str]) -> str:
    for name in names:
        if name in properties and (text := plain_text(properties[name])):
            return text
    return ''


def outer_rings(geometry: Any) -> list[FloatArray]:
    """
    Take the outer rings of a shapely geometry.

    Parameters
    ----------
    geometry : shapely geometry or None
        A Polygon or MultiPolygon; holes and heights are ignored.

    Returns
    -------
    list of ndarray, each of shape (K, 2)
        One ring a part.

    Raises
    ------
    ValueError
        If it is anything else or empty.
    """
    if geometry is None or shapely.is_empty(geometry):
        raise ValueError('no geometry')
    if geometry.geom_type not in {'Polygon', 'MultiPolygon'}:
        raise ValueError(f'a {geometry.geom_type} is no polygon')
    rings = shapely.get_exterior_ring(shapely.get_parts(geometry))
    return [np.asarray(shapely.get_coordinates(ring)) for ring in rings]


def converted_features(
    images: Sequence[ConvertedImage],
) -> tuple[list[dict[str, Any]], FloatArray]:
    """
    Make features of axis-aligned boxes.

    Parameters
    ----------
    images : sequence of ConvertedImage
        The images, N boxes in all.

    Returns
    -------
    list of dict, ndarray of shape (N, 4)
        The properties of each feature, and the boxes.
    """
    properties = [
        {
            'image': converted.image,
            'instance': box.id,
            'class': box.class_id,
            'score': box.score,
            **box.diagnostics,
        }
        for converted in images
        for box in converted_boxes(converted)
    ]
    boxes = [converted.xyxy for converted in images]
    return properties, np.concatenate([np.zeros((0, 4)), *boxes])
