# SPDX-License-Identifier: Apache-2.0
"""
Labels in map coordinates: which reference system, and boxes from degrees and back.

Boxes in degrees are computed in the plane of `degrees`, and written in degrees again. What names no
reference system is in degrees if its shapes are smaller than a tenth of a unit: no ship in pixels
or metres is, and every ship in degrees.
"""

from __future__ import annotations

from collections.abc import Callable
from collections.abc import Iterable
from collections.abc import Iterator
from dataclasses import replace
from itertools import chain
from itertools import islice
from typing import Any

import numpy as np

from obbhbb_ros.geometry.boxes import BLOCK
from obbhbb_ros.geometry.boxes import FloatArray
from obbhbb_ros.labels import shapes
from obbhbb_ros.labels.degrees import ground_scale
from obbhbb_ros.labels.degrees import to_degrees
from obbhbb_ros.labels.degrees import to_plane
from obbhbb_ros.labels.extras import LabelSet
from obbhbb_ros.labels.image_labels import ImageLabels
from obbhbb_ros.labels.label_file import LabelFile
from obbhbb_ros.labels.label_file import Record

LONGITUDE_LATITUDE = 'OGC:CRS84'
LARGEST_SHIP_DEGREES = 0.1
DEGREE = np.pi / 180.0


def map_images(
    file: LabelFile, records: Iterable[Record[shapes.Outlined]], crs: Callable[[], str | None]
) -> Iterator[ImageLabels]:
    """
    Compute the boxes of features as `shapes.enclose` does, in a plane if they are in degrees.

    `crs` is called after the first records are read, and returns their reference system: '' for
    pixels, None if the file names none. Features that name no image belong to an image named
    after the file; without features, it is an image without boxes.
    """
    remaining = iter(records)
    first = list(islice(remaining, BLOCK))
    system = crs()
    if system is None:
        system = probable_system(first)
    in_degrees = is_geographic(file, system)
    everything: Iterator[Record[shapes.Outlined]] = chain(first, remaining)
    if in_degrees:
        everything = file.parse_records(everything, _projected)
    images = shapes.enclose(file, everything) or {file.path.stem: []}
    yield from file.images(images, LabelSet(crs=system, in_degrees=in_degrees))


def probable_system(records: Iterable[Record[shapes.Outlined]]) -> str:
    """Return the system of features of a file that names none: degrees, or '' for pixels."""
    rings = [ring for _, _, record in records for ring in record.rings if len(ring)]
    if not rings or not (np.abs(np.concatenate(rings)) <= (360.0, 90.0)).all():
        return ''
    largest = max(np.ptp(ring, axis=0).max() for ring in rings)
    return LONGITUDE_LATITUDE if largest < LARGEST_SHIP_DEGREES else ''


def _projected(record: shapes.Outlined) -> shapes.Outlined:
    ends = np.cumsum([len(ring) for ring in record.rings])[:-1]
    return record._replace(rings=np.split(to_plane(np.concatenate(record.rings)), ends))


def is_geographic(file: LabelFile, crs: str) -> bool:
    """Whether a reference system is in degrees; raises FileError if that cannot be known."""
    if not crs or crs == LONGITUDE_LATITUDE:
        return bool(crs)
    try:
        system = _system(crs)
    except ImportError:
        raise file.error(f'the reference system {crs:.60} needs the extra `geo`') from None
    except ValueError as error:
        raise file.error(str(error)) from None
    if system.is_geographic and abs(system.axis_info[0].unit_conversion_factor - DEGREE) > 1e-9:
        raise file.error(f'the reference system {crs:.60} is neither in degrees nor in metres')
    return bool(system.is_geographic)


def _system(crs: str) -> Any:
    import pyproj

    try:
        return pyproj.CRS.from_user_input(crs)
    except pyproj.exceptions.CRSError:
        raise ValueError(f'the reference system {crs[:60]!r} is not known') from None


def code_of(crs: str) -> str:
    """Return authority and code of a reference system; raise ValueError if it has none."""
    if crs == LONGITUDE_LATITUDE:
        return crs
    authority = _system(crs).to_authority()
    if authority is None:
        raise ValueError(f'the reference system {crs[:60]!r} has no code that GeoJSON can name')
    return ':'.join(authority)


def metres_per_unit(labels: ImageLabels) -> FloatArray:
    """
    Return the metres on the ground of a unit of the coordinates of N boxes, shape (N,).

    Raises ValueError if the labels have no reference system, and are in pixels.
    """
    label_set, centers = labels.extras.label_set, labels.corners.mean(axis=1)
    if label_set.in_degrees:
        return ground_scale(centers[:, 1])
    if not label_set.crs:
        raise ValueError(f'{labels.source}: no reference system, so that metres are not known')
    import pyproj

    system = _system(label_set.crs)
    unit = system.axis_info[0].unit_conversion_factor
    there = pyproj.Transformer.from_crs(system, system.geodetic_crs, always_xy=True)
    longitude, latitude = there.transform(*centers.T)
    scale = np.sqrt(pyproj.Proj(system).get_factors(longitude, latitude).areal_scale)
    return np.asarray(unit / scale)


def restored(labels: ImageLabels) -> ImageLabels:
    """Return labels in the coordinates of their reference system."""
    if not labels.extras.label_set.in_degrees:
        return labels
    return replace(
        labels,
        corners=to_degrees(labels.corners.reshape(-1, 2)).reshape(-1, 4, 2),
        reference=boxes_in_degrees(labels.reference),
        hulls=tuple(None if hull is None else to_degrees(hull) for hull in labels.hulls),
        extras=replace(labels.extras, label_set=replace(labels.extras.label_set, in_degrees=False)),
    )


def on_ground(labels: ImageLabels) -> ImageLabels:
    """Return labels in degrees as metres on the ground, each box scaled at its own latitude."""
    if not labels.extras.label_set.in_degrees:
        return labels
    scale = metres_per_unit(labels)
    return replace(
        labels,
        corners=labels.corners * scale[:, None, None],
        reference=labels.reference * scale[:, None],
        hulls=tuple(
            None if hull is None else hull * factor
            for hull, factor in zip(labels.hulls, scale, strict=True)
        ),
    )


def boxes_in_degrees(xyxy: FloatArray) -> FloatArray:
    """Return axis-aligned boxes of the plane in degrees, shape (N, 4)."""
    return to_degrees(xyxy.reshape(-1, 2)).reshape(-1, 4)
