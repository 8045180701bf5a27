# SPDX-License-Identifier: Apache-2.0
"""Record batches of oriented boxes become record batches of axis-aligned boxes."""

from __future__ import annotations

import numpy as np
import pytest
import shapely
from hypothesis import given
from hypothesis import strategies as st

from obbhbb_ros import HullRule
from obbhbb_ros import OrientedBoxes
from obbhbb_ros import convert
from obbhbb_ros.geometry.converter import Caps

pa = pytest.importorskip('pyarrow')
arrow = pytest.importorskip('obbhbb_ros.arrow')

BOX = [20.0, 30.0, 80.0, 30.0, 80.0, 50.0, 20.0, 50.0]
POLYGON = 'POLYGON ((20 30, 80 30, 80 50, 20 50, 20 30))'


def table_of(corners: np.ndarray) -> pa.Table:
    return pa.table(dict(zip(arrow.CORNERS, corners.T, strict=True)))


def bounds_of(batch: pa.RecordBatch) -> np.ndarray:
    return np.column_stack([batch[name].to_numpy(zero_copy_only=False) for name in arrow.BOUNDS])


def wkb(*texts: str | None) -> pa.Array:
    return pa.array([text and shapely.to_wkb(shapely.from_wkt(text)) for text in texts])


coordinates = st.floats(-1e6, 1e6)


@given(st.lists(st.lists(coordinates, min_size=8, max_size=8), max_size=30))
def test_the_boxes_are_those_of_convert(rows: list[list[float]]) -> None:
    corners = np.array(rows, np.float64).reshape(-1, 8)
    expected = convert(OrientedBoxes.from_corners(corners), q=2.2)
    batch = arrow.convert_batch(table_of(corners), rule=HullRule(q=2.2))
    np.testing.assert_array_equal(bounds_of(batch), expected)


def test_more_rows_than_a_block_keep_their_order() -> None:
    corners = np.array(BOX) + np.arange(20_000)[:, None]
    (batch,) = arrow.convert_batches(table_of(corners).to_batches())
    np.testing.assert_allclose(bounds_of(batch), convert(OrientedBoxes.from_corners(corners)))


def test_other_columns_stay_and_metadata_too() -> None:
    batch = pa.record_batch(
        {'mmsi': [7], **dict(zip(arrow.CORNERS, [[v] for v in BOX], strict=True))}
    )
    batch = batch.replace_schema_metadata({'made': 'by hand'})
    converted = arrow.convert_batch(batch)
    assert isinstance(converted, pa.RecordBatch)
    assert converted.select(batch.schema.names).equals(batch)
    assert converted.schema == arrow.converted_schema(batch.schema)
    assert converted.schema.metadata == {b'made': b'by hand'}


@pytest.mark.parametrize(
    'column',
    [
        pa.array([BOX], pa.list_(pa.float32())),
        pa.array([BOX], pa.large_list(pa.float64())),
        pa.array([BOX], pa.list_(pa.float64(), 8)),
        pa.array([[int(value) for value in BOX]]),
        wkb(POLYGON),
        wkb(POLYGON).cast(pa.large_binary()),
        wkb('MULTIPOLYGON (((20 30, 80 30, 80 50, 20 50, 20 30)))'),
    ],
    ids=lambda column: str(column.type),
)
def test_one_column_holds_corners_or_a_polygon(column: pa.Array) -> None:
    converted = arrow.convert_batch(pa.table({'box': column}), ['box'])
    assert bounds_of(converted).tolist() == [[20, 30, 80, 50]]


@pytest.mark.parametrize(('angle', 'degrees'), [(np.pi / 2, False), (90, True)])
def test_five_columns_hold_centre_size_and_angle(angle: float, degrees: bool) -> None:
    values = dict(zip('xywhr', ([50], [40], [60], [20], [angle]), strict=True))
    converted = arrow.convert_batch(pa.table(values), list('xywhr'), degrees=degrees)
    np.testing.assert_allclose(bounds_of(converted), [[40, 10, 60, 70]])


def test_caps_bound_the_boxes() -> None:
    converted = arrow.convert_batch(table_of(np.array([BOX])), caps=Caps(max_length=50.0))
    assert bounds_of(converted).tolist() == [[25, 30, 75, 50]]


@pytest.mark.parametrize(
    'column',
    [
        pa.array([BOX, None]),
        pa.array([BOX, None], pa.list_(pa.float64(), 8)),
        pa.array([BOX, [*BOX[:7], None]]),
        pa.array([BOX, [*BOX[:7], np.nan]]),
        pa.array([BOX, [*BOX[:7], np.inf]]),
        pa.array([BOX, [1e300, -1e300] * 4]),
        pa.array([BOX, [5] * 8]),
        wkb(POLYGON, None),
        wkb(POLYGON, 'POINT (1 2)'),
        wkb(POLYGON, 'LINESTRING (0 0, 9 0, 9 9)'),
        wkb(POLYGON, 'POLYGON EMPTY'),
        wkb(POLYGON, 'POLYGON ((0 0, 1e200 0, 1e200 9, 0 0))'),
        pa.array([wkb(POLYGON)[0].as_py(), b'\x01\x06\xff\xff\xff\xff']),
    ],
)
def test_a_row_that_cannot_be_converted_is_null_and_the_others_are_boxes(column: pa.Array) -> None:
    for rows, expected in (([0, 1], [20.0, None]), ([1, 0, 1], [None, 20.0, None])):
        converted = arrow.convert_batch(pa.table({'box': column.take(pa.array(rows))}), ['box'])
        for name in arrow.BOUNDS:
            assert converted[name].is_null().to_pylist() == [value is None for value in expected]
        assert converted['x_min'].to_pylist() == expected


def test_polygons_of_any_number_of_corners_keep_their_rows() -> None:
    triangle = 'POLYGON ((0 0, 10 0, 10 10, 0 0))'
    polygons = [triangle, POLYGON, triangle, POLYGON]
    converted = arrow.convert_batch(pa.table({'box': wkb(*polygons)}), ['box'])
    alone = [
        bounds_of(arrow.convert_batch(pa.table({'box': wkb(polygon)}), ['box']))[0].tolist()
        for polygon in polygons
    ]
    assert bounds_of(converted).tolist() == alone


@pytest.mark.parametrize(
    ('columns', 'named', 'message'),
    [
        ({'box': [[1.0, 2.0]]}, ['box'], 'no lists of eight numbers'),
        ({'box': ['POLYGON']}, ['box'], 'no lists of eight numbers'),
        ({'box': [BOX]}, ['bow'], "no columns 'bow' among box"),
        ({'box': [BOX]}, ['box'] * 3, 'eight, five or one, not 3'),
        ({'x': ['1']}, ['x'] * 5, "'x' holds string, not numbers"),
        ({'box': [BOX], 'x_min': [0]}, ['box'], "a column 'x_min' already"),
    ],
)
def test_columns_that_are_no_boxes_are_refused(columns, named, message) -> None:
    with pytest.raises(ValueError, match=message):
        arrow.convert_batch(pa.table(columns), named)


def test_an_empty_batch_gives_an_empty_batch() -> None:
    converted = arrow.convert_batch(table_of(np.empty((0, 8))))
    assert converted.num_rows == 0
    assert converted.schema.names == [*arrow.CORNERS, *arrow.BOUNDS]
