# SPDX-License-Identifier: Apache-2.0
"""Boxes from bounds, from centre and angle, from polygons, and as geographic features."""

from __future__ import annotations

import math
from collections.abc import Collection
from collections.abc import Iterable
from collections.abc import Iterator
from collections.abc import Mapping
from collections.abc import Sequence
from itertools import islice
from typing import Any
from typing import NamedTuple

import numpy as np
import shapely

from obbhbb_ros.geometry.boxes import BLOCK
from obbhbb_ros.geometry.boxes import FARTHEST
from obbhbb_ros.geometry.boxes import Defect
from obbhbb_ros.geometry.boxes import FloatArray
from obbhbb_ros.geometry.boxes import OrientedBoxes
from obbhbb_ros.geometry.boxes import range_defect
from obbhbb_ros.labels.documents import parse_difficulty
from obbhbb_ros.labels.documents import plain_text
from obbhbb_ros.labels.image_labels import MIN_HULL_POINTS
from obbhbb_ros.labels.image_labels import ImageBoxes
from obbhbb_ros.labels.label_file import NO_REFERENCE
from obbhbb_ros.labels.label_file import Box
from obbhbb_ros.labels.label_file import LabelError
from obbhbb_ros.labels.label_file import LabelFile
from obbhbb_ros.labels.label_file import Record
from obbhbb_ros.labels.losses import Part
from obbhbb_ros.labels.text import parse_score

Corners = tuple[float, float, float, float, float, float, float, float]

# Names that tools give a property, in any case; the first one with a value is used.
IMAGE = ('image', 'image_id', 'file_name', 'filename')
CLASS = ('class', 'class_id', 'category', 'label', 'name')
SCORE = ('score', 'confidence')
INSTANCE = ('instance', 'id')

# Fields of geographic features that are not other properties.
FEATURE_FIELDS = ('image', 'instance', 'class', 'score', 'crowd', 'difficulty')
FEATURES_HOLD: tuple[Part, ...] = (
    'diagnostics', 'scores', 'ids', 'crowd marks', 'difficulties', 'properties', 'reference system',
)  # fmt: skip
CROWD_VALUES = {'': False, '0': False, 'false': False, '1': True, 'true': True}

BOX_CORNERS = 4
PROBLEMS = {
    Defect.NOT_FINITE: 'the polygon has a coordinate that is not finite',
    Defect.EMPTY: 'the polygon has no area',
    Defect.TOO_FEW_POINTS: 'the polygon has fewer than three distinct points',
    Defect.NO_RECTANGLE: (
        'the polygon has no minimum rotated rectangle: a coordinate is beyond '
        f'{FARTHEST:g}, or its points are too close together'
    ),
}


def upright_corners(xyxy: Sequence[float]) -> Corners:
    """Return the corners, x1 y1 … x4 y4; raise ValueError if a maximum is below the minimum."""
    x_min, y_min, x_max, y_max = xyxy
    if x_max < x_min or y_max < y_min:
        sides = f'{x_min} {y_min} to {x_max} {y_max}'
        raise ValueError(f'the box has a maximum below its minimum: {sides}')
    return (x_min, y_min, x_max, y_min, x_max, y_max, x_min, y_max)


def upright_rows(xyxy: FloatArray) -> FloatArray:
    """Do what `upright_corners` does for N boxes, (N, 4) to (N, 4, 2)."""
    for row in xyxy[(xyxy[:, 2:] < xyxy[:, :2]).any(axis=1)].tolist():
        upright_corners(row)
    return xyxy[:, [0, 1, 2, 1, 2, 3, 0, 3]].reshape(-1, 4, 2)


def bounds_of_xywh(x: float, y: float, width: float, height: float) -> list[float]:
    """
    Turn corner and size into x_min, y_min, x_max, y_max.

    Raises ValueError if a size is negative or a result is not finite.
    """
    _check_size(width, height)
    bounds = [x, y, x + width, y + height]
    _check_finite(bounds)
    return bounds


def oriented_corners(x: float, y: float, width: float, height: float, angle: float) -> Corners:
    """
    Return the corners x1 y1 … x4 y4 of a box with centre `x`, `y` in pixels.

    `width` is its extent along `angle` and `height` across it, pixels; `angle` is in radians from
    image +x towards +y. Raises ValueError if a size is negative or a corner is not finite.
    """
    _check_size(width, height)
    ux, uy = math.cos(angle) * width / 2, math.sin(angle) * width / 2
    vx, vy = -math.sin(angle) * height / 2, math.cos(angle) * height / 2
    corners = (
        x - ux - vx, y - uy - vy, x + ux - vx, y + uy - vy,
        x + ux + vx, y + uy + vy, x - ux + vx, y - uy + vy,
    )  # fmt: skip
    _check_finite(corners)
    return corners


def turned_box(xyxy: Sequence[float], degrees: float) -> tuple[Corners, Sequence[float]]:
    """
    Turn an upright box about its centre by `degrees` clockwise as seen, as CVAT does.

    Returns the corners and the reference box, which is there only if the box is not turned. Raises
    ValueError if a maximum is below the minimum.
    """
    corners = upright_corners(xyxy)
    if degrees == 0.0:
        return corners, xyxy
    x_min, y_min, x_max, y_max = xyxy
    center = (x_min + x_max) / 2, (y_min + y_max) / 2
    size = x_max - x_min, y_max - y_min
    return oriented_corners(*center, *size, math.radians(degrees)), NO_REFERENCE


def bow_first(corners: Corners, head: tuple[float, float]) -> tuple[Corners, bool]:
    """
    Order the corners of a box so that the first two are the end where the ship's `head` is.

    Returns the corners and True, or unchanged and False if `head` is further than a quarter of the
    length from the middle of both ends.
    """
    points = [corners[i : i + 2] for i in range(0, 8, 2)]
    sides = [math.dist(points[0], points[1]), math.dist(points[1], points[2])]
    length = max(sides)
    for start in (1, 3) if sides[0] > sides[1] else (0, 2):
        (x1, y1), (x2, y2) = points[start], points[(start + 1) % 4]
        if math.dist(head, ((x1 + x2) / 2, (y1 + y2) / 2)) <= length / 4:
            return (*corners[2 * start :], *corners[: 2 * start]), True  # type: ignore[return-value]
    return corners, False


def _check_size(width: float, height: float) -> None:
    if width < 0.0 or height < 0.0:
        raise ValueError(f'the box has a negative size: {width} x {height}')


def _check_finite(numbers: Iterable[float]) -> None:
    if not all(map(math.isfinite, numbers)):
        raise ValueError('the box is so large that a coordinate is not finite')


class Outlined(NamedTuple):
    """
    A record with a box or, if there are rings, with the polygons that the box is computed from.

    `image` identifies the image in the file. `rings` are the outer rings of the ship's polygons,
    each of shape (K, 2), closed or not.
    """

    image: str
    box: Box
    rings: Sequence[FloatArray] = ()


def ring_of(values: object) -> FloatArray:
    """
    Turn a list of K positions into an array of shape (K, 2); numbers after x and y are ignored.

    Raises ValueError if it is anything else.
    """
    try:
        ring = np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        raise ValueError('a ring is not a list of positions') from None
    if ring.ndim != 2 or ring.shape[1] < 2:
        raise ValueError('a ring is not a list of positions')
    return ring if ring.shape[1] == 2 else np.ascontiguousarray(ring[:, :2])


def ring_of_pairs(numbers: Sequence[float]) -> FloatArray:
    """Turn x1 y1 … xK yK into an array of shape (K, 2); raise ValueError unless K >= 3."""
    if len(numbers) < 2 * MIN_HULL_POINTS or len(numbers) % 2:
        count = len(numbers)
        raise ValueError(f'a polygon has {count} numbers, not x and y of at least three points')
    return np.array(numbers, np.float64).reshape(-1, 2)


def outer_rings(geometry: Any) -> list[FloatArray]:
    """
    Return the outer ring, of shape (K, 2), of each part of a shapely Polygon or MultiPolygon.

    Holes and heights are ignored. Raises ValueError if it is empty, None or another geometry.
    """
    if geometry is None or shapely.is_empty(geometry):
        raise ValueError('no geometry')
    if geometry.geom_type not in {'Polygon', 'MultiPolygon'}:
        raise ValueError(f'a {geometry.geom_type} is not a polygon')
    rings = shapely.get_exterior_ring(shapely.get_parts(geometry))
    return [shapely.get_coordinates(ring) for ring in rings]


def check_coordinates(points: FloatArray) -> None:
    """Raise ValueError if a coordinate is not finite, or so large that GEOS crashes or hangs."""
    defect = range_defect(points)
    if defect != Defect.NONE:
        raise ValueError(PROBLEMS[defect])


def feature_record(
    default_image: str,
    properties: Mapping[str, Any],
    rings: Sequence[FloatArray],
    identifier: object = None,
) -> Outlined:
    """
    Turn a geographic feature into a record; `rings` are the outer rings of its polygons.

    Without the name of an image, it is `default_image`; `identifier` is the id if no property is.
    All properties are kept but those that have the names of `FEATURE_FIELDS`. Raises ValueError if
    there is no ring, or a value is not what its name says.
    """
    if not rings:
        raise ValueError('the polygon is empty')
    lower = {str(name).lower(): value for name, value in properties.items()}
    score = parse_score(_first(lower, SCORE))
    box = Box(
        (),
        _first(lower, CLASS),
        _first(lower, INSTANCE) or plain_text(identifier),
        score,
        crowd=parse_crowd(_first(lower, ('crowd',))),
        difficulty=parse_difficulty(_first(lower, ('difficulty',))),
        properties={
            name: value for name, value in properties.items() if name.lower() not in FEATURE_FIELDS
        },
    )
    return Outlined(_first(lower, IMAGE) or default_image, box, rings)


def parse_crowd(value: str) -> bool:
    """Parse whether a box is a group of ships; raise ValueError if it is neither 0 nor 1."""
    if value.lower() not in CROWD_VALUES:
        raise ValueError(f'crowd {value!r} is neither 0 nor 1')
    return CROWD_VALUES[value.lower()]


def _first(properties: Mapping[str, Any], names: Sequence[str]) -> str:
    for name in names:
        if name in properties and (text := plain_text(properties[name])):
            return text
    return ''


def enclose(file: LabelFile, records: Iterable[Record[Outlined]]) -> dict[str, list[Box]]:
    """
    Compute the minimum rotated rectangle of the rings of each record.

    Several rings are one partly hidden ship: its hull is the convex hull of them all. A ring of
    four corners is a box, not a hull, with these corners; if it is an upright rectangle, it is also
    the reference box, unless the record has one. Records whose rings have no rectangle are reported
    and left out.

    Parameters
    ----------
    file : LabelFile
        The file.
    records : iterable of Record
        As `LabelFile.parse_records` yields them. Only a block of them is in memory at a time.

    Returns
    -------
    dict of str to list of Box
        The boxes of each image, in the order of the records.
    """
    images: dict[str, list[Box]] = {}
    remaining = iter(records)
    while block := list(islice(remaining, BLOCK)):
        for image, box in _enclosed(file, block):
            images.setdefault(image, []).append(box)
    return images


def _enclosed(file: LabelFile, block: Sequence[Record[Outlined]]) -> Iterator[tuple[str, Box]]:
    drawn = [record for _, _, record in block if record.rings]
    with np.errstate(over='ignore', invalid='ignore'):
        boxes = OrientedBoxes.from_polygons(np.concatenate(record.rings) for record in drawn)
    results = zip(boxes.defects.tolist(), boxes.corners.reshape(-1, 8).tolist(), strict=True)
    for line, place, record in block:
        if not record.rings:
            yield record.image, record.box
            continue
        defect, corners = next(results)
        if defect == Defect.NONE:
            yield record.image, _outlined_box(record, corners)
        else:
            message = f'{place}{PROBLEMS[Defect(defect)]}'
            file.on_error(LabelError(file.path, line, message))


def _outlined_box(record: Outlined, corners: Sequence[float]) -> Box:
    """Complete the box of a record whose rings have these corners of their rectangle."""
    box, hull = record.box, _hull(record.rings)
    if len(record.rings) > 1 or len(hull) != BOX_CORNERS:
        return box._replace(corners=corners, hull=hull)
    # As they are drawn: what box they mean is said in one place for all formats, and so the first
    # edge is that of the file.
    box = box._replace(corners=hull.ravel().tolist())
    if box.reference is NO_REFERENCE and _is_upright(hull):
        box = box._replace(reference=(*hull.min(axis=0).tolist(), *hull.max(axis=0).tolist()))
    return box


def _hull(rings: Sequence[FloatArray]) -> FloatArray:
    """Return a ring without its closing point, or the convex hull of several."""
    ring = rings[0]
    if len(rings) > 1:
        hull = shapely.convex_hull(shapely.multipoints(np.concatenate(rings)))
        ring = shapely.get_coordinates(hull)
    return ring[:-1] if ring[0].tolist() == ring[-1].tolist() else ring


def _is_upright(corners: FloatArray) -> bool:
    """Tell whether four corners are those of an upright rectangle, in any order."""
    x, y = corners.T.tolist()
    return len(set(zip(x, y, strict=True))) == BOX_CORNERS and len(set(x)) == len(set(y)) == 2


def box_features(
    images: Sequence[ImageBoxes], reserved: Collection[str] = FEATURE_FIELDS
) -> tuple[list[dict[str, Any]], FloatArray]:
    """
    Return the properties of N boxes as geographic features, and the boxes, shape (N, 4).

    `crowd` and `difficulty` are among them if a box is a crowd or difficult; properties that have
    one of the `reserved` names are not.
    """
    crowds = any(image.extras.crowd is not None for image in images)
    difficulties = any(image.extras.difficulty is not None for image in images)
    properties = [
        {
            'image': image.image,
            'instance': box.id,
            'class': box.class_id,
            'score': box.score,
            **({'crowd': int(box.crowd)} if crowds else {}),
            **({'difficulty': box.difficulty} if difficulties else {}),
            **box.diagnostics,
            **box.properties,
        }
        for image in images
        for box in image.rows(reserved)
    ]
    return properties, np.concatenate([np.zeros((0, 4)), *(image.xyxy for image in images)])


def only_system(images: Sequence[ImageBoxes]) -> str:
    """Return the reference system of all images; raise ValueError if they have several."""
    systems = {image.extras.label_set.crs for image in images}
    if len(systems) > 1:
        names = ' and '.join(sorted(repr(name[:60]) for name in systems))
        raise ValueError(f'one file cannot hold more than one reference system: {names}')
    return next(iter(systems), '')
