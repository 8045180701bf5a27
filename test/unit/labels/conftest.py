# SPDX-License-Identifier: Apache-2.0
"""Label files and labels for the tests of `obbhbb_ros.labels`."""

from __future__ import annotations

from collections.abc import Callable
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from obbhbb_ros.labels import ImageLabels
from obbhbb_ros.labels.label_file import Box
from obbhbb_ros.labels.label_file import LabelFile

SHIP = Box((10.0, 20.0, 50.0, 20.0, 50.0, 30.0, 10.0, 30.0), 'ship')

Put = Callable[[str, 'str | bytes'], Path]
Make = Callable[..., ImageLabels]
Same = Callable[[Sequence[ImageLabels], Sequence[ImageLabels]], None]


@pytest.fixture
def put(tmp_path: Path) -> Put:
    """Write a file below the temporary folder; text is UTF-8, its line ends unchanged."""

    def _put(name: str, content: str | bytes) -> Path:
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content.encode() if isinstance(content, str) else content)
        return path

    return _put


@pytest.fixture(scope='session')
def make() -> Make:
    """Build the labels of an image."""

    def _make(
        image: str = 'P0706',
        *boxes: Box,
        size: tuple[int, int] | None = None,
    ) -> ImageLabels:
        return LabelFile(Path('made.by'), size).image(image, boxes or (SHIP,))

    return _make


@pytest.fixture(scope='session')
def assert_same() -> Same:
    """Compare all fields of images but their source."""

    def _assert_same(got: Sequence[ImageLabels], expected: Sequence[ImageLabels]) -> None:
        assert [image.image for image in got] == [image.image for image in expected]
        for one, other in zip(got, expected, strict=True):
            assert one.class_ids == other.class_ids
            assert one.ids == other.ids
            assert one.size == other.size
            np.testing.assert_array_equal(one.corners, other.corners)
            np.testing.assert_array_equal(one.scores, other.scores)
            np.testing.assert_array_equal(one.reference, other.reference)
            for hull, expected_hull in zip(one.hulls, other.hulls, strict=True):
                assert (hull is None) == (expected_hull is None)
                if hull is not None:
                    np.testing.assert_array_equal(hull, expected_hull)

    return _assert_same
