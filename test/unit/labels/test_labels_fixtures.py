# SPDX-License-Identifier: Apache-2.0
"""Label files that real tools wrote (`test/tools/label_fixtures.py`): read right, or refused."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest

from obbhbb_ros.geometry.boxes import FloatArray
from obbhbb_ros.geometry.boxes import OrientedBoxes
from obbhbb_ros.labels import ImageLabels
from obbhbb_ros.labels import maps
from obbhbb_ros.labels import read_labels
from obbhbb_ros.labels.image_names import bare_name

FOLDER = Path(__file__).parents[2] / 'data/labels'
INDEX = json.loads((FOLDER / 'index.json').read_text())
SAMPLES = {f'{sample["tool"]}: {sample["form"]}': sample for sample in INDEX['samples']}
SHIPS = [ship for ships in INDEX['ships'].values() for ship in ships]
EXPECTED = OrientedBoxes.from_xywhr([ship[1:] for ship in SHIPS])
# Tools round, and masks consist of whole pixels.
TOLERANCE, MASK_TOLERANCE = 0.02, 3.0
TOLERANCES = {
    # Whole numbers, the first one from 1.
    'supervision: VOC, box': 1.5,
    'x-anylabeling-cvhub: voc, rectangle': 1.0,
    # Six decimals, 0.1 m.
    'geopandas: csv, degrees': 0.2,
}
REFUSED = {
    'datumaro: label_me, polygon': 'LabelMe XML, which is not read',
    'datumaro: kitti_detection, box': 'KITTI text, which is not read',
    'datumaro: mot_seq_gt, box': 'MOT ground truth, which is not read',
    'datumaro: open_images, box': 'Open Images CSV, which is not read',
    'datumaro: segment_anything, mask': 'Segment Anything (SA-1B) JSON, which is not read',
    'supervision: CreateML, box': 'CreateML JSON, which is not read',
    'ultralytics: save_txt, pose': 'the lines look like poses',
    'ultralytics: to_json, rotated': 'JSON of Ultralytics results, which is not read',
    'ultralytics: to_csv, rotated': 'CSV of Ultralytics results, which is not read',
    'globox: via_json': 'VGG Image Annotator JSON, which is not read',
    'globox: openimage': 'Open Images CSV, which is not read',
    'x-anylabeling-cvhub: mot': 'MOT ground truth, which is not read',
    'x-anylabeling-cvhub: mots': 'MOTS text, which is not read',
    'x-anylabeling-cvhub: odvg': 'Grounding DINO (ODVG) JSON, which is not read',
    'x-anylabeling-cvhub: ppocr, rec': 'PaddleOCR text, which is not read',
}  # fmt: skip


def read(name: str) -> list[ImageLabels]:
    """Read a sample; a record that cannot be read is an error."""
    sample = SAMPLES[name]
    if sample['tool'] == 'geopandas' and 'csv' not in sample['form']:
        pytest.importorskip('geopandas' if 'geojson' not in sample['form'] else 'pyproj')
    return list(read_labels(FOLDER / sample['path'], image_size=tuple(INDEX['size'])))


@pytest.mark.parametrize('name', [name for name in SAMPLES if name not in REFUSED])
def test_a_file_of_a_real_tool_is_read_right(name: str) -> None:
    (labels,) = [image for image in read(name) if image.class_ids]
    assert bare_name(labels.image) == 'P1'
    # FlatGeobuf has an order of its own.
    rows = np.argsort(labels.class_ids)
    assert [labels.class_ids[row] for row in rows] == [ship[0] for ship in SHIPS]
    corners = in_pixels(labels)[rows]
    usual = MASK_TOLERANCE if SAMPLES[name]['carries'] == 'mask' else TOLERANCE
    tolerance = TOLERANCES.get(name, usual)
    if SAMPLES[name]['carries'] == 'box':
        assert_near(labels.reference[rows], bounds_of(EXPECTED.corners), tolerance)
    else:
        got = OrientedBoxes.from_corners(corners)
        assert_near(got.center, EXPECTED.center, tolerance)
        assert_near(got.length, EXPECTED.length, tolerance)
        assert_near(got.width, EXPECTED.width, tolerance)
        turn = np.sin(got.theta - EXPECTED.theta)
        assert_near(turn, np.zeros(len(SHIPS)), 2.0 * tolerance / min(EXPECTED.length))


def in_pixels(labels: ImageLabels) -> FloatArray:
    """Return corners of a map where `label_writers.py` has put them."""
    in_map = maps.restored(labels)
    if not in_map.extras.label_set.crs and in_map.corners.max() < 1000.0:
        return in_map.corners
    points = in_map.corners.reshape(-1, 2)
    if labels.extras.label_set.in_degrees:
        pyproj = pytest.importorskip('pyproj')
        there = pyproj.Transformer.from_crs('EPSG:4326', 'EPSG:32633', always_xy=True)
        points = np.column_stack(there.transform(*points.T))
    return ((points - (500_000.0, 6_650_000.0)) * (1.0, -1.0)).reshape(-1, 4, 2)


@pytest.mark.parametrize('name', list(REFUSED))
def test_a_file_of_a_format_that_is_not_read_is_refused_by_its_name(name: str) -> None:
    with pytest.raises(ValueError, match=re.escape(REFUSED[name])):
        read(name)


def bounds_of(corners: FloatArray) -> FloatArray:
    return np.hstack((corners.min(axis=1), corners.max(axis=1)))


def assert_near(values: FloatArray, expected: FloatArray, tolerance: float) -> None:
    np.testing.assert_allclose(values, expected, rtol=0.0, atol=tolerance)
