# SPDX-License-Identifier: Apache-2.0
"""Lines that are read by columns are the boxes that they are beside a line that cannot be read."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest
from hypothesis import HealthCheck
from hypothesis import given
from hypothesis import settings
from hypothesis import strategies as st

from obbhbb_ros.labels import LabelError
from obbhbb_ros.labels import read_labels

if TYPE_CHECKING:
    from pathlib import Path

    from conftest import Same

SIZE = (640, 480)
FORMATS = ('dota', 'dota with header', 'yolo', 'yolo_obb', 'yolo scores', 'yolo_obb tracks')
fractions = st.integers(0, 400).map(lambda number: number / 1000)
sizes = st.integers(1, 400).map(lambda number: number / 1000)


@st.composite
def lines_of(draw: st.DrawFn, kind: str) -> list[str]:
    """Make lines of a format, with what may follow the box."""
    lines = []
    for number in range(draw(st.integers(1, 6))):
        x, y, width, height = draw(fractions), draw(fractions), draw(sizes), draw(sizes)
        right, low = x + width, y + height
        corners = (x, y, right, y, right, low, x, low)
        if kind.startswith('dota'):
            pixels = ' '.join(repr(2 + 640 * value) for value in corners)
            lines.append(f'{pixels} {draw(st.sampled_from(["ship", "tug 0", "tug 2"]))}')
            continue
        values = corners if kind.startswith('yolo_obb') else (x, y, width, height)
        line = f'{draw(st.integers(0, 3))} {" ".join(map(repr, values))}'
        if 'scores' in kind or 'tracks' in kind:
            line += f' {draw(fractions) + 0.0001}'
        lines.append(f'{line} {number + 2}' if 'tracks' in kind else line)
    return ['imagesource:x', 'gsd:0.1', *lines] if kind == 'dota with header' else lines


@pytest.mark.parametrize('kind', FORMATS)
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None)
@given(data=st.data())
def test_a_malformed_line_changes_no_other(
    tmp_path: Path, assert_same: Same, kind: str, data: st.DataObject
) -> None:
    lines = data.draw(lines_of(kind))
    format_name = kind.partition(' ')[0]
    path = tmp_path / 'a.txt'
    path.write_text('\n'.join(lines))
    plain = list(read_labels(path, format_name, image_size=SIZE))
    place = data.draw(st.integers(0, len(lines)))
    path.write_text('\n'.join([*lines[:place], 'x 1 2', *lines[place:]]))
    errors: list[LabelError] = []
    beside = list(read_labels(path, format_name, image_size=SIZE, on_error=errors.append))
    assert_same(beside, plain)
    assert beside[0].difficulties == plain[0].difficulties
    assert [error.line for error in errors] == [place + 1]
