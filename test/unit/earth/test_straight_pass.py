# SPDX-License-Identifier: Apache-2.0
"""A straight pass: what `earth` finds is what the image shows, whatever the window."""

from __future__ import annotations

import numpy as np
import pytest

from obbhbb_ros.earth.pinhole import Pinhole
from obbhbb_ros.earth.placement import place
from obbhbb_ros.earth.straight_pass import StraightPass
from obbhbb_ros.labels.passes import pass_over
from obbhbb_ros.study.harbour import harbour

pyproj = pytest.importorskip('pyproj')
GEOD = pyproj.Geod(ellps='WGS84')


@pytest.mark.parametrize('latitude', [0.0, 54.2, -71.0, 89.9])
@pytest.mark.parametrize(('altitude', 'tolerance'), [(500e3, 1e-4), (1e3, 0.05)])
def test_every_ship_of_every_window_is_where_it_is_in_the_image(
    latitude: float, altitude: float, tolerance: float
) -> None:
    labels = harbour()
    assert labels.size is not None
    pixel = 0.8
    over = StraightPass(latitude, 12.1, altitude, pixel, labels.size)
    true = labels.boxes()
    latitudes, longitudes = over.places(true.center)
    seen = 0
    for top, part in pass_over(labels, 300, 100):
        boxes = part.boxes()
        camera = Pinhole(over.k(300), ())
        ships = place(boxes, camera, over.pose(top, 300))
        rows = [
            int(np.flatnonzero(np.hypot(*(true.center - center - (0, top)).T) < 1e-6)[0])
            for center in boxes.center
        ]
        _, _, off = GEOD.inv(longitudes[rows], latitudes[rows], ships.longitude, ships.latitude)
        assert np.max(off) < tolerance
        np.testing.assert_allclose(ships.length, true.length[rows] * pixel, rtol=1e-4)
        # East is +x of the image, south +y; meridians meet toward the pole.
        if abs(latitude) < 60.0:
            turn = (ships.course - 90.0 - np.degrees(boxes.theta) + 90.0) % 180.0 - 90.0
            assert np.abs(turn).max() < 0.02
        seen += len(rows)
    assert seen > 2 * len(true)


def test_the_image_is_north_up_and_the_camera_flies_south() -> None:
    over = StraightPass(54.2, 12.1, 500e3, 1.0, (1000, 800))
    (north, south, west, east), (_, _, left, right) = over.places(
        [(500, 0), (500, 800), (0, 400), (1000, 400)]
    )
    assert north > 54.2 > south
    assert left < 12.1 < right
    np.testing.assert_allclose((north + south) / 2, 54.2, atol=1e-7)
    np.testing.assert_allclose((west, east), 54.2, atol=1e-7)
    _, _, height = GEOD.inv(12.1, north, 12.1, south)
    _, _, width = GEOD.inv(left, west, right, east)
    np.testing.assert_allclose((width, height), (1000.0, 800.0), atol=1e-3)
    first, last = over.pose(0, 100).position, over.pose(700, 100).position
    np.testing.assert_allclose(np.linalg.norm(first - last), 700.0, atol=1e-6)
    np.testing.assert_array_equal(over.pose(0, 100).attitude, over.pose(700, 100).attitude)
