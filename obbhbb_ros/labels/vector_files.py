# SPDX-License-Identifier: Apache-2.0
"""
Vector files of geographic information systems: polygons with fields, one ship per feature.

They need the extra `geo` (GeoPandas). The fields ``image``, ``class``, ``score`` and ``instance``
or ``id`` may be absent; all others are kept, dates as text. Coordinates are in the reference system
of the file, which is written again, or pixels, see `obbhbb_ros.labels.maps`. Features that name no
image belong to an image named after the file. Errors give the number of a feature from 0, as GIS
tools count. Images without boxes have no feature, and an unknown diagnostic is null.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import shapely

from obbhbb_ros.files import replacing_all
from obbhbb_ros.labels import maps
from obbhbb_ros.labels import shapes
from obbhbb_ros.labels.documents import property_text
from obbhbb_ros.labels.image_labels import ImageBoxes
from obbhbb_ros.labels.image_labels import ImageLabels
from obbhbb_ros.labels.label_file import LabelFile

RESERVED = (*shapes.FEATURE_FIELDS, 'geometry', 'geom', 'fid', 'ogc_fid')
# Whole numbers up to here are the same as floating-point numbers.
EXACT = 2**53
GEOPACKAGE_OPTIONS = {'VERSION': '1.2'}
"""Options of a GeoPackage. GDAL before 3.7, as in QGIS 3.22, warns of a later version."""


def read_features(file: LabelFile, what: str) -> Iterator[ImageLabels]:
    """Read the features of a file of one layer; `what` it is called in the error if it is not."""
    import geopandas

    try:
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter('always')
            frame = geopandas.read_file(file.path, **_engine(file.path))
    except ImportError:
        raise
    except Exception as error:
        # Any exception: the two engines of GeoPandas raise errors of many kinds.
        raise file.error(f'not {what}: {error}') from error
    if any('layer' in str(warning.message).lower() for warning in caught):
        raise file.error('more than one layer: export the one with the ships to a file of its own')
    fields = frame.drop(columns=_geometry_column(frame)).astype(object).to_dict('records')
    geometries = frame.geometry if _geometry_column(frame) else [None] * len(fields)
    features = (
        (None, f'feature {index}: ', feature)
        for index, feature in enumerate(zip(fields, geometries, strict=True))
    )
    records = file.parse_records(features, partial(_record, file.path.stem))
    return maps.map_images(file, records, lambda: _system(frame))


def _geometry_column(frame: Any) -> list[str]:
    # GeoPandas calls it so, whatever its name in the file.
    return ['geometry'] if 'geometry' in frame else []


def _system(frame: Any) -> str | None:
    """Return the reference system; None if there is none, or one of no place on Earth."""
    crs = getattr(frame, 'crs', None)
    # Fiona writes `Undefined geographic SRS` to a GeoPackage whose table names no system.
    if crs is None or crs.is_engineering or crs.name.startswith('Undefined'):
        return None
    return str(crs.to_string())


def _engine(path: Path) -> dict[str, Any]:
    """Return the engine that GeoPandas must use: Fiona reads one of several layers in silence."""
    return {} if path.suffix.lower() == '.shp' else {'engine': 'pyogrio'}


def _record(default_image: str, feature: tuple[dict[str, Any], Any]) -> shapes.Outlined:
    properties, geometry = feature
    fields = {str(name): _plain(value) for name, value in properties.items()}
    return shapes.feature_record(default_image, fields, shapes.outer_rings(geometry))


def _plain(value: Any) -> Any:
    """Return the value of a field as text or a number of Python; None if it is missing."""
    value = value.item() if isinstance(value, np.generic) else value
    # NaN and its kin for dates are not equal to themselves.
    if value is None or value != value:  # noqa: PLR0124
        return None
    if isinstance(value, list | tuple | np.ndarray):
        return [_plain(item) for item in value]
    return value if isinstance(value, bool | int | float | str | dict) else str(value)


def write_features(
    path: Path, driver: str, images: list[ImageBoxes], stale: Sequence[str] = (), **options: str
) -> None:
    """
    Write boxes as polygons; files with a suffix in `stale` belong to the file that is replaced.

    `options` are those of the driver.

    Raises ValueError if there are several reference systems, OSError if the file is not complete.
    """
    import geopandas

    properties, boxes = shapes.box_features(images, RESERVED)
    frame = geopandas.GeoDataFrame(
        _columns(properties),
        geometry=shapely.box(*boxes.T),
        crs=shapes.only_system(images) or None,
    )
    # An empty file needs the type of geometry, which only pyogrio accepts.
    empty = {'engine': 'pyogrio', 'geometry_type': 'Polygon'} if frame.empty else _engine(path)
    with replacing_all(path, stale) as whole, warnings.catch_warnings():
        # One is about a missing reference system; the other about names that a shapefile shortens.
        warnings.filterwarnings('ignore', message=".*'crs' was not provided", category=UserWarning)
        warnings.filterwarnings('ignore', message='.*[Nn]ormalized/laundered field name')
        warnings.filterwarnings('ignore', message='.*longer than 10 characters')
        save_frame(frame, whole, path, driver=driver, encoding='UTF-8', **empty, **options)


def save_frame(frame: Any, whole: Path, path: Path, **options: Any) -> None:
    """
    Write a GeoDataFrame to a file that will be `path`, with options of `GeoDataFrame.to_file`.

    Raises OSError if the file is not complete.
    """
    import geopandas

    try:
        frame.to_file(whole, **options)
        # A full disk may only show as missing features.
        written = len(geopandas.read_file(whole, **_engine(path)))
    except ImportError:
        raise
    except Exception as error:
        # Any exception, as in `read_features`.
        raise OSError(f'{path}: cannot be written: {error}') from error
    if written != len(frame):
        raise OSError(f'{path}: only {written} of {len(frame)} features were written')


def _columns(properties: Sequence[dict[str, Any]]) -> dict[str, Any]:
    names = dict.fromkeys(name for fields in properties for name in fields)
    texts = {'image', 'instance', 'class'}
    empty = {name: np.array([], object if name in texts else float) for name in (*texts, 'score')}
    columns = {name: _column([fields.get(name) for fields in properties]) for name in names}
    return columns or empty


def _column(values: Sequence[Any]) -> Any:
    """Choose the type of a field: whole numbers, numbers, or text for all others."""
    kinds = {type(value) for value in values if value is not None}
    if kinds <= {bool, int, float} and all(abs(value or 0) <= EXACT for value in values):
        if kinds and float not in kinds and None not in values:
            return np.array(values, np.int32 if kinds == {bool} else np.int64)
        # None becomes NaN, which is written as null.
        return np.array([np.nan if value is None else value for value in values], np.float64)
    return np.array([None if value is None else property_text(value) for value in values], object)
