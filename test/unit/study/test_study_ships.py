# SPDX-License-Identifier: Apache-2.0
"""Ships from labels: what is kept, how they are banded, whose reference box is whose."""

import json
from dataclasses import replace

import numpy as np
import pytest
from fleets import REAL
from fleets import fleet
from fleets import labels

from obbhbb_ros.labels import write_labels
from obbhbb_ros.labels.extras import Extras
from obbhbb_ros.study.ships import Ships
from obbhbb_ros.study.ships import read_ships

UPRIGHT = [[0, 0, 20, 10], [50, 0, 70, 10]]


def test_images_of_one_name_are_one_image() -> None:
    ships = Ships.from_labels([labels(name, UPRIGHT) for name in ('b', 'a', 'b')])
    assert ships.image_of.tolist() == [0, 0, 1, 1, 0, 0]
    assert ships.image_count == 2


def test_boxes_without_area_are_left_out_and_counted() -> None:
    ships = Ships.from_labels([labels('a', [[0, 0, 20, 10], [5, 5, 5, 9]]), labels('b', UPRIGHT)])
    assert (len(ships), ships.skipped) == (3, 1)
    assert ships.boxes.valid.all()


@pytest.mark.parametrize('images', [[], [labels('a', [])]], ids=['no image', 'no box'])
def test_no_ships_is_an_error(images) -> None:
    with pytest.raises(ValueError, match='no ships'):
        Ships.from_labels(images)


def test_a_selection_numbers_its_images_anew() -> None:
    ships = fleet([[0, 0, 3, 1, 0]] * 4, images=[0, 1, 2, 2]).take([3, 1])
    assert ships.image_of.tolist() == [0, 1]
    assert ships.names == ('3', '1')
    with pytest.raises(ValueError, match='no ships'):
        ships.take(np.zeros(2, bool))


@pytest.mark.parametrize(
    ('degrees', 'tilt'),
    [(0, 0), (10, 10), (45, 45), (50, 40), (90, 0), (100, 10), (-30, 30), (-80, 10), (179, 1)],
)
def test_tilt_is_the_angle_to_the_nearest_image_axis(degrees, tilt) -> None:
    assert fleet([[0, 0, 9, 2, np.radians(degrees)]]).tilt == pytest.approx(tilt)


@pytest.mark.parametrize('sides', [(12, 3), (3, 12)])
def test_aspect_is_the_long_side_over_the_short_one(sides) -> None:
    assert fleet([[0, 0, *sides, 0.3]]).aspect == pytest.approx(4.0)


def test_references_are_read_from_their_own_file(tmp_path) -> None:
    write_labels(tmp_path / 'ships.csv', [labels('a', UPRIGHT)])
    drawn = [[1.0, 0.0, 20.0, 10.0]]
    write_labels(tmp_path / 'drawn.csv', [labels('a', drawn, drawn)])
    ships = read_ships([tmp_path / 'ships.csv'], reference=tmp_path / 'drawn.csv')
    assert ships.with_reference.tolist() == [True, False]
    assert ships.reference[0].tolist() == drawn[0]


def test_malformed_records_go_to_on_error(tmp_path) -> None:
    text = REAL.read_text(encoding='utf-8').splitlines()
    (tmp_path / 'ships.csv').write_text('\n'.join([*text[:3], 'x,1,ship,1,2,three'] + text[3:]))
    errors = []
    ships = read_ships([tmp_path / 'ships.csv'], on_error=errors.append)
    assert [error.line for error in errors] == [4]
    assert len(ships) == len(text) - 1
    with pytest.raises(ValueError, match=r'ships\.csv:4'):
        read_ships([tmp_path / 'ships.csv'])


def test_crowds_and_difficult_ships_are_left_out_and_counted() -> None:
    marked = replace(
        labels('a', [*UPRIGHT, [90, 0, 99, 9]]),
        extras=Extras(crowd=np.array([True, False, False]), difficulty=np.array([1, 2, 0])),
    )
    ships = Ships.from_labels([marked, labels('b', UPRIGHT)])
    assert (len(ships), ships.crowds, ships.difficult) == (3, 1, 1)
    assert ships.take([0]).crowds == 1


def test_ships_in_degrees_are_in_metres(tmp_path) -> None:
    ring = [[12.0, 60.0], [12.002, 60.0], [12.002, 60.0003], [12.0, 60.0003], [12.0, 60.0]]
    geometry = {'type': 'Polygon', 'coordinates': [ring]}
    feature = {'type': 'Feature', 'properties': {}, 'geometry': geometry}
    path = tmp_path / 'ships.geojson'
    path.write_text(json.dumps({'type': 'FeatureCollection', 'features': [feature]}))
    ships = read_ships([path])
    # A degree is 111,412 m of latitude, and 55,800 m of longitude, at 60 degrees north.
    assert ships.boxes.length == pytest.approx([111.6], abs=0.1)
    assert ships.boxes.width == pytest.approx([33.42], abs=0.01)
    assert ships.with_reference.tolist() == [True]
