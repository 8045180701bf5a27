# SPDX-License-Identifier: Apache-2.0
"""
Parquet and GeoParquet: one file of many images, one box per row; needs the extra `arrow` (pyarrow).

The columns of a box are ``x1`` to ``y4``, as in a CSV table, or ``x_min`` to ``y_max``, or a
geometry: that of GeoParquet, or a column ``geometry`` or ``geom`` of WKB polygons. ``image``,
``class``, ``score`` and ``instance`` or ``id`` may be absent, in upper or lower case, and are named
as in GeoJSON. Other columns are kept. Rows without an image name belong to an image named after the
file.

From Parquet to Parquet, rows keep their order, and columns their types; only a batch of rows is in
memory; but in degrees, see `obbhbb_ros.labels.maps`, they are ordered by image. GeoParquet is
written with the box as geometry, and its reference system.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from collections.abc import Iterable
from collections.abc import Iterator
from collections.abc import Mapping
from collections.abc import Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Any
from typing import NamedTuple
from typing import TypeAlias

import numpy as np
import shapely
from numpy.typing import NDArray

from obbhbb_ros.files import replacing
from obbhbb_ros.geometry.boxes import BLOCK
from obbhbb_ros.geometry.boxes import FloatArray
from obbhbb_ros.geometry.converter import Caps
from obbhbb_ros.geometry.converter import HullRule
from obbhbb_ros.labels import maps
from obbhbb_ros.labels import shapes
from obbhbb_ros.labels.documents import plain_text
from obbhbb_ros.labels.extras import Extras
from obbhbb_ros.labels.extras import columns_of
from obbhbb_ros.labels.image_grouper import ImageGrouper
from obbhbb_ros.labels.image_labels import DIAGNOSTICS
from obbhbb_ros.labels.image_labels import ImageBoxes
from obbhbb_ros.labels.image_labels import ImageLabels
from obbhbb_ros.labels.label_file import LabelError
from obbhbb_ros.labels.label_file import LabelFile
from obbhbb_ros.labels.label_format import Format

MAGIC = 'PAR1'
CORNERS = ('x1', 'y1', 'x2', 'y2', 'x3', 'y3', 'x4', 'y4')
BOUNDS = ('x_min', 'y_min', 'x_max', 'y_max')
GEOMETRY = ('geometry', 'geom', 'wkb')
RESERVED = {'image', 'instance', 'class', 'score', *BOUNDS, 'geometry'}
# The rows that are in memory at a time, and those of a row group.
BATCH_ROWS = 1 << 17


class ParquetColumns(NamedTuple):
    """
    What the columns of a file hold.

    `shape` names the eight columns of corners, the four of bounds or the one of polygons; the
    others are the names of columns, '' for none. `system` is the reference system as PROJJSON; None
    for pixels, or if the file names none. `crs` is the same as GIS libraries take it, '' for pixels
    and None if the file does not say.
    """

    shape: tuple[str, ...]
    image: str
    class_id: str
    instance: str
    score: str
    others: tuple[str, ...]
    system: dict[str, Any] | None
    crs: str | None


Batch: TypeAlias = tuple[Sequence[int], Any]
"""The numbers of rows, from 0, and a record batch."""


def _read(file: LabelFile) -> Iterator[ImageLabels]:
    with _opened(file) as (layout, batches):
        yield from _images(file, layout, batches)


@contextmanager
def _opened(file: LabelFile) -> Iterator[tuple[ParquetColumns, Iterator[Batch]]]:
    """Provide the layout of a file and its batches."""
    import pyarrow as pa
    from pyarrow import parquet

    try:
        with parquet.ParquetFile(file.path) as reader:
            size = file.path.stat().st_size
            if reader.metadata.num_rows > size:
                rows = f'{reader.metadata.num_rows} rows in {size} bytes'
                raise file.error(f'{rows}: less than a byte for each box')
            layout = _layout(file, reader.schema_arrow)
            yield layout, _numbered(reader.iter_batches(BATCH_ROWS))
    except (pa.ArrowException, OSError) as error:
        raise file.error(f'not Parquet: {error}') from error


def _numbered(batches: Iterable[Any]) -> Iterator[Batch]:
    first = 0
    for batch in batches:
        if batch.num_rows:
            yield range(first, first + batch.num_rows), batch
        first += batch.num_rows


def _layout(file: LabelFile, schema: Any) -> ParquetColumns:
    names: list[str] = schema.names
    if len(set(names)) < len(names):
        raise file.error(f'columns named more than once: {", ".join(names)}')
    geo = _geo(file, schema.metadata or {})
    geometry = geo.get('primary_column', '') or next((n for n in GEOMETRY if n in names), '')
    shapes_of = [shape for shape in (CORNERS, BOUNDS, (geometry,)) if set(shape) <= set(names)]
    if not shapes_of:
        raise file.error(f'no corners, bounds or geometry among its columns: {", ".join(names)}')
    shape = shapes_of[0]
    image, class_id = _role(names, shapes.IMAGE), _role(names, shapes.CLASS)
    instance, score = _role(names, shapes.INSTANCE), _role(names, shapes.SCORE)
    own = {*shape, image, class_id, instance, score}
    others = tuple(name for name in names if name not in own)
    system, crs = None, '' if shape != (geometry,) else None
    if geo and crs is None:
        system, crs = _system(file, geo['columns'][geometry])
    return ParquetColumns(shape, image, class_id, instance, score, others, system, crs)


def _role(names: Sequence[str], wanted: Sequence[str]) -> str:
    lower = {name.lower(): name for name in reversed(names)}
    return next((lower[name] for name in wanted if name in lower), '')


def _geo(file: LabelFile, metadata: Mapping[bytes, bytes]) -> dict[str, Any]:
    """Return the metadata of GeoParquet, empty if there is none."""
    if b'geo' not in metadata:
        return {}
    try:
        geo = json.loads(metadata[b'geo'])
        encoding = geo['columns'][geo['primary_column']]['encoding']
    except (ValueError, LookupError, TypeError, RecursionError) as error:
        raise file.error(f'not GeoParquet: its metadata cannot be read: {error!r}') from None
    if encoding != 'WKB':
        raise file.error(f'the geometry is encoded as {encoding!r}: only WKB is read')
    return dict(geo)


def _system(file: LabelFile, column: Mapping[str, Any]) -> tuple[dict[str, Any] | None, str | None]:
    """Return the reference system of a geometry as PROJJSON and as GIS libraries take it."""
    # As the standard has it, none given means longitude and latitude, and null an unknown one.
    if 'crs' not in column:
        return None, maps.LONGITUDE_LATITUDE
    system = column['crs']
    if system is None:
        return None, None
    if not isinstance(system, dict):
        raise file.error('not GeoParquet: the reference system of the geometry is no PROJJSON')
    number = system.get('id')
    if isinstance(number, dict) and {'authority', 'code'} <= number.keys():
        return system, f'{number["authority"]}:{number["code"]}'
    return system, json.dumps(system)


def _images(
    file: LabelFile, layout: ParquetColumns, batches: Iterable[Batch]
) -> Iterator[ImageLabels]:
    if len(layout.shape) == 1:
        records = file.parse_records(_records(layout, batches), partial(_record, file, layout))
        yield from maps.map_images(file, records, lambda: layout.crs)
        return
    images = ImageGrouper()
    for numbers, batch in batches:
        images.add(*_parse(file, layout, numbers, batch))
    yield from images.images()


def _records(layout: ParquetColumns, batches: Iterable[Batch]) -> Iterator[Any]:
    for numbers, batch in batches:
        for number, row in zip(numbers, batch.to_pylist(), strict=True):
            yield None, f'row {number}: ', row


def _record(file: LabelFile, layout: ParquetColumns, row: dict[str, Any]) -> shapes.Outlined:
    wkb = row.pop(layout.shape[0])
    try:
        geometry = None if wkb is None else shapely.from_wkb(wkb)
    except (shapely.errors.GEOSException, TypeError) as error:
        raise ValueError(f'not WKB: {error}') from None
    return shapes.feature_record(file.path.stem, row, shapes.outer_rings(geometry))


def _parse(
    file: LabelFile, layout: ParquetColumns, numbers: Sequence[int], batch: Any
) -> tuple[Sequence[str], Sequence[bool], ImageLabels]:
    """Parse a batch by columns; rows that are no box are reported and left out."""
    import pyarrow as pa

    shape = np.column_stack([_numbers(file, batch, name) for name in layout.shape])
    scores = np.ones(len(shape))
    if layout.score:
        given = _numbers(file, batch, layout.score)
        scores = np.where(np.isnan(given), 1.0, given)
    bad = ~(np.isfinite(shape).all(axis=1) & np.isfinite(scores))
    _report(file, numbers, bad, 'a coordinate or the score is null or not finite')
    if layout.shape == BOUNDS:
        inverted = ~bad & (shape[:, 2:] < shape[:, :2]).any(axis=1)
        _report(file, numbers, inverted, 'the box has a maximum below its minimum')
        bad |= inverted
    if bad.any():
        batch, shape, scores = batch.filter(pa.array(~bad)), shape[~bad], scores[~bad]
    images = [image or file.path.stem for image in _texts(batch, layout.image)]
    return images, [True] * len(images), _table(file, layout, batch, shape, scores)


def _numbers(file: LabelFile, batch: Any, name: str) -> FloatArray:
    from obbhbb_ros.arrow import numbers_of

    try:
        return numbers_of(name, batch[name])
    except ValueError as error:
        raise file.error(str(error)) from None


def _report(file: LabelFile, numbers: Sequence[int], rows: NDArray[np.bool_], message: str) -> None:
    for row in np.flatnonzero(rows).tolist():
        file.on_error(LabelError(file.path, None, f'row {numbers[row]}: {message}'))


def _table(
    file: LabelFile, layout: ParquetColumns, batch: Any, shape: FloatArray, scores: FloatArray
) -> ImageLabels:
    upright = layout.shape == BOUNDS
    return ImageLabels(
        image='',
        corners=shapes.upright_rows(shape) if upright else shape.reshape(-1, 4, 2),
        class_ids=tuple(_texts(batch, layout.class_id)),
        ids=tuple(_texts(batch, layout.instance)),
        scores=scores,
        reference=shape if upright else np.full((len(shape), 4), np.nan),
        hulls=(None,) * len(shape),
        size=file.image_size,
        source=file.path,
        extras=Extras(
            properties={name: tuple(batch[name].to_pylist()) for name in layout.others},
        ),
    )


def _texts(batch: Any, name: str) -> list[str]:
    """Return a column as text, '' where it is null or there is none."""
    return list(map(plain_text, batch[name].to_pylist())) if name else [''] * batch.num_rows


def rewrite(
    file: LabelFile,
    target: Path,
    rule: HullRule,
    caps: Caps,
    refused: Callable[[ImageLabels], None],
) -> tuple[int, int] | None:
    """
    Convert a file to another one batch by batch; rows keep their order, other columns their types.

    `refused` gets the labels of rows that can be read and not converted. Returns the number of
    images and of boxes; if there is no box, nothing is written. None if the boxes are not oriented,
    or in degrees.
    """
    with _opened(file) as (layout, batches):
        first = next(batches, None)
        if layout.shape == BOUNDS or _in_degrees(file, layout, first):
            return None
        in_units = layout._replace(crs=layout.crs or '')
        rewriting = _Rewriting(file, in_units, rule, caps, refused)
        everything = chain([] if first is None else [first], batches)
        converted = filter(len, map(rewriting.convert, everything))
        start = next(converted, None)
        if start is not None:
            _write_batches(target, start.schema, chain([start], converted), layout.system)
    return len(rewriting.images), rewriting.boxes


def _in_degrees(file: LabelFile, layout: ParquetColumns, batch: Batch | None) -> bool:
    """Tell whether the boxes are in degrees: by the first rows, if the file does not say."""
    if layout.system is not None and layout.system.get('type') == 'ProjectedCRS':
        # Known without the extra `geo`.
        return False
    system = layout.crs
    if system is None and batch is not None:
        silent = replace(file, on_error=lambda _: None)
        rows = _records(layout, [(batch[0], batch[1].slice(0, BLOCK))])
        system = maps.probable_system(silent.parse_records(rows, partial(_record, file, layout)))
    return maps.is_geographic(file, system or '')


class _Rewriting:
    """Converts batches and counts their images and boxes; the parameters are those of `rewrite`."""

    def __init__(
        self,
        file: LabelFile,
        layout: ParquetColumns,
        rule: HullRule,
        caps: Caps,
        refused: Callable[[ImageLabels], None],
    ) -> None:
        self._file, self._layout, self._rule, self._caps = file, layout, rule, caps
        self._refused = refused
        self.images: set[str] = set()
        self.boxes = 0

    def convert(self, numbered: Batch) -> Any:
        """Return the rows that can be converted, without the columns of the oriented box."""
        from obbhbb_ros.arrow import convert_batch

        layout, (numbers, batch) = self._layout, numbered
        try:
            done = convert_batch(batch, layout.shape, self._rule, self._caps)
        except ValueError as error:
            raise self._file.error(str(error)) from None
        missing = done[BOUNDS[0]].is_null()
        if done[BOUNDS[0]].null_count:
            rows = np.flatnonzero(missing.to_numpy(zero_copy_only=False)) + numbers[0]
            for labels in _images(self._file, layout, [(rows.tolist(), batch.filter(missing))]):
                self._refused(labels)
            done = done.filter(done[BOUNDS[0]].is_valid())
        names = done[layout.image].unique().to_pylist() if layout.image else [None]
        self.images.update(plain_text(name) or self._file.path.stem for name in names)
        self.boxes += done.num_rows
        return done.select([name for name in done.schema.names if name not in layout.shape])


def _write_boxes(path: Path, images: list[ImageBoxes]) -> None:
    import pyarrow as pa

    crs = shapes.only_system(images)
    table = pa.table({name: _array(values) for name, values in _columns(images).items()})
    _write_batches(path, table.schema, table.to_batches(BATCH_ROWS), _projjson(crs))


def _columns(images: Sequence[ImageBoxes]) -> dict[str, Any]:
    """Turn the boxes of all images into columns."""
    boxes = np.concatenate([np.zeros((0, 4)), *(image.xyxy for image in images)])
    diagnosed = any(image.diagnostics is not None for image in images)
    properties = columns_of([row.properties for image in images for row in image.rows(RESERVED)])
    return {
        'image': [image.image for image in images for _ in image.class_ids],
        'instance': [instance for image in images for instance in image.ids],
        'class': [name for image in images for name in image.class_ids],
        'score': np.concatenate([np.zeros(0), *(image.scores for image in images)]),
        **dict(zip(BOUNDS, boxes.T, strict=True)),
        **{
            name: np.concatenate([getattr(image.diagnostics, name) for image in images])
            for name in (DIAGNOSTICS if diagnosed else ())
        },
        **properties,
    }


def _array(values: Any) -> Any:
    """Turn values into a column; of mixed types, into one of text."""
    import pyarrow as pa

    try:
        return pa.array(values, from_pandas=True)
    except (pa.ArrowException, OverflowError):
        return pa.array([None if value is None else plain_text(value) for value in values])


def _projjson(crs: str) -> dict[str, Any] | None:
    """Return a reference system as GeoParquet names it: not at all for longitude and latitude."""
    if not crs:
        return None
    if crs == maps.LONGITUDE_LATITUDE:
        return {}
    import pyproj

    return dict(pyproj.CRS.from_user_input(crs).to_json_dict())


def _write_batches(
    path: Path, schema: Any, batches: Iterable[Any], system: Mapping[str, Any] | None
) -> None:
    """Write batches that have `BOUNDS`; GeoParquet if there is a reference system."""
    import pyarrow as pa
    from pyarrow import parquet

    schema = schema.remove_metadata()
    if system is not None:
        named = {'crs': system} if system else {}
        column = {'encoding': 'WKB', 'geometry_types': ['Polygon'], **named}
        geo = {'version': '1.0.0', 'primary_column': 'geometry', 'columns': {'geometry': column}}
        schema = schema.append(pa.field('geometry', pa.binary()))
        schema = schema.with_metadata({'geo': json.dumps(geo)})
    repeated = [field.name for field in schema if _repeats(field)]
    with (
        replacing(path) as whole,
        parquet.ParquetWriter(whole, schema, use_dictionary=repeated) as writer,
    ):
        for batch in batches:
            columns = list(batch.columns)
            if system is not None:
                bounds = [batch[name].to_numpy() for name in BOUNDS]
                columns.append(pa.array(shapely.to_wkb(shapely.box(*bounds))))
            writer.write_batch(pa.RecordBatch.from_arrays(columns, schema=schema), BATCH_ROWS)


def _repeats(field: Any) -> bool:
    """Tell whether a dictionary of values saves space: of coordinates, it costs time and space."""
    import pyarrow as pa

    return field.name != 'geometry' and not pa.types.is_floating(field.type)


FORMAT = Format(
    name='parquet',
    suffixes=('.parquet', '.geoparquet'),
    summary=(
        f'Parquet of many images, one box per row: {", ".join(CORNERS)}, or {", ".join(BOUNDS)}; '
        'GeoParquet of polygons (extra `arrow`)'
    ),
    sniff=lambda head: head.startswith(MAGIC),
    read=_read,
    write_boxes=_write_boxes,
    holds=('diagnostics', 'scores', 'ids', 'properties', 'reference system'),
    reserved=RESERVED,
)
