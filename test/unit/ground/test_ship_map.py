# SPDX-License-Identifier: Apache-2.0
"""The map of the gallery: places, scale and graticule, anywhere on Earth."""

import math

import numpy as np
import pytest
from outboxes import make_placed_outbox
from test_gallery import gallery
from test_ship_tables import put_chip
from test_ship_tables import put_list
from test_ship_tables import report

from obbhbb_ros.ground.ship_map import ship_map

pytest.importorskip('jinja2')


def at(*places: tuple[float, float], **facts):
    """Report a ship at some latitudes and longitudes."""
    return [report('a', latitude=lat, longitude=lon, **facts) for lat, lon in places]


@pytest.mark.parametrize('latitude', [0.0, 36.1, -54.8, 78.2])
def test_distances_on_the_map_are_those_on_the_ground(latitude) -> None:
    pyproj = pytest.importorskip('pyproj')
    geod = pyproj.Geod(ellps='WGS84')
    azimuths = [0.0, 45.0, 90.0, 200.0, 310.0]
    ends = [geod.fwd(-5.4, latitude, azimuth, 3000.0)[:2] for azimuth in azimuths]
    drawn = ship_map(at((latitude, -5.4), *((lat, lon) for lon, lat in ends)))
    metres = {'1 km': 1000.0, '2 km': 2000.0}[drawn.bar_label]
    x, y = np.array(drawn.places).T
    east = (x[1:] - x[0]) / drawn.bar * metres
    north = -(y[1:] - y[0]) / drawn.bar / drawn.aspect * metres
    expected = 3000.0 * np.array(
        [[math.sin(math.radians(a)), math.cos(math.radians(a))] for a in azimuths]
    )
    assert np.abs(np.stack([east, north], axis=1) - expected).max() < 20.0


def test_the_lines_are_where_their_labels_say() -> None:
    drawn = ship_map(at((36.0, -5.5), (36.2, -5.3)))
    (x0, y0), (x1, y1) = drawn.places
    for lines, low, high, first, last in (
        (drawn.meridians, x0, x1, -5.5, -5.3),
        (drawn.parallels, y0, y1, 36.0, 36.2),
    ):
        assert 2 <= len(lines) <= 6
        for line in filter(lambda each: each.label, lines):
            degrees, _, rest = line.label.partition('°')
            minutes = float(rest.partition('′')[0]) if '′' in rest else 0.0
            value = (float(degrees) + minutes / 60.0) * (-1.0 if 'W' in rest else 1.0)
            share = (line.at - low) / (high - low)
            assert first + share * (last - first) == pytest.approx(value, abs=1e-4)


@pytest.mark.parametrize('latitude', [90.0, -89.9999])
def test_no_parallel_lies_beyond_a_pole(latitude) -> None:
    drawn = ship_map(at((latitude, 5.0)))
    labels = [line.label for line in drawn.parallels]
    assert any(label.startswith('89°') for label in labels)
    assert not any('90°0' in label for label in labels)


def test_ships_on_both_sides_of_the_date_line_are_neighbours() -> None:
    drawn = ship_map(at((-17.0, 179.9), (-17.0, -179.9)))
    (x0, _), (x1, _) = drawn.places
    assert 0.0 < x0 < x1 < 100.0
    labels = [line.label for line in drawn.meridians]
    assert '180°' in ' '.join(labels)
    assert any('E' in label for label in labels)
    assert any('W' in label for label in labels)


@pytest.mark.parametrize(
    'places',
    [
        [(90.0, 0.0)],
        [(-90.0, 180.0), (90.0, -180.0)],
        [(89.9, 10.0), (89.9, -170.0)],
        [(0.0, lon) for lon in range(-180, 180, 30)],
        [(36.1, -5.4)] * 3,
    ],
    ids=str,
)
@pytest.mark.parametrize('length', [0.0, 30.0, 1e300])
def test_any_places_and_lengths_give_a_map(places, length) -> None:
    drawn = ship_map(at(*places, length_m=length))
    assert np.isfinite(drawn.places).all()
    assert ((np.array(drawn.places) > 0.0) & (np.array(drawn.places) < 100.0)).all()
    assert np.isfinite(drawn.hulls).all()
    assert len(drawn.meridians) <= 6
    assert len(drawn.parallels) <= 6
    assert 0.0 < drawn.bar < 100.0


def test_a_hull_has_its_length_and_course() -> None:
    drawn = ship_map(at((36.1, -5.4), course=60.0, length_m=100.0))
    hull = drawn.hulls[0]
    east = (hull.x1 - hull.x0) / drawn.bar * 100.0
    north = -(hull.y1 - hull.y0) / drawn.bar / drawn.aspect * 100.0
    assert drawn.bar_label == '100 m'
    assert math.hypot(east, north) == pytest.approx(100.0, rel=1e-3)
    assert math.degrees(math.atan2(east, north)) == pytest.approx(60.0, abs=0.1)


@pytest.mark.parametrize('course', [0.0, 90.0])
@pytest.mark.parametrize('length', [80.0, 250.0, 400.0, 900.0])
@pytest.mark.parametrize('step', [0.0, 0.003])
def test_no_hull_is_cut_off(course, length, step) -> None:
    places = [(36.1, -5.4), (36.1 + step, -5.4), (36.1, -5.4 + step)]
    drawn = ship_map(at(*places, course=course, length_m=length))
    assert ((np.array(drawn.hulls) > 0.0) & (np.array(drawn.hulls) < 100.0)).all()


def test_each_card_tells_place_size_and_course_of_its_ship(tmp_path) -> None:
    put_chip(tmp_path / 'box', 'a', object='x-1')
    moving = {'speed': 7.5, 'course_over_ground': 190.0, 'sigma_m': (0.9, 0.5, 0.0)}
    put_list(tmp_path / 'box', 'l', report('x-1', latitude=-36.2, longitude=5.25, **moving))
    text = ' '.join(gallery(tmp_path / 'box').text.split())
    assert 'place36.20000° S, 5.25000° E ± 0.9 m size30 × 9 m course12°' in text
    assert 'motion7.5 m/s towards 190°' in text
    put_chip(tmp_path / 'other', 'a')
    text = ' '.join(gallery(tmp_path / 'other').text.split())
    assert 'place36.13570° N, 5.44230° W ± 4.2 m size187 × 28 m course71° or 251°' in text
    assert 'motion' not in text


def test_marks_lead_to_cards_and_listed_ships_have_rings(tmp_path) -> None:
    make_placed_outbox(tmp_path / 'box', 3)
    put_list(tmp_path / 'box', 'l', report('<b>"x-9"', latitude=36.13))
    page = gallery(tmp_path / 'box')
    cards = [card['id'] for card in page.all('div', 'card')]
    assert cards == ['card-1', 'card-2', 'card-3']
    assert [mark['href'] for mark in page.all('a', 'mark')] == [f'#{card}' for card in cards]
    (ring,) = page.all('i', 'mark')
    assert ring['title'] == '<b>"x-9": tug, 30 x 9 m, course 12°'
    assert '4 ships with a place' in page.text
    assert 'A ring, 1 of them, has no card' in page.text
    limited = gallery(tmp_path / 'box', '--limit', '1')
    assert len(limited.all('a', 'mark')) == 1
    assert len(limited.all('i', 'mark')) == 3


def test_lists_alone_give_a_map(tmp_path) -> None:
    put_list(tmp_path / 'box', 'l', report('x-1'))
    page = gallery(tmp_path / 'box')
    assert len(page.all('i', 'mark')) == 1
    assert page.all('div', 'card') == []


def test_without_places_there_is_no_map(tmp_path) -> None:
    put_chip(tmp_path / 'box', 'a', position=None)
    assert gallery(tmp_path / 'box').all('figure') == []
