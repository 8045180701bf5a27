# SPDX-License-Identifier: Apache-2.0
"""
Files of ships for geographic information systems: a point for each ship, with typed fields.

GeoJSON, CSV and KML need nothing else; GeoPackage needs the extra `geo`, GeoParquet `arrow`.
"""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Callable
from collections.abc import Iterable
from collections.abc import Sequence
from datetime import datetime
from datetime import timedelta
from datetime import timezone
from pathlib import Path
from typing import Any
from typing import NamedTuple
from xml.sax.saxutils import escape

import numpy as np
import shapely

from obbhbb_ros.files import SMALL_BYTES
from obbhbb_ros.files import read_bounded
from obbhbb_ros.files import replacing
from obbhbb_ros.files import write_pieces
from obbhbb_ros.files import write_text
from obbhbb_ros.ground.ship_rows import ShipRow
from obbhbb_ros.labels.vector_files import GEOPACKAGE_OPTIONS
from obbhbb_ros.labels.vector_files import save_frame
from obbhbb_ros.progress import printable
from obbhbb_ros.reports.ship_report import ShipReport

_EPOCH = datetime(1970, 1, 1, tzinfo=timezone.utc)
_MILLISECOND = timedelta(milliseconds=1)
_SEPARATOR = '; '
# As many as the JSON of chips has: the steps of messages fall between them.
_PLACE_DECIMALS = 7
_SIGMA_DECIMALS = 3
# WGS84, as files beside a CSV table name it.
_WKT = (
    'GEOGCS["WGS 84",DATUM["WGS_1984",SPHEROID["WGS 84",6378137,298.257223563,'
    'AUTHORITY["EPSG","7030"]],AUTHORITY["EPSG","6326"]],PRIMEM["Greenwich",0],'
    'UNIT["degree",0.0174532925199433],AUTHORITY["EPSG","4326"]]\n'
)


class ShipColumn(NamedTuple):
    """
    A field of the table.

    Attributes
    ----------
    kind : str
        `text`, `number`, `count`, `truth` or `time`.
    of : callable
        Returns the value of a row; None if it is not known.
    """

    kind: str
    of: Callable[[ShipRow], Any]


def _of_facts(name: str) -> Callable[[ShipRow], Any]:
    return lambda row: getattr(row.facts, name)


def _text(name: str) -> ShipColumn:
    return ShipColumn('text', lambda row: printable(getattr(row.facts, name)) or None)


def _number(name: str, decimals: int) -> ShipColumn:
    return ShipColumn('number', lambda row: _real(getattr(row.facts, name), decimals))


def _sigma(index: int) -> ShipColumn:
    return ShipColumn(
        'number', lambda row: _real((row.facts.sigma_m or [None] * 3)[index], _SIGMA_DECIMALS)
    )


def _real(value: float | None, decimals: int) -> float | None:
    """Return a number as one with a point: readers take the type of a field from its values."""
    return None if value is None else round(float(value), decimals)


def _place(row: ShipRow) -> tuple[float, float]:
    """Return longitude and latitude."""
    longitude, latitude = (
        round(float(degrees), _PLACE_DECIMALS)
        for degrees in (row.facts.longitude, row.facts.latitude)
    )
    return longitude, latitude


def _time(name: str) -> ShipColumn:
    return ShipColumn('time', lambda row: utc_time(getattr(row.facts, name)))


def utc_time(nanoseconds: int) -> datetime:
    """Return a time, nanoseconds since 1970, down to the millisecond."""
    return _EPOCH + nanoseconds // 1_000_000 * _MILLISECOND


def _joined(texts: Iterable[object]) -> str | None:
    """Join texts; None if there are none."""
    return _SEPARATOR.join(printable(str(text)) for text in texts) or None


SHIP_COLUMNS = {
    'id': _text('id'),
    'class': _text('class_id'),
    'score': _number('score', 3),
    'latitude': _number('latitude', _PLACE_DECIMALS),
    'longitude': _number('longitude', _PLACE_DECIMALS),
    'sigma_major_m': _sigma(0),
    'sigma_minor_m': _sigma(1),
    'sigma_azimuth': _sigma(2),
    'length_m': _number('length_m', 1),
    'width_m': _number('width_m', 1),
    'course': _number('course', 1),
    'course_ambiguous': ShipColumn('truth', _of_facts('course_ambiguous')),
    'speed': _number('speed', 1),
    'speed_sigma': _number('speed_sigma', _SIGMA_DECIMALS),
    'course_over_ground': _number('course_over_ground', 1),
    'course_over_ground_sigma': _number('course_over_ground_sigma', _SIGMA_DECIMALS),
    'first': _time('first'),
    'last': _time('last'),
    'views': ShipColumn('count', _of_facts('views')),
    'best_view': ShipColumn(
        'text', lambda row: _joined([row.best_view.path] if row.best_view else [])
    ),
    'files': ShipColumn('text', lambda row: _joined(row.files)),
    'other_ids': ShipColumn('text', lambda row: _joined(row.other_ids)),
}
"""The fields, in the order of the table."""


def write_ships(path: Path, rows: Sequence[ShipRow]) -> None:
    """
    Write a file of ships, in the format of its suffix, one of `SHIP_FILES`.

    Raises
    ------
    ValueError
        If the suffix is unknown.
    ModuleNotFoundError
        If what the format needs is not installed.
    OSError
        If the file cannot be written.
    """
    ship_writer(path)(path, rows)


def ship_writer(path: Path) -> Callable[[Path, Sequence[ShipRow]], None]:
    """Return what writes files of a suffix; ValueError if nothing does."""
    writer = SHIP_FILES.get(path.suffix.lower())
    if writer is None:
        raise ValueError(f'{path}: the suffix must be one of {", ".join(SHIP_FILES)}')
    return writer


def _write_geojson(path: Path, rows: Sequence[ShipRow]) -> None:
    dump = json.JSONEncoder(ensure_ascii=False, allow_nan=False, default=_time_text).encode
    features = (
        f'{"," if number else ""}\n' + dump(_feature(row)) for number, row in enumerate(rows)
    )
    write_pieces(path, ['{"type": "FeatureCollection", "features": [', *features, '\n]}\n'])


def _feature(row: ShipRow) -> dict[str, Any]:
    return {
        'type': 'Feature',
        'geometry': {'type': 'Point', 'coordinates': _place(row)},
        'properties': {name: column.of(row) for name, column in SHIP_COLUMNS.items()},
    }


def _time_text(time: datetime) -> str:
    """Write a time as RFC 3339 has it."""
    return time.replace(tzinfo=None).isoformat(timespec='milliseconds') + 'Z'


# Names of the kinds for GDAL, in a file beside a table.
_CSVT = {
    'text': 'String',
    'number': 'Real',
    'count': 'Integer',
    'truth': 'Integer(Boolean)',
    'time': 'DateTime',
}


def _write_csv(path: Path, rows: Sequence[ShipRow]) -> None:
    system = path.with_suffix('.prj')
    if system.exists() and read_bounded(system, SMALL_BYTES) != _WKT.encode():
        raise ValueError(f'{system} belongs to another file: choose another name than {path.name}')
    text = io.StringIO()
    table = csv.writer(text, lineterminator='\n')
    table.writerow(SHIP_COLUMNS)
    table.writerows([_cell(column, row) for column in SHIP_COLUMNS.values()] for row in rows)
    write_text(path, text.getvalue())
    if path.is_file():
        places = {'latitude': 'CoordY', 'longitude': 'CoordX'}
        kinds = (places.get(name, _CSVT[column.kind]) for name, column in SHIP_COLUMNS.items())
        write_text(path.with_suffix('.csvt'), ','.join(f'"{kind}"' for kind in kinds) + '\n')
        write_text(system, _WKT)


def _cell(column: ShipColumn, row: ShipRow) -> object:
    value = column.of(row)
    if column.kind == 'truth':
        return int(value)
    return _time_text(value) if column.kind == 'time' else value


def _write_kml(path: Path, rows: Sequence[ShipRow]) -> None:
    start = (
        '<?xml version="1.0" encoding="UTF-8"?>\n'
        '<kml xmlns="http://www.opengis.net/kml/2.2"><Document><name>Ships</name>\n'
    )
    write_pieces(path, [start, *map(_placemark, rows), '</Document></kml>\n'])


def _placemark(row: ShipRow) -> str:
    facts, begin, end = row.facts, *(utc_time(time) for time in (row.facts.first, row.facts.last))
    longitude, latitude = _place(row)
    name = escape(printable(facts.id or facts.class_id or 'ship'))
    # Viewers take the description for HTML.
    description = escape(escape(described(facts)))
    return (
        f'<Placemark><name>{name}</name><description>{description}</description>'
        f'<TimeSpan><begin>{_time_text(begin)}</begin><end>{_time_text(end)}</end></TimeSpan>'
        f'<Point><coordinates>{longitude!r},{latitude!r}</coordinates></Point>'
        '</Placemark>\n'
    )


def course_text(facts: ShipReport) -> str:
    """Write a course; where bow and stern may be mixed up, both."""
    either = f' or {facts.course + 180.0:.0f}°' if facts.course_ambiguous else ''
    return f'{facts.course:.0f}°{either}'


def motion_text(facts: ShipReport) -> str:
    """Write speed and course over ground, what is known of them."""
    speed, course = facts.speed, facts.course_over_ground
    towards = '' if course is None else f'towards {course:.0f}°'
    return ' '.join(filter(None, ('' if speed is None else f'{speed:.1f} m/s', towards)))


def described(facts: ShipReport) -> str:
    """Describe a ship in a line: class, size, course, uncertainty."""
    size = f'{facts.length_m:.0f} x {facts.width_m:.0f} m'
    parts = [printable(facts.class_id), size, f'course {course_text(facts)}', motion_text(facts)]
    if facts.sigma_m is not None:
        parts.append(f'within {facts.sigma_m[0]:.1f} m')
    return ', '.join(filter(None, parts))


def _write_geopackage(path: Path, rows: Sequence[ShipRow]) -> None:
    import geopandas

    kinds = {'text': 'O', 'number': 'f8', 'count': 'i8', 'truth': '?', 'time': 'M8[ms]'}
    columns = {
        name: np.array([_naive(column.of(row)) for row in rows], kinds[column.kind])
        for name, column in SHIP_COLUMNS.items()
    }
    points = _points(rows)
    frame = geopandas.GeoDataFrame(columns, geometry=points, crs='EPSG:4326')
    for name, column in SHIP_COLUMNS.items():
        if column.kind == 'time':
            frame[name] = frame[name].dt.tz_localize('UTC')
    with replacing(path) as whole:
        options = {'engine': 'pyogrio', 'geometry_type': 'Point', **GEOPACKAGE_OPTIONS}
        save_frame(frame, whole, path, driver='GPKG', layer='ships', **options)


def _naive(value: Any) -> Any:
    """Take away the time zone of a time: NumPy has none."""
    return value.replace(tzinfo=None) if isinstance(value, datetime) else value


def _points(rows: Sequence[ShipRow]) -> Any:
    """Give an array of points, of shapely."""
    return shapely.points(np.array([_place(row) for row in rows]).reshape(-1, 2))


def _write_parquet(path: Path, rows: Sequence[ShipRow]) -> None:
    import pyarrow as pa
    from pyarrow import parquet

    kinds = {
        'text': pa.string(),
        'number': pa.float64(),
        'count': pa.int64(),
        'truth': pa.bool_(),
        'time': pa.timestamp('ms', tz='UTC'),
    }
    columns = {
        name: pa.array([column.of(row) for row in rows], kinds[column.kind])
        for name, column in SHIP_COLUMNS.items()
    }
    points = shapely.to_wkb(_points(rows))
    table = pa.table({**columns, 'geometry': pa.array(points.tolist(), pa.binary())})
    column = {'encoding': 'WKB', 'geometry_types': ['Point']}
    geo = {'version': '1.0.0', 'primary_column': 'geometry', 'columns': {'geometry': column}}
    with replacing(path) as whole:
        parquet.write_table(table.replace_schema_metadata({'geo': json.dumps(geo)}), whole)


SHIP_FILES = {
    '.geojson': _write_geojson,
    '.json': _write_geojson,
    '.gpkg': _write_geopackage,
    '.csv': _write_csv,
    '.parquet': _write_parquet,
    '.geoparquet': _write_parquet,
    '.kml': _write_kml,
}
"""What writes the files of a suffix."""
