# SPDX-License-Identifier: Apache-2.0
"""Figures of boxes: by hand, against shapely, and what always holds between them."""

import numpy as np
import pytest
import shapely
from fleets import REAL
from hypothesis import given
from hypothesis import strategies as st

from obbhbb_ros import OrientedBoxes
from obbhbb_ros import convert
from obbhbb_ros.geometry.methods import METHODS
from obbhbb_ros.study.metrics import overlap_with_hbb
from obbhbb_ros.study.metrics import overlap_with_obb
from obbhbb_ros.study.ships import read_ships

COORDINATE = st.floats(-50.0, 50.0)
SIDE = st.floats(0.1, 60.0)
QUARTER = np.pi / 2.0
ANGLE = st.one_of(
    st.floats(-4.0, 4.0), st.sampled_from([0.0, QUARTER, -QUARTER, np.pi, np.pi / 4, 1e-9, 1e-17])
)
BOX = st.tuples(COORDINATE, COORDINATE, SIDE, SIDE)


def xyxy_of(box):
    x, y, width, height = box
    return np.array([[x - width / 2, y - height / 2, x + width / 2, y + height / 2]])


@given(box=BOX, oriented=BOX, theta=ANGLE)
def test_the_area_shared_with_an_oriented_box_is_that_of_clipped_polygons(
    box, oriented, theta
) -> None:
    boxes = OrientedBoxes.from_xywhr([(*oriented, theta)])
    # Older releases of shapely warn where nothing is shared.
    with np.errstate(invalid='ignore'):
        expected = shapely.intersection(
            shapely.box(*xyxy_of(box)[0]), shapely.Polygon(boxes.corners[0])
        ).area
    shared = overlap_with_obb(xyxy_of(box), boxes).shared[0]
    assert shared == pytest.approx(expected, rel=1e-9, abs=1e-8)


@given(box=BOX, turns=st.integers(-3, 3))
def test_an_oriented_box_that_is_upright_shares_all_of_itself(box, turns) -> None:
    x, y, width, height = box
    if turns % 2:
        width, height = height, width
    boxes = OrientedBoxes.from_xywhr([(x, y, width, height, turns * QUARTER)])
    found = overlap_with_obb(xyxy_of(box), boxes)
    assert found.iou[0] == pytest.approx(1.0, abs=1e-9)
    assert found.relative_error[0] == pytest.approx(0.0, abs=1e-9)


@given(box=BOX, other=BOX)
def test_both_protocols_agree_where_the_reference_is_upright(box, other) -> None:
    upright = OrientedBoxes.from_xywhr([(*other, 0.0)])
    by_obb = overlap_with_obb(xyxy_of(box), upright)
    by_hbb = overlap_with_hbb(xyxy_of(box), xyxy_of(other))
    for name in ('iou', 'overshoot', 'undershoot', 'average_error', 'relative_error', 'coverage'):
        expected = pytest.approx(getattr(by_hbb, name), rel=1e-9, abs=1e-8)
        assert getattr(by_obb, name) == expected, name


def test_figures_of_a_box_worked_out_by_hand() -> None:
    # 10 x 10 over 10 x 20, shifted by half: 50 shared of 100 and 200.
    found = overlap_with_hbb(np.array([[0.0, 0, 10, 10]]), np.array([[0.0, 5, 10, 25]]))
    assert found.iou == pytest.approx(50 / 250)
    assert found.overshoot == pytest.approx(0.5)
    assert found.undershoot == pytest.approx(0.75)
    assert found.average_error == pytest.approx(0.625)
    assert found.relative_error == pytest.approx(0.5)
    assert found.coverage == pytest.approx(0.25)


@pytest.mark.parametrize(('threshold', 'matches'), [(0.2, True), (0.21, False)])
def test_a_match_is_an_iou_of_the_threshold_or_more(threshold, matches) -> None:
    found = overlap_with_hbb(np.array([[0.0, 0, 4, 4]]), np.array([[0.0, 2, 4, 10]]))
    assert found.iou[0] == 0.2
    assert found.match(threshold)[0] == matches


@given(oriented=BOX, theta=ANGLE)
def test_outer_misses_nothing_of_the_oriented_box_and_its_iou_is_what_it_does_not_add(
    oriented, theta
) -> None:
    # The paper's ShipRSImageNet table: 0.4929 = 1 - 0.5071, undershoot 0.
    boxes = OrientedBoxes.from_xywhr([(*oriented, theta)])
    found = overlap_with_obb(convert(boxes, method='outer'), boxes)
    assert found.undershoot[0] == pytest.approx(0.0, abs=1e-9)
    assert found.iou[0] == pytest.approx(1.0 - found.overshoot[0], abs=1e-9)


@given(x=COORDINATE, y=COORDINATE, side=SIDE)
def test_a_diagonal_square_fills_half_of_its_outer_box(x, y, side) -> None:
    boxes = OrientedBoxes.from_xywhr([(x, y, side, side, np.pi / 4)])
    assert overlap_with_obb(convert(boxes, method='outer'), boxes).iou[0] == pytest.approx(0.5)


@pytest.mark.parametrize('method', METHODS)
def test_iou_follows_from_overshoot_and_undershoot(method) -> None:
    ships = read_ships([REAL])
    xyxy = convert(ships.boxes, method=method)
    for found in (overlap_with_obb(xyxy, ships.boxes), overlap_with_hbb(xyxy, ships.reference)):
        inside, kept = 1.0 - found.overshoot, 1.0 - found.undershoot
        np.testing.assert_allclose(1.0 / found.iou, 1.0 / inside + 1.0 / kept - 1.0)


def test_the_papers_order_of_methods_comes_out_against_the_oriented_box() -> None:
    # Its ShipRSImageNet table: shape-aware, outer, area-equivalent, Gaussian, each as published.
    ships = read_ships([REAL])
    rules = {
        'shape_aware': {'q': 2.2, 'f': 0.9},
        'outer': {},
        'area_equivalent_published': {},
        'gaussian_published': {},
    }
    means = [
        overlap_with_obb(convert(ships.boxes, method=name, **parameters), ships.boxes).iou.mean()
        for name, parameters in rules.items()
    ]
    assert means == sorted(means, reverse=True)


@pytest.mark.parametrize(
    ('overlap', 'reference'),
    [
        (overlap_with_hbb, np.array([[0.0, 0, 1, 1]])),
        (overlap_with_obb, OrientedBoxes.from_xywhr([[0, 0, 2, 1, 0.3]])),
    ],
)
def test_a_box_of_nan_gives_nan_and_matches_nothing(overlap, reference) -> None:
    found = overlap(np.full((1, 4), np.nan), reference)
    assert np.isnan(found.iou).all()
    assert not found.match().any()
