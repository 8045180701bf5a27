# SPDX-License-Identifier: Apache-2.0
"""Ship lists, as GeoJSON and as short messages: written, read back, damaged."""

import gzip
import json
import math
import zlib
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from strategies import ship_reports

from obbhbb_ros.reports.ship_geojson import ship_geojson
from obbhbb_ros.reports.ship_list import read_ship_list
from obbhbb_ros.reports.ship_message import MIN_MESSAGE_BYTES
from obbhbb_ros.reports.ship_message import ship_message
from obbhbb_ros.reports.ship_report import MAX_LIST_BYTES
from obbhbb_ros.reports.ship_report import ShipListError
from obbhbb_ros.reports.ship_report import ShipReport
from obbhbb_ros.reports.ship_report import value_order

SHIPS = st.lists(ship_reports(), max_size=5)
TUG = ShipReport(
    id='09af31bc-12',
    latitude=36.1234567,
    longitude=-5.4,
    course=123.46,
    course_ambiguous=True,
    length_m=31.26,
    width_m=9.04,
    sigma_m=(12.34, 5.678, 33.3),
    class_id='tug',
    score=0.876,
    first=1_764_550_000_123_456_789,
    last=1_764_550_003_000_000_000,
    views=3,
    speed=5.12,
    speed_sigma=0.456,
    course_over_ground=303.0,
    course_over_ground_sigma=4.0,
)


def fleet(count):
    """Make up a fleet as a detector reports it, within half a degree."""
    random = np.random.default_rng(7)
    time = 1_764_550_000 * 10**9 + random.exponential(5e8, count).cumsum()
    numbers = 100 + random.integers(1, 5, count).cumsum()
    views = random.integers(1, 9, count)
    return [
        ShipReport(
            id=f'09af31bc-{numbers[i]}',
            latitude=36.1 + 0.5 * random.random(),
            longitude=-5.4 + 0.6 * random.random(),
            course=180.0 * random.random(),
            course_ambiguous=True,
            length_m=random.lognormal(4.0, 0.7),
            width_m=random.lognormal(2.3, 0.5),
            sigma_m=(
                random.uniform(6.0, 12.0),
                random.uniform(3.0, 6.0),
                180.0 * random.random(),
            ),
            class_id='ship',
            score=random.random(),
            first=int(time[i]),
            last=int(time[i]) + 1_300_000_000 * int(views[i] - 1),
            views=int(views[i]),
        )
        for i in range(count)
    ]


def read_anything(content):
    """Return the ships of a list, and why it cannot be read; one of both is empty."""
    try:
        return read_ship_list(content), ''
    except ShipListError as error:
        return [], str(error)


def encodable(text):
    """Return a text as it comes back: UTF-8 has no halves of surrogate pairs."""
    return text.encode(errors='replace').decode()


@given(SHIPS)
def test_geojson_gives_back_what_it_was_made_of(ships):
    back = read_ship_list(ship_geojson(ships))
    assert len(back) == len(ships)
    for ship, again in zip(ships, back, strict=True):
        assert (again.id, again.class_id) == (encodable(ship.id), encodable(ship.class_id))
        assert again.views == ship.views
        assert again.course_ambiguous == ship.course_ambiguous
        assert again.latitude == pytest.approx(ship.latitude, abs=0.51e-6)
        assert again.longitude == pytest.approx(ship.longitude, abs=0.51e-6)
        assert again.length_m == pytest.approx(ship.length_m, abs=0.051)
        assert again.width_m == pytest.approx(ship.width_m, abs=0.051)
        circle = 180.0 if ship.course_ambiguous else 360.0
        assert 0.0 <= again.course < circle
        off = (again.course - ship.course + circle / 2) % circle - circle / 2
        assert abs(off) <= 0.051
        for name in ('first', 'last'):
            assert abs(getattr(again, name) - getattr(ship, name)) <= 500_001
        for name in ('score', 'speed', 'speed_sigma', 'course_over_ground_sigma'):
            value, same = getattr(ship, name), getattr(again, name)
            assert (same is None) == (value is None)
            assert value is None or same == pytest.approx(value, rel=0.051, abs=0.051)
        assert (again.sigma_m is None) == (ship.sigma_m is None)
        if ship.sigma_m is not None:
            assert again.sigma_m[:2] == pytest.approx(ship.sigma_m[:2], rel=0.051)


@given(SHIPS)
def test_geojson_that_is_read_is_written_as_it_was(ships):
    content = ship_geojson(ships)
    assert ship_geojson(read_ship_list(content)) == content


def test_no_course_is_rounded_to_a_full_circle():
    ships = [
        replace(TUG, course=179.96, course_over_ground=359.96),
        replace(TUG, course=359.96, course_ambiguous=False),
    ]
    ambiguous, known = read_ship_list(ship_geojson(ships))
    assert (ambiguous.course, ambiguous.course_over_ground, known.course) == (0.0, 0.0, 0.0)


def test_a_message_holds_any_stamp_of_an_image():
    stamps = [-(2**31) * 10**9, 0, (2**31 - 1) * 10**9 + 999_999_999, (2**31 + 3) * 10**9]
    ships = [replace(TUG, first=stamp, last=stamp) for stamp in stamps]
    for ship, stamp in zip(ships, stamps, strict=True):
        (again,) = read_ship_list(ship_message([ship], 340).content)
        assert again.last == min(stamp // 10**9, 2**31 - 1) * 10**9
    assert len(read_ship_list(ship_message(ships, 340).content)) == len(stamps)


def test_geojson_is_what_rfc_7946_asks_for():
    document = json.loads(gzip.decompress(ship_geojson([TUG])))
    (feature,) = document['features']
    assert document['type'] == 'FeatureCollection'
    assert feature['type'] == 'Feature'
    assert feature['id'] == TUG.id
    assert feature['geometry'] == {'type': 'Point', 'coordinates': [-5.4, 36.123457]}
    assert feature['properties'] == {
        'course': 123.5,
        'course_ambiguous': True,
        'length_m': 31.3,
        'width_m': 9,
        'sigma_m': [12, 5.7, 33],
        'class': 'tug',
        'score': 0.88,
        'first': '2025-12-01T00:46:40.123Z',
        'last': '2025-12-01T00:46:43.000Z',
        'views': 3,
        'speed': 5.1,
        'speed_sigma': 0.46,
        'course_over_ground': 303,
        'course_over_ground_sigma': 4,
    }


def test_numbers_that_are_not_finite_are_left_out():
    odd = replace(TUG, score=math.inf, speed=math.nan, sigma_m=(1.0, math.nan, 3.0))
    (back,) = read_ship_list(ship_geojson([odd]))
    assert (back.score, back.speed, back.sigma_m) == (None, None, None)
    assert back.length_m == pytest.approx(TUG.length_m, abs=0.051)


def test_a_list_that_could_not_be_read_is_not_written():
    with pytest.raises(ShipListError, match='larger'):
        ship_geojson([replace(TUG, class_id='x' * MAX_LIST_BYTES)])


def test_a_ship_costs_forty_bytes_in_a_long_list():
    assert len(ship_geojson(fleet(1000))) / 1000 < 42
    assert len(ship_geojson(fleet(20))) / 20 < 62


@given(SHIPS)
def test_a_message_gives_back_what_it_was_made_of(ships):
    content, left_out = ship_message(ships, 10_000)
    assert not left_out
    back = read_ship_list(content)
    ranked = sorted(ships, key=value_order)
    ages = [ranked[0].last - ship.last for ship in ranked] if ranked else [0]
    step = max(1, (max(ages) - min(ages)) / 1e9 / 63)
    for ship, again in zip(ranked, back, strict=True):
        assert again.id in ('', encodable(ship.id))
        assert again.class_id in ('', encodable(ship.class_id))
        assert again.course_ambiguous == ship.course_ambiguous
        assert again.latitude == pytest.approx(ship.latitude, abs=3e-6)
        east = (again.longitude - ship.longitude + 180.0) % 360.0 - 180.0
        assert east == pytest.approx(0.0, abs=3e-6)
        circle = 180.0 if ship.course_ambiguous else 360.0
        turn = (again.course - ship.course + circle / 2) % circle - circle / 2
        assert abs(turn) <= circle / 500
        assert again.length_m == pytest.approx(min(max(ship.length_m, 0.5), 1006.0), rel=0.0075)
        assert again.width_m == pytest.approx(min(max(ship.width_m, 0.5), 72.8), rel=0.02)
        assert (again.score is None) == (ship.score is None)
        assert again.score is None or again.score == pytest.approx(ship.score, abs=0.036)
        assert again.views == min(ship.views, 15)
        assert step > 65535 or abs(again.last - ship.last) <= (step / 2 + 2) * 1e9
        assert (again.speed is None) == (ship.speed is None)
        assert again.speed is None or again.speed == pytest.approx(min(ship.speed, 30), abs=0.5)
        assert (again.sigma_m is None) == (ship.sigma_m is None)
        if ship.sigma_m is not None:
            for value, same in zip(ship.sigma_m[:2], again.sigma_m[:2], strict=True):
                assert min(value, 19000) <= same * (1 + 1e-6)
                assert same <= max(0.1, 1.51 * value)


@given(SHIPS)
def test_a_ship_takes_16_bytes_of_a_message(ships):
    one = ship_message([TUG], 10_000).content
    many = ship_message([TUG] * (1 + len(ships)), 10_000).content
    assert len(many) - len(one) == 16 * len(ships)


def test_a_message_keeps_the_ids_and_classes_of_a_fleet():
    ships = fleet(500)
    back = read_ship_list(ship_message(ships, 10_000).content)
    assert [ship.id for ship in back] == [ship.id for ship in sorted(ships, key=value_order)]
    assert {ship.class_id for ship in back} == {'ship'}


def test_a_message_holds_the_most_valuable_ships_that_fit():
    ships = fleet(100)
    content, left_out = ship_message(ships, 340)
    back = read_ship_list(content)
    assert len(content) <= 340
    assert len(back) == 19
    assert [ship.id for ship in left_out] == [ship.id for ship in sorted(ships, key=value_order)][
        19:
    ]


@given(st.lists(ship_reports(), min_size=1, max_size=40), st.integers(MIN_MESSAGE_BYTES, 400))
def test_no_message_is_too_large_and_none_is_empty(ships, max_bytes):
    content, left_out = ship_message(ships, max_bytes)
    assert len(content) <= max_bytes
    assert len(read_ship_list(content)) == len(ships) - len(left_out) > 0


def test_ids_and_classes_that_a_message_cannot_hold_are_left_open():
    ships = [replace(TUG, class_id=f'class {number}', id='x' * number) for number in range(20)]
    back = read_ship_list(ship_message(ships, 1000).content)
    assert {ship.id for ship in back} == {''}
    assert sum(not ship.class_id for ship in back) == 5
    far = [replace(TUG, id=f'a-{number}') for number in (5, 70_000, 2**32)]
    assert {ship.id for ship in read_ship_list(ship_message(far, 1000).content)} == {'', 'a-70000'}


def test_every_changed_bit_of_a_message_is_noticed():
    content = ship_message(fleet(3), 340).content
    for place in range(8 * len(content)):
        damaged = bytearray(content)
        damaged[place // 8] ^= 1 << place % 8
        with pytest.raises(ShipListError):
            read_ship_list(bytes(damaged))


@given(st.binary(max_size=300), st.booleans())
def test_hostile_messages_are_one_clear_error(content, is_sealed):
    body = b'SL\x01' + content
    if is_sealed:
        body += zlib.crc32(body).to_bytes(4, 'big')
    ships, reason = read_anything(body)
    assert len(reason) < 250
    assert all(math.isfinite(ship.latitude) for ship in ships)


FEATURE = json.loads(gzip.decompress(ship_geojson([TUG])))['features'][0]
JSON = st.recursive(
    st.one_of(st.none(), st.booleans(), st.integers(), st.floats(), st.text()),
    lambda inner: st.one_of(st.lists(inner, max_size=3), st.dictionaries(st.text(), inner)),
    max_leaves=5,
)


@given(st.sampled_from([*FEATURE, *FEATURE['properties']]), JSON)
def test_hostile_features_are_one_clear_error(key, value):
    properties = FEATURE['properties']
    changed = (
        {**FEATURE, key: value}
        if key in FEATURE
        else {**FEATURE, 'properties': {**properties, key: value}}
    )
    document = {'type': 'FeatureCollection', 'features': [changed]}
    ships, reason = read_anything(gzip.compress(json.dumps(document).encode()))
    assert ('feature 0' in reason) != bool(ships)
    assert len(reason) < 250
    assert all(ship.views >= 1 and math.isfinite(ship.course) for ship in ships)


@pytest.mark.parametrize(
    ('key', 'value', 'reason'),
    [
        # In no year of UTC.
        ('first', '0001-01-01T00:00:00+14:00', 'first: date value out of range'),
        ('last', '9999-12-31T23:59:59-14:00', 'last: date value out of range'),
        ('last', '2025-11-27T23:16:42', 'last: without a time zone'),
        # The views of several lists would not fit into a field of 64 bits.
        ('views', 2**40 + 1, 'views: not a number of views'),
        ('views', True, 'views: not a number of views'),
    ],
)
def test_values_that_no_table_can_hold_are_refused(key, value, reason):
    feature = {**FEATURE, 'properties': {**FEATURE['properties'], key: value}}
    document = {'type': 'FeatureCollection', 'features': [feature]}
    with pytest.raises(ShipListError, match=reason):
        read_ship_list(gzip.compress(json.dumps(document).encode()))


@pytest.mark.parametrize(
    ('content', 'reason'),
    [
        (b'', 'not a ship list'),
        (b'GIF89a', 'not a ship list'),
        (b'SL\x02' + bytes(20), 'known version'),
        (b'SL\x01' + bytes(20), 'checksum'),
        (gzip.compress(b'{'), 'not JSON'),
        (gzip.compress(b'\xff'), 'not JSON'),
        (gzip.compress(b'[' * 100_000), 'not JSON'),
        (gzip.compress(b'{"features": 1' + b'0' * 5000 + b'}'), 'not JSON'),
        (gzip.compress(b'[]'), 'not a FeatureCollection'),
        (gzip.compress(b'{"features": [{}]}'), 'geometry'),
        (gzip.compress(bytes(MAX_LIST_BYTES + 1)), 'larger'),
        (ship_geojson([TUG])[:-9], 'its end is missing'),
        (ship_geojson([TUG])[:40] + bytes(300), 'damaged'),
    ],
    # The files hold the time at which they were packed.
    ids=map(str, range(13)),
)
def test_files_that_are_no_ship_list_are_named(content, reason):
    with pytest.raises(ShipListError, match=reason):
        read_ship_list(content)
