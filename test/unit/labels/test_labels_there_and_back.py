# SPDX-License-Identifier: Apache-2.0
"""Boxes from every format to every other: what is equal, and what the summary says was lost."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import Phase
from hypothesis import given
from hypothesis import settings
from hypothesis import strategies as st

from obbhbb_ros.geometry.converter import HullRule
from obbhbb_ros.labels import FORMATS
from obbhbb_ros.labels import ImageBoxes
from obbhbb_ros.labels import ImageLabels
from obbhbb_ros.labels import read_labels
from obbhbb_ros.labels import write_boxes
from obbhbb_ros.labels.axis_aligned import convert_file
from obbhbb_ros.labels.extras import Extras
from obbhbb_ros.labels.extras import LabelSet

EXTRAS = {
    **dict.fromkeys(('shapefile', 'geopackage', 'flatgeobuf'), 'geopandas'),
    'parquet': 'pyarrow',
}
WRITTEN = [name for name, form in FORMATS.items() if form.write_boxes is not None]
SUFFIXES = {'yolo': '', 'voc': ''}
SIZE = (640, 480)

FLEETS = st.lists(
    st.builds(
        dict,
        x=st.floats(50.0, 300.0),
        y=st.floats(50.0, 300.0),
        score=st.sampled_from([1.0, 0.5]),
        crowd=st.booleans(),
        difficulty=st.integers(0, 2),
        mmsi=st.sampled_from(['', '219000001']),
    ),
    min_size=1,
    max_size=3,
)


def _path(folder: Path, name: str, format_name: str) -> Path:
    return folder / f'{name}{SUFFIXES.get(format_name, FORMATS[format_name].suffixes[0])}'


def _image(fleet: list[dict[str, Any]]) -> ImageBoxes:
    low = np.array([[ship['x'], ship['y']] for ship in fleet])
    crowd = np.array([ship['crowd'] for ship in fleet])
    difficulty = np.array([ship['difficulty'] for ship in fleet])
    mmsi = tuple(ship['mmsi'] or None for ship in fleet)
    return ImageBoxes(
        'P1',
        np.hstack((low, low + (60.0, 20.0))),
        class_ids=('ship',) * len(fleet),
        ids=tuple(str(7 + row) for row in range(len(fleet))),
        scores=np.array([ship['score'] for ship in fleet]),
        size=SIZE,
        source=Path('made.by'),
        extras=Extras(
            crowd=crowd if crowd.any() else None,
            difficulty=difficulty if difficulty.any() else None,
            properties={'mmsi': mmsi} if any(mmsi) else {},
            image_id=42,
            label_set=LabelSet({'ship': 3, 'tug': 8}),
        ),
    )


def _only(path: Path, format_name: str) -> ImageLabels:
    (labels,) = read_labels(path, format_name, image_size=SIZE)
    return labels


def _properties(labels: ImageLabels) -> dict[str, Any]:
    """Return the properties that are not empty, as text."""
    columns = labels.extras.properties.items()
    return {name: list(map(str, values)) for name, values in columns if any(values)}


@pytest.mark.parametrize('target', WRITTEN)
@pytest.mark.parametrize('source', WRITTEN)
@given(fleet=FLEETS)
@settings(max_examples=3, deadline=None, phases=[Phase.explicit, Phase.generate])
def test_what_comes_back_is_equal_or_counted_as_lost(
    tmp_path_factory: pytest.TempPathFactory, source: str, target: str, fleet: list[dict[str, Any]]
) -> None:
    for name in {source, target} & set(EXTRAS):
        pytest.importorskip(EXTRAS[name])
    folder = tmp_path_factory.mktemp('there')
    there, back = _path(folder, 'there', source), _path(folder, 'back', target)
    write_boxes(there, [_image(fleet)], source)
    before = _only(there, source)
    tally = convert_file(
        there, back, HullRule('outer'), source_format=source, target_format=target,
        image_size=SIZE, report=print,
    )  # fmt: skip
    after = _only(back, target)
    np.testing.assert_allclose(after.reference, before.reference, atol=1e-9)
    assert after.class_ids == before.class_ids
    lost = tally.losses
    assert ('score' in lost) or after.scores.tolist() == before.scores.tolist()
    assert (' id' in lost) or not any(before.ids) or after.ids == before.ids
    assert ('difficult' in lost) or after.difficulties == before.difficulties
    assert ('crowd' in lost) or _crowds(after) == _crowds(before)
    assert ('propert' in lost) or _properties(after) == _properties(before)
    image_id = before.extras.image_id
    assert ('image id' in lost) or image_id is None or after.extras.image_id == image_id
    categories = after.extras.label_set.categories, before.extras.label_set.categories
    assert ('category id' in lost) or not categories[1] or categories[0] == categories[1]


def _crowds(labels: ImageLabels) -> list[bool]:
    crowd = labels.extras.crowd
    return [False] * len(labels.class_ids) if crowd is None else crowd.tolist()
