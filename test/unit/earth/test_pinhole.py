# SPDX-License-Identifier: Apache-2.0
"""Pixels to rays and back: pixel centres, window, binning, distortion."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from obbhbb_ros.earth.pinhole import Pinhole

K = [1500.0, 0.0, 1023.5, 0.0, 1480.0, 767.5, 0.0, 0.0, 1.0]
PLUMB_BOB = [-0.25, 0.08, 0.001, -0.0007, 0.01]
# Coefficients that nearly cancel, as calibrations give them.
RATIONAL = [24.1, -8.3, 0.0004, -0.0002, 2.9, 24.4, -2.6, 1.4]
EQUIDISTANT = [-0.012, 0.03, -0.02, 0.004]
LENSES = [
    ('plumb_bob', []),
    ('plumb_bob', [-0.2, 0.05, 0.0, 0.0]),
    ('plumb_bob', PLUMB_BOB),
    ('plumb_bob', [0.4, 0.1, -0.002, 0.003, 0.05]),
    ('rational_polynomial', RATIONAL),
    ('equidistant', EQUIDISTANT),
]


def grid(width=2048.0, height=1536.0):
    """Give pixels all over an image, its corners among them."""
    x, y = np.meshgrid(np.linspace(0, width, 41), np.linspace(0, height, 31))
    return np.stack((x.ravel(), y.ravel()), axis=1)


def by_the_page(ray, model, d):
    """Bend one ray as the pages of OpenCV have it."""
    x, y = ray[0] / ray[2], ray[1] / ray[2]
    r = np.hypot(x, y)
    if model == 'equidistant':
        theta = np.arctan(r)
        k1, k2, k3, k4 = d
        bent = theta * (1 + k1 * theta**2 + k2 * theta**4 + k3 * theta**6 + k4 * theta**8)
        return (x * bent / r, y * bent / r) if r else (0.0, 0.0)
    k1, k2, p1, p2, k3, k4, k5, k6 = [*d, *[0.0] * (8 - len(d))]
    radial = (1 + k1 * r**2 + k2 * r**4 + k3 * r**6) / (1 + k4 * r**2 + k5 * r**4 + k6 * r**6)
    return (
        x * radial + 2 * p1 * x * y + p2 * (r**2 + 2 * x**2),
        y * radial + p1 * (r**2 + 2 * y**2) + 2 * p2 * x * y,
    )


@pytest.mark.parametrize(('model', 'd'), LENSES)
def test_rays_meet_the_image_where_opencv_has_them(model, d) -> None:
    camera = Pinhole(K, d, model)
    for ray in ((0, 0, 1), (0.3, -0.2, 1), (-0.5, 0.4, 1.0), (0.1, 0.05, 0.5)):
        x, y = by_the_page(ray, model, d)
        # The centre of the first pixel is at 0 there, and at 1/2 here.
        expected = K[0] * x + K[2] + 0.5, K[4] * y + K[5] + 0.5
        np.testing.assert_allclose(camera.pixels([ray]), [expected], rtol=0, atol=1e-9)


@pytest.mark.parametrize(('model', 'd'), LENSES)
def test_a_pixel_has_the_ray_that_meets_it(model, d) -> None:
    camera = Pinhole(K, d, model)
    rays = camera.rays(grid())
    assert np.isfinite(rays).all()
    np.testing.assert_allclose(camera.pixels(7.0 * rays), grid(), rtol=0, atol=1e-9)


@given(st.lists(st.floats(-0.5, 0.5), min_size=5, max_size=5), st.floats(0.0, 0.99))
def test_a_ray_before_the_fold_of_the_model_comes_back(d, share) -> None:
    d[2:4] = d[2] / 100, d[3] / 100
    camera = Pinhole([1.0, 0, 0, 0, 1.0, 0, 0, 0, 1], d)
    # The radius where the model folds, by steps.
    radii = np.linspace(0.0, 3.0, 3001)[1:]
    seen = np.isfinite(camera.pixels(np.stack((radii, 0 * radii, 1 + 0 * radii), axis=1))[:, 0])
    fold = radii[-1] if seen.all() else radii[np.argmin(seen)] - 1e-3
    angles = np.linspace(0, 2 * np.pi, 24)
    radius = share * fold
    rays = np.stack((radius * np.cos(angles), radius * np.sin(angles), np.ones(24)), axis=1)
    pixels = camera.pixels(rays)
    there = np.isfinite(pixels[:, 0])
    back = camera.rays(pixels[there])
    np.testing.assert_allclose(camera.pixels(back), pixels[there], rtol=0, atol=1e-12)
    # Beside the fold a ray is as uncertain as the root of the rounding.
    np.testing.assert_allclose(back, rays[there], rtol=0, atol=1e-6)


def test_what_lies_beyond_the_fold_of_the_model_has_no_ray() -> None:
    # r (1 - 0.2 r²) is largest, 0.861, at r = 1.291.
    camera = Pinhole([1000.0, 0, 0, 0, 1000.0, 0, 0, 0, 1], [-0.2, 0.0, 0.0, 0.0, 0.0])
    assert np.isfinite(camera.rays([[860.5, 0.5], [0.5, 860.5]])).all()
    assert np.isnan(camera.rays([[862.5, 0.5], [5000.5, 9.0], [np.nan, 3.0], [np.inf, 0]])).all()
    assert np.isfinite(camera.pixels([[1.29, 0, 1]])).all()
    assert np.isnan(camera.pixels([[1.3, 0, 1], [2.0, 0, 1], [0.1, 0, -1], [0, 0, 0]])).all()


def test_a_fisheye_sees_behind_itself() -> None:
    camera = Pinhole([300.0, 0, 0, 0, 300.0, 0, 0, 0, 1], [0.0] * 4, 'equidistant')
    sideways, behind = camera.rays([[300 * np.pi / 2 + 0.5, 0.5], [0.5, 300 * 2.5 + 0.5]])
    np.testing.assert_allclose(sideways, (1, 0, 0), atol=1e-12)
    np.testing.assert_allclose(behind, (0, np.sin(2.5), np.cos(2.5)), atol=1e-12)
    np.testing.assert_allclose(camera.pixels([behind]), [(0.5, 750.5)])
    assert np.isnan(camera.rays([[300 * 3.15, 0.5]])).all()


@given(
    st.tuples(st.integers(0, 900), st.integers(0, 700)),
    st.tuples(st.integers(1, 8), st.integers(1, 8)),
)
def test_window_and_binning_leave_the_rays_of_the_sensor(offset, binning) -> None:
    full = Pinhole(K, PLUMB_BOB)
    part = Pinhole(K, PLUMB_BOB, 'plumb_bob', offset, binning)
    pixels = grid(128.0, 96.0)
    on_sensor = pixels * binning + offset
    np.testing.assert_allclose(part.rays(pixels), full.rays(on_sensor), rtol=0, atol=1e-13)
    np.testing.assert_allclose(part.pixels(part.rays(pixels)), pixels, rtol=0, atol=1e-9)


def test_binning_of_zero_is_none() -> None:
    pixels = [[3.0, 4.0]]
    assert (Pinhole(K, binning=(0, 0)).rays(pixels) == Pinhole(K).rays(pixels)).all()


def test_the_axes_of_pixels_may_be_skew() -> None:
    camera = Pinhole([1000.0, 50.0, 0, 0, 1000.0, 0, 0, 0, 1])
    np.testing.assert_allclose(camera.pixels([[0, 1, 1]]), [(50.5, 1000.5)])
    np.testing.assert_allclose(camera.rays([[50.5, 1000.5]]), [(0, 1, 1)], atol=1e-15)


@pytest.mark.parametrize(
    ('arguments', 'reason'),
    [
        (([0.0] * 9,), 'not calibrated'),
        ((K[:8],), 'nine'),
        (([np.nan, *K[1:]],), 'finite'),
        (([-1.0, *K[1:]],), 'no camera'),
        (([*K[:8], 0.0],), 'no camera'),
        ((K, [np.inf]), 'not finite'),
        ((K, [1e10]), '1e9'),
        ((K, [0.1], 'kannala_brandt'), 'supported are plumb_bob, rational_polynomial, equidistant'),
        ((K, [0.0] * 8 + [0.1], 'rational_polynomial'), '8 coefficients of rational_polynomial'),
        ((K, [], '', (np.nan, 0)), 'window'),
    ],
)
def test_what_is_no_camera_is_refused_with_the_reason(arguments, reason) -> None:
    with pytest.raises(ValueError, match=reason):
        Pinhole(*arguments)


def test_a_coefficient_next_to_nothing_is_no_distortion() -> None:
    for d in ([-5e-324], [0, 0, 0, 0, -5e-324], [0, 0, 0, 0, 0, -5e-324]):
        np.testing.assert_allclose(Pinhole(K, d).rays(grid()), Pinhole(K).rays(grid()))


@pytest.mark.parametrize('model', ['', 'none', 'plumb_bob'])
def test_without_distortion_the_model_does_not_matter(model) -> None:
    assert (Pinhole(K, [0.0] * 14, model).rays(grid()) == Pinhole(K).rays(grid())).all()
