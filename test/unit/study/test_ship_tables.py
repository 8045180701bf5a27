# SPDX-License-Identifier: Apache-2.0
"""obbhbb ships: the ships of lists and chips in one table, in every format."""

import csv
import json
from dataclasses import replace
from datetime import datetime
from pathlib import Path

import pytest
from outboxes import FIRST_STAMP
from outboxes import a_chip
from outboxes import put
from spooled import Clock
from spooled import feeder

from obbhbb_ros.cli import main
from obbhbb_ros.reports.ship_geojson import ship_geojson
from obbhbb_ros.reports.ship_list import LIST_KIND
from obbhbb_ros.reports.ship_list import LIST_SUFFIXES
from obbhbb_ros.reports.ship_message import ship_message
from obbhbb_ros.reports.ship_report import ShipReport
from obbhbb_ros.spool.feeder import ReleaseSettings
from obbhbb_ros.spool.list_spool import ListSpool
from obbhbb_ros.spool.outbox import Outbox
from obbhbb_ros.study.ship_files import SHIP_COLUMNS
from obbhbb_ros.study.ship_files import SHIP_FILES

POSITION = {
    'lat': 36.1357,
    'lon': -5.4423,
    'course': 71.2,
    'course_ambiguous': True,
    'length_m': 187.4,
    'width_m': 28.1,
    'sigma_m': [4.2, 3.1, 30.0],
    'look_deg': 12.5,
    'pose_age': 0.01,
}
SECOND = 10**9


def report(name: str, seconds: float = 0.0, **facts) -> ShipReport:
    """Report a tug, seen some seconds after the first stamp."""
    time = round((FIRST_STAMP + seconds) * SECOND)
    known = {
        'latitude': 36.1,
        'longitude': -5.4,
        'course': 12.0,
        'course_ambiguous': False,
        'length_m': 30.0,
        'width_m': 9.0,
        'class_id': 'tug',
        'score': 0.5,
        'first': time,
        'last': time,
    }
    return ShipReport(id=name, **known | facts)


def put_list(folder: Path, name: str, *ships: ShipReport, form: str = 'geojson') -> Path:
    """Put a ship list and its JSON into an outbox; return the list."""
    content = ship_geojson(ships) if form == 'geojson' else ship_message(ships, 340).content
    folder.mkdir(parents=True, exist_ok=True)
    facts = {'id': name, 'kind': LIST_KIND, 'bytes': len(content)}
    Outbox(folder).put(name, LIST_SUFFIXES[form], content, facts, 0)
    return folder / '0' / f'{name}.{LIST_SUFFIXES[form]}'


def put_chip(folder: Path, name: str, seconds: float = 0.0, **facts) -> Path:
    """Put a chip with a position into an outbox; return its JSON."""
    stamp = {'sec': FIRST_STAMP + int(seconds), 'nanosec': int(seconds % 1.0 * SECOND)}
    return put(folder, *a_chip(id=name, stamp=stamp, **{'position': POSITION} | facts))


def table(tmp_path: Path, *options: str, folders: tuple[str, ...] = ('box',)) -> list[dict]:
    """Write the ships of folders as GeoJSON, and read them."""
    path = tmp_path / 'ships.geojson'
    assert (
        main(['ships', *(str(tmp_path / each) for each in folders), '-o', str(path), *options]) == 0
    )
    features = json.loads(path.read_text(encoding='utf-8'))['features']
    for feature in features:
        facts = feature['properties']
        assert feature['geometry']['coordinates'] == [facts['longitude'], facts['latitude']]
    return [feature['properties'] for feature in features]


def test_a_chip_gives_a_row_with_all_its_facts(tmp_path) -> None:
    record = put_chip(tmp_path / 'box', 'a', 0.5, object='x-1', view=1, rank=0.1)
    (row,) = table(tmp_path)
    chip = str(record.with_suffix('.jpg'))
    facts, _ = a_chip()
    assert row == {
        'id': 'x-1',
        'class': facts['class_id'],
        'score': facts['score'],
        'latitude': 36.1357,
        'longitude': -5.4423,
        'sigma_major_m': 4.2,
        'sigma_minor_m': 3.1,
        'sigma_azimuth': 30.0,
        'length_m': 187.4,
        'width_m': 28.1,
        'course': 71.2,
        'course_ambiguous': True,
        'speed': None,
        'speed_sigma': None,
        'course_over_ground': None,
        'course_over_ground_sigma': None,
        'first': '2025-11-27T23:16:42.500Z',
        'last': '2025-11-27T23:16:42.500Z',
        'views': 1,
        'best_view': chip,
        'files': chip,
        'other_ids': None,
    }


def test_whole_numbers_are_numbers_with_a_point(tmp_path) -> None:
    place = POSITION | {'lat': 36, 'lon': -5, 'course': 71, 'length_m': 30, 'sigma_m': [4, 3, 0]}
    put_chip(tmp_path / 'box', 'a', position=place, score=1)
    (row,) = table(tmp_path)
    for name, column in SHIP_COLUMNS.items():
        assert column.kind != 'number' or type(row[name]) in (float, type(None)), name


def test_a_list_gives_a_row_for_each_ship(tmp_path, capsys) -> None:
    moving = {
        'speed': 7.5,
        'speed_sigma': 0.5,
        'course_over_ground': 190.0,
        'course_over_ground_sigma': 2.0,
    }
    path = put_list(tmp_path / 'box', 'l', report('x-1', **moving), report('x-2', 2.25, views=7))
    first, second = table(tmp_path)
    assert {name: first[name] for name in moving} == moving
    assert (first['id'], first['class'], first['score']) == ('x-1', 'tug', 0.5)
    assert (second['id'], second['views'], second['best_view']) == ('x-2', 7, None)
    assert second['first'] == second['last'] == '2025-11-27T23:16:44.250Z'
    assert second['files'] == str(path)
    assert 'ships: 2, of 1 ship lists and 0 chips\nwritten: ' in capsys.readouterr().out


def test_lists_and_chips_of_an_object_are_one_row_with_the_best_of_each_fact(tmp_path) -> None:
    box = tmp_path / 'box'
    put_list(box, 'l1', report('x-1', 0.0, last=(FIRST_STAMP + 9) * SECOND, views=4, score=0.7))
    put_list(box, 'l2', report('x-1', 60.0, class_id='ferry', score=0.9, sigma_m=(2.0, 1.0, 5.0)))
    facts = {'object': 'x-1', 'class_id': 'cargo', 'score': 0.8}
    put_chip(box, 'a', 3.0, value=0.4, **facts)
    best = put_chip(box, 'b', 4.0, value=0.6, **facts, position=None)
    put_chip(box, 'c', 5.0, value=0.9, **facts).with_suffix('.jpg').unlink()
    put_list(box, 'l3', report('x-2', 70.0))
    row, _ = table(tmp_path)
    # Best placed by the second list.
    assert (row['latitude'], row['sigma_major_m'], row['length_m']) == (36.1, 2.0, 30.0)
    assert (row['class'], row['score']) == ('ferry', 0.9)
    assert row['first'] == '2025-11-27T23:16:42.000Z'
    assert row['last'] == '2025-11-27T23:17:42.000Z'
    assert row['views'] == 5
    assert row['best_view'] == str(best.with_suffix('.jpg'))
    assert [Path(name).name.partition('.')[0] for name in row['files'].split('; ')] == [
        *('l1', 'l2'),
        *('c', 'b', 'a'),
    ]


def test_a_binary_message_is_read_without_its_json(tmp_path) -> None:
    path = put_list(tmp_path / 'box', 'm', report('x-7', sigma_m=(5.0, 4.0, 0.0)), form='message')
    path.with_suffix('.json').unlink()
    (row,) = table(tmp_path)
    assert (row['id'], row['class']) == ('x-7', 'tug')
    assert row['latitude'] == pytest.approx(36.1, abs=1e-5)
    assert row['length_m'] == pytest.approx(30.0, rel=0.01)


@pytest.mark.parametrize('max_bytes', [0, 340])
def test_the_lists_that_a_spool_releases_are_read(tmp_path, capsys, max_bytes) -> None:
    lists = ListSpool(tmp_path / 'spool', print)
    releasing = feeder(tmp_path, print, Clock(), ReleaseSettings())
    for first in (0, 25):
        ships = [report(f'09af31bc-{n}', n, views=2) for n in range(first, first + 30)]
        lists.add(ships, max_bytes)
        for _ in range(4):
            releasing.step()
    releasing.close()
    lists.close()
    rows = table(tmp_path, folders=('outbox',))
    assert [row['id'] for row in rows] == [f'09af31bc-{number}' for number in range(55)]
    # Five ships are in both lists.
    assert [row['views'] for row in rows] == [2] * 25 + [4] * 5 + [2] * 25
    said = capsys.readouterr()
    assert f'ships: 55, of {4 if max_bytes else 2} ship lists and 0 chips\n' in said.out
    assert 'obbhbb: ' not in said.err


def test_what_came_down_twice_counts_once(tmp_path) -> None:
    for folder in ('one', 'two'):
        put_list(tmp_path / folder, 'l', report('x-1', views=3))
        record = put_chip(tmp_path / folder, 'a', object='x-2')
        if folder == 'one':
            record.with_suffix('.jpg').unlink()
    listed, chip = table(tmp_path, folders=('one', 'two'))
    assert (listed['views'], chip['views']) == (3, 1)
    assert chip['best_view'] == str(record.with_suffix('.jpg'))


def test_what_has_no_place_or_is_damaged_is_left_out_and_counted(tmp_path, capsys) -> None:
    box = tmp_path / 'box'
    put_chip(box, 'a', object='x-1')
    put_chip(box, 'b', object='x-2', position=None)
    record = put_chip(box, 'c', object='x-3')
    record.write_bytes(record.read_bytes().replace(b'36.1357', b'39.1357'))
    assert [row['id'] for row in table(tmp_path)] == ['x-1']
    said = capsys.readouterr()
    assert 'left out: 1 chips whose JSON is damaged, 1 ships without a place\n' in said.out
    assert 'c.jpg: damaged: the digest of its JSON differs' in said.err


def test_no_table_is_written_if_no_ship_has_a_place(tmp_path, capsys) -> None:
    put_chip(tmp_path / 'box', 'a', position=None)
    path = tmp_path / 'ships.csv'
    assert main(['ships', str(tmp_path / 'box'), '-o', str(path)]) == 1
    assert 'no ships with a place: 1 ships without a place' in capsys.readouterr().err
    assert main(['ships', str(tmp_path / 'none'), '-o', str(path)]) == 1
    assert 'no such folder' in capsys.readouterr().err
    (tmp_path / 'empty').mkdir()
    assert main(['ships', str(tmp_path / 'empty'), '-o', str(path)]) == 1
    assert 'empty: neither ship lists nor chips' in capsys.readouterr().err
    assert not path.exists()


def test_an_unknown_suffix_is_refused_before_anything_is_read(tmp_path, capsys) -> None:
    assert main(['ships', str(tmp_path / 'none'), '-o', 'ships.dbf']) == 1
    assert 'ships.dbf: the suffix must be one of .geojson, .json, .gpkg' in capsys.readouterr().err


# Choosing and joining -------------------------------------------------------------------------


def north(metres: float) -> float:
    """Give the latitude some metres north of the tug."""
    return 36.1 + metres / 110_956.0


def test_only_ships_near_a_place_are_kept(tmp_path, capsys) -> None:
    ships = [report(f'x-{metres}', latitude=north(metres)) for metres in (0, 900, 1100)]
    put_list(tmp_path / 'box', 'l', *ships, report('far', latitude=-36.1, longitude=174.6))
    rows = table(tmp_path, '--near', '36.1', '-5.4', '1000')
    assert [row['id'] for row in rows] == ['x-0', 'x-900']
    assert 'left out: 2 ships away from --near\n' in capsys.readouterr().out
    assert len(table(tmp_path, '--near', '36.1', '-5.4', '19e6')) == 3
    assert len(table(tmp_path, '--near', '36.1', '-5.4', '3e7')) == 4


def test_only_ships_seen_since_a_time_and_long_enough_are_kept(tmp_path, capsys) -> None:
    ships = report('a', 0.0), report('b', 10.0, length_m=20.0), report('c', 20.0)
    put_list(tmp_path / 'box', 'l', *ships)
    for time in ('2025-11-27T23:16:52Z', '2025-11-27T23:16:52', '2025-11-28T01:16:52+02:00'):
        assert [row['id'] for row in table(tmp_path, '--since', time)] == ['b', 'c']
    capsys.readouterr()
    options = ('--since', '2025-11-27T23:16:52Z', '--min-length', '25')
    assert [row['id'] for row in table(tmp_path, *options)] == ['c']
    said = capsys.readouterr().out
    assert 'left out: 1 ships before --since, 1 ships below --min-length\n' in said


def test_objects_of_one_place_are_joined_if_they_were_seen_at_different_times(tmp_path) -> None:
    put_list(
        tmp_path / 'box',
        'l',
        report('a', 0.0, latitude=north(0.0), sigma_m=(3.0, 3.0, 0.0), views=2),
        # Alongside: in the same image.
        report('b', 0.0, latitude=north(15.0)),
        report('c', 100.0, latitude=north(4.0), sigma_m=(2.0, 2.0, 0.0), views=3, score=0.9),
        report('d', 100.0, latitude=north(16.0)),
        report('e', 200.0, latitude=north(60.0)),
    )
    rows = table(tmp_path, '--merge-within', '20')
    assert [(row['id'], row['other_ids'], row['views']) for row in rows] == [
        ('c', 'a', 5),
        ('d', 'b', 2),
        ('e', None, 1),
    ]
    assert rows[0]['score'] == 0.9
    assert rows[0]['first'] == '2025-11-27T23:16:42.000Z'
    assert rows[0]['last'] == '2025-11-27T23:18:22.000Z'
    assert len(table(tmp_path, '--merge-within', '0.5')) == 5


def test_chips_without_objects_are_joined_by_place(tmp_path) -> None:
    for name, seconds in (('a', 0.0), ('b', 1.0), ('c', 1.0)):
        put_chip(tmp_path / 'box', name, seconds, value=0.5)
    assert len(table(tmp_path)) == 3
    assert [row['views'] for row in table(tmp_path, '--merge-within', '10')] == [2, 1]


def test_many_ships_of_one_place_and_time_are_soon_told_apart(tmp_path) -> None:
    ships = [report(f'x-{number}') for number in range(2000)]
    put_list(tmp_path / 'box', 'l', *ships, report('late', 5.0))
    assert len(table(tmp_path, '--merge-within', '20')) == 2000


def test_a_gap_between_the_times_of_a_group_is_free_for_others(tmp_path) -> None:
    ships = report('a', 0.0), report('b', 100.0), report('c', 50.0), report('d', 100.0)
    sigmas = [(float(number + 1), 0.5, 0.0) for number in range(4)]
    known = [replace(ship, sigma_m=sigma) for ship, sigma in zip(ships, sigmas, strict=True)]
    put_list(tmp_path / 'box', 'l', *known)
    rows = table(tmp_path, '--merge-within', '20')
    assert [(row['id'], row['other_ids']) for row in rows] == [('a', 'b; c'), ('d', None)]


@pytest.mark.parametrize(
    'option',
    [
        *(('--merge-within', text) for text in ('0', '-1', 'nan', 'inf', '1e-300', 'x')),
        *(('--min-length', text) for text in ('0', 'nan')),
        ('--since', 'yesterday'),
        ('--near', '36', '5', 'x'),
        ('--near', '91', '5', '10'),
        ('--near', '36', 'nan', '10'),
        ('--near', '36', '5', '-1'),
    ],
    ids=' '.join,
)
def test_a_condition_that_makes_no_sense_is_refused(tmp_path, capsys, option) -> None:
    put_list(tmp_path / 'box', 'l', report('a'))
    try:
        code = main(['ships', str(tmp_path / 'box'), '-o', str(tmp_path / 'a.csv'), *option])
    except SystemExit as error:
        code = error.code
    assert code in (1, 2)
    assert option[0] in capsys.readouterr().err
    assert not (tmp_path / 'a.csv').exists()


# Formats --------------------------------------------------------------------------------------

HOSTILE = '<b>"a",\'&\x1b[31m\ud800\n=1+1'


@pytest.fixture
def box(tmp_path) -> Path:
    """Give an outbox of ships of which much, little and strange things are known."""
    moving = {'speed': 7.5, 'speed_sigma': 0.5, 'sigma_m': (4.2, 3.1, 30.0)}
    known = report('x-1', 0.25, course_over_ground=190.0, course_over_ground_sigma=2.0, **moving)
    ships = known, report('', 2.5, class_id='', score=None, course_ambiguous=True)
    put_list(tmp_path / 'box', 'l', *ships, report('x-2', longitude=179.99, latitude=-89.5))
    put_chip(tmp_path / 'box', 'a', 9.0, object='x-9', class_id=HOSTILE)
    return tmp_path / 'box'


def same(value: object, other: object) -> bool:
    """Compare two fields; what is not known is null, NaN or empty."""
    missing = [each in (None, '') or str(each) == 'nan' for each in (value, other)]
    return all(missing) or (not any(missing) and value == other)


def written(box: Path, suffix: str) -> Path:
    path = box.parent / f'ships{suffix}'
    assert main(['ships', str(box), '-o', str(path)]) == 0
    return path


@pytest.mark.parametrize('suffix', [suffix for suffix in SHIP_FILES if suffix != '.kml'])
def test_a_file_is_read_back_with_the_types_of_its_fields(box, tmp_path, suffix) -> None:
    geopandas = pytest.importorskip('geopandas')
    pytest.importorskip('pyogrio')
    rows = table(tmp_path)
    path = written(box, suffix)
    if 'parquet' in suffix:
        pytest.importorskip('pyarrow')
        frame = geopandas.read_parquet(path)
    else:
        frame = geopandas.read_file(path, engine='pyogrio')
    assert frame.crs.to_epsg() == 4326 or frame.crs.to_string() == 'OGC:CRS84'
    assert len(frame) == len(rows)
    for name, column in SHIP_COLUMNS.items():
        kind = frame[name].dtype.kind
        is_known = any(row[name] is not None for row in rows)
        assert kind in {'number': 'f', 'count': 'i', 'truth': 'bi', 'time': 'M'}.get(
            column.kind, 'OT'
        ), name
        assert is_known or column.kind == 'text'
    for (_, read), row in zip(frame.iterrows(), rows, strict=True):
        for name, column in SHIP_COLUMNS.items():
            value = row[name]
            if column.kind == 'time':
                value = datetime.fromisoformat(value.replace('Z', '+00:00'))
                assert read[name].tz_convert('UTC') == value, name
            else:
                assert same(read[name], value), name
        assert (read.geometry.x, read.geometry.y) == (row['longitude'], row['latitude'])


def test_kml_has_places_names_and_times(box, tmp_path) -> None:
    geopandas = pytest.importorskip('geopandas')
    pytest.importorskip('pyogrio')
    rows = table(tmp_path)
    frame = geopandas.read_file(written(box, '.kml'), engine='pyogrio')
    assert frame['Name'].to_list() == [row['id'] or row['class'] or 'ship' for row in rows]
    assert [(point.x, point.y) for point in frame.geometry] == [
        (row['longitude'], row['latitude']) for row in rows
    ]
    assert [str(time) for time in frame['begin']] == [str(time) for time in frame['end']]
    assert frame['begin'][1].isoformat() == '2025-11-27T23:16:42.250000+00:00'
    described = list(frame['description'])
    assert described[1] == 'tug, 30 x 9 m, course 12°, 7.5 m/s towards 190°, within 4.2 m'
    # What viewers show as HTML.
    assert described[3].startswith('&lt;b&gt;"a"')


def test_a_table_of_text_has_a_head_and_one_line_a_ship(box) -> None:
    with written(box, '.csv').open(encoding='utf-8', newline='') as stream:
        head, *rows = csv.reader(stream)
    assert head == list(SHIP_COLUMNS)
    assert len(rows) == 4


def test_the_reference_system_of_another_file_is_not_replaced(box, capsys) -> None:
    written(box, '.csv')
    written(box, '.csv')
    (box.parent / 'ships.prj').write_text('PROJCS["UTM"]')
    assert main(['ships', str(box), '-o', str(box.parent / 'ships.csv')]) == 1
    assert 'ships.prj belongs to another file: choose another name' in capsys.readouterr().err
    assert (box.parent / 'ships.prj').read_text() == 'PROJCS["UTM"]'


@pytest.mark.parametrize('suffix', SHIP_FILES)
def test_a_table_without_ships_is_written_if_none_meets_the_conditions(box, suffix) -> None:
    for module in ('geopandas', 'pyogrio', 'pyarrow'):
        pytest.importorskip(module)
    import geopandas

    path = box.parent / f'none{suffix}'
    assert main(['ships', str(box), '-o', str(path), '--min-length', '900']) == 0
    if suffix == '.gpkg':
        frame = geopandas.read_file(path)
        assert len(frame) == 0
        assert frame['first'].dtype.kind == 'M'
    assert path.stat().st_size > 0
