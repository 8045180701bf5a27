# SPDX-License-Identifier: Apache-2.0
"""Whatever a file holds, a reader with `on_error` ends, and what it yields is sound."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck
from hypothesis import given
from hypothesis import settings
from hypothesis import strategies as st
from sound_labels import SOUND

from obbhbb_ros.labels import FORMATS
from obbhbb_ros.labels import LabelError
from obbhbb_ros.labels import read_labels

DOCUMENTS = (
    'coco',
    'coco_results',
    'datumaro',
    'geojson',
    'labelme',
    'label_studio',
    'ultralytics',
)
MEMBERS = ('id', 'type', 'coordinates', 'x', 'value')
JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=3),
    lambda inner: (
        st.lists(inner, max_size=4)
        | st.dictionaries(
            st.sampled_from(['id', 'type', 'coordinates', 'x', 'value']), inner, max_size=4
        )
    ),
    max_leaves=8,
)
anywhere = settings(suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None)


def _read(path: Path, format_name: str) -> tuple[int, list[LabelError]]:
    errors: list[LabelError] = []
    count = 0
    for labels in read_labels(path, format_name, image_size=(9, 9), on_error=errors.append):
        assert np.isfinite(labels.corners).all()
        assert np.isfinite(labels.scores).all()
        count += len(labels.class_ids)
    assert all(error.path == path for error in errors)
    return count, errors


def test_every_text_format_has_an_example() -> None:
    files = {'shapefile', 'geopackage', 'flatgeobuf', 'parquet'}
    assert set(SOUND) == set(FORMATS) - files


@pytest.mark.parametrize('format_name', list(SOUND))
def test_the_undamaged_file_holds_one_box(tmp_path: Path, format_name: str) -> None:
    path = tmp_path / 'file'
    path.write_text(SOUND[format_name])
    assert _read(path, format_name) == (1, [])


@pytest.mark.parametrize('format_name', list(SOUND))
@given(begin=st.integers(0, 600), length=st.integers(0, 40), patch=st.binary(max_size=8))
@anywhere
def test_a_damaged_file_ends_in_boxes_or_errors(
    tmp_path: Path, format_name: str, begin: int, length: int, patch: bytes
) -> None:
    sound = SOUND[format_name].encode()
    begin %= len(sound)
    path = tmp_path / 'file'
    path.write_bytes(sound[:begin] + patch + sound[begin + length :])
    _read(path, format_name)


def _places(document: object) -> list[tuple[object, ...]]:
    """List the path to every value in a JSON document."""
    items = (
        document.items() if isinstance(document, dict)
        else enumerate(document) if isinstance(document, list) else ()
    )  # fmt: skip
    return [(), *((key, *rest) for key, value in items for rest in _places(value))]


@pytest.mark.parametrize(
    'format_name', ['coco', 'geojson', 'labelme', 'label_studio', 'ultralytics']
)
@given(data=st.data(), value=JSON)
@anywhere
def test_any_value_in_any_place_of_a_document_ends_in_boxes_or_errors(
    tmp_path: Path, format_name: str, data: st.DataObject, value: object
) -> None:
    document = json.loads(SOUND[format_name])
    *above, last = data.draw(st.sampled_from(_places(document)[1:]))
    parent = document
    for key in above:
        parent = parent[key]
    parent[last] = value
    path = tmp_path / 'file'
    path.write_text(json.dumps(document))
    _read(path, format_name)


@pytest.mark.parametrize(
    ('format_name', 'text', 'message'),
    [
        (
            'label_studio',
            SOUND['label_studio'].replace('"height": 20', '"height": 1e308'),
            'the box is so large that a coordinate is not finite',
        ),
        (
            'labelme',
            SOUND['labelme'].replace('[9, 2]', '[1e308, 1e308]').replace('[1, 4]', '[-1e308, 4]'),
            'beyond',
        ),
        (
            'wkt',
            'image,wkt\na,"POLYGON ((1e400 2, 9 2, 9 4, 1 4, 1e400 2))"\n',
            'a coordinate that is not finite',
        ),
        (
            'coco',
            SOUND['coco'].replace('[1, 2, 8, 2]', '[1e308, 2, 1e308, 2]'),
            'so large that a coordinate is not finite',
        ),
    ],
)
@pytest.mark.filterwarnings('error')
def test_numbers_that_overflow_are_reported(
    tmp_path: Path, format_name: str, text: str, message: str
) -> None:
    path = tmp_path / 'file'
    path.write_text(text)
    count, errors = _read(path, format_name)
    assert count == 0
    assert message in str(errors[0])
