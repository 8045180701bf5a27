# SPDX-License-Identifier: Apache-2.0
"""
Oriented boxes in Arrow record batches to axis-aligned ones; needs the extra `arrow` (pyarrow).

DuckDB, Dask, Ray and Spark hand over their tables as record batches: see `doc/arrow.md`.
"""

from __future__ import annotations

from collections.abc import Iterable
from collections.abc import Iterator
from collections.abc import Sequence

import numpy as np
import pyarrow as pa
import shapely

from obbhbb_ros.geometry.boxes import BLOCK
from obbhbb_ros.geometry.boxes import FloatArray
from obbhbb_ros.geometry.boxes import OrientedBoxes
from obbhbb_ros.geometry.boxes import blocks
from obbhbb_ros.geometry.converter import NO_CAPS
from obbhbb_ros.geometry.converter import Caps
from obbhbb_ros.geometry.converter import HullRule
from obbhbb_ros.geometry.converter import convert_by_rule

__all__ = ['BOUNDS', 'CORNERS', 'convert_batch', 'convert_batches', 'converted_schema']

CORNERS = ('x1', 'y1', 'x2', 'y2', 'x3', 'y3', 'x4', 'y4')
BOUNDS = ('x_min', 'y_min', 'x_max', 'y_max')

DEFAULT_RULE = HullRule()
# Type numbers of shapely: Polygon and MultiPolygon.
POLYGONS = (3, 6)


def convert_batches(
    batches: Iterable[pa.RecordBatch],
    columns: Sequence[str] = CORNERS,
    rule: HullRule = DEFAULT_RULE,
    caps: Caps = NO_CAPS,
    *,
    degrees: bool = False,
) -> Iterator[pa.RecordBatch]:
    """
    Convert record batches as they come, each as `convert_batch` does.

    `pyspark.sql.DataFrame.mapInArrow` takes this function, with its options bound.
    """
    for batch in batches:
        yield convert_batch(batch, columns, rule, caps, degrees=degrees)


def convert_batch(
    batch: pa.RecordBatch,
    columns: Sequence[str] = CORNERS,
    rule: HullRule = DEFAULT_RULE,
    caps: Caps = NO_CAPS,
    *,
    degrees: bool = False,
) -> pa.RecordBatch:
    """
    Add the axis-aligned box of each row to a record batch.

    Parameters
    ----------
    batch : pyarrow.RecordBatch or pyarrow.Table
        N rows.
    columns : sequence of str
        The columns of the oriented box, pixels. Eight: x and y of the corners, in order around the
        box. Five: centre x and y, extent along the angle, extent across it, angle from image +x
        towards +y. One: a polygon as WKB, whose minimum rotated rectangle is the box, or a list of
        the eight coordinates.
    rule : HullRule
        How to convert.
    caps : Caps
        Bounds of the result, pixels.
    degrees : bool
        Whether the angle is in degrees; in radians by default.

    Returns
    -------
    pyarrow.RecordBatch or pyarrow.Table
        What was passed in, with the columns `BOUNDS`, double, at its end. They are null in rows
        that cannot be converted, such as those with a null.

    Raises
    ------
    ValueError
        If there is no such column or it does not hold numbers, WKB or lists of eight numbers, the
        number of columns is another, or a column of `BOUNDS` exists.

    Examples
    --------
    >>> boxes = [[20, 30, 80, 30, 80, 50, 20, 50], None]
    >>> batch = pa.record_batch({'name': ['a', 'b'], 'box': boxes})
    >>> convert_batch(batch, ['box']).to_pylist()[0]['x_max']
    80.0
    >>> convert_batch(batch, ['box'])['x_max'].null_count
    1
    """
    schema = converted_schema(batch.schema)
    bounds = np.empty((4, batch.num_rows))
    for rows in blocks(batch.num_rows):
        part = batch.slice(rows.start, BLOCK)
        bounds[:, rows] = convert_by_rule(_boxes(part, columns, degrees), rule, caps).T
    missing = np.isnan(bounds[0])
    mask = missing if missing.any() else None
    converted = [pa.array(values, mask=mask) for values in bounds]
    return type(batch).from_arrays([*batch.columns, *converted], schema=schema)


def converted_schema(schema: pa.Schema) -> pa.Schema:
    """
    Return the schema of converted batches, which Spark and others ask for in advance.

    Raises ValueError if a column of `BOUNDS` exists.

    Examples
    --------
    >>> converted_schema(pa.schema({'name': pa.string()})).names
    ['name', 'x_min', 'y_min', 'x_max', 'y_max']
    """
    for name in BOUNDS:
        if name in schema.names:
            raise ValueError(f'there is a column {name!r} already: drop or rename it')
        schema = schema.append(pa.field(name, pa.float64()))
    return schema


def _boxes(batch: pa.RecordBatch, columns: Sequence[str], degrees: bool) -> OrientedBoxes:
    arrays = [_column(batch, name) for name in columns]
    if len(columns) == 1:
        (name,), (array,) = columns, arrays
        if pa.types.is_binary(array.type) or pa.types.is_large_binary(array.type):
            return _of_wkb(array)
        return _of_lists(name, array)
    if len(columns) not in {5, 8}:
        raise ValueError(f'columns must be eight, five or one, not {len(columns)}')
    pairs = zip(columns, arrays, strict=True)
    numbers = np.array([numbers_of(name, array) for name, array in pairs]).T
    if len(columns) == 8:
        return OrientedBoxes.from_corners(numbers)
    return OrientedBoxes.from_xywhr(numbers, degrees=degrees)


def _column(batch: pa.RecordBatch, name: str) -> pa.Array:
    indices = batch.schema.get_all_field_indices(name)
    if len(indices) != 1:
        count = len(indices) or 'no'
        raise ValueError(f'{count} columns {name!r} among {", ".join(batch.schema.names)}')
    column = batch.column(indices[0])
    return column.combine_chunks() if isinstance(column, pa.ChunkedArray) else column


def numbers_of(name: str, array: pa.Array) -> FloatArray:
    """Return the numbers of a column, NaN where it has null; ValueError if it has no numbers."""
    kind = array.type
    if not (pa.types.is_integer(kind) or pa.types.is_floating(kind) or pa.types.is_decimal(kind)):
        raise ValueError(f'column {name!r} holds {kind}, not numbers')
    if kind != pa.float64():
        array = array.cast(pa.float64(), safe=False)
    return np.asarray(array.to_numpy(zero_copy_only=False), np.float64)


def _of_lists(name: str, array: pa.Array) -> OrientedBoxes:
    """Read the corners of a column of lists; a null is not finite."""
    corners = np.full((len(array), 8), np.nan)
    given = array.is_valid().to_numpy(zero_copy_only=False)
    try:
        lists = array.drop_null().cast(pa.list_(pa.float64(), 8))
    except pa.ArrowException as error:
        raise ValueError(f'column {name!r} holds no lists of eight numbers: {error}') from None
    corners[given] = numbers_of(name, lists.flatten()).reshape(-1, 8)
    return OrientedBoxes.from_corners(corners)


def _of_wkb(array: pa.Array) -> OrientedBoxes:
    """Read polygons; what is no polygon has too few points."""
    geometries = shapely.from_wkb(array.to_numpy(zero_copy_only=False), on_invalid='ignore')
    kinds = shapely.get_type_id(geometries)
    geometries[~np.isin(kinds, POLYGONS)] = None
    # Four corners, as most boxes are written, need no loop.
    four = (kinds == POLYGONS[0]) & (shapely.get_num_coordinates(geometries) == 5)
    corners = shapely.get_coordinates(geometries[four]).reshape(-1, 5, 2)[:, :4]
    others = (shapely.get_coordinates(geometry) for geometry in geometries[~four])
    parts = OrientedBoxes.from_corners(corners), OrientedBoxes.from_polygons(others)
    order = np.argsort(np.concatenate((np.flatnonzero(four), np.flatnonzero(~four))))
    return OrientedBoxes.concatenate(parts)[order]
