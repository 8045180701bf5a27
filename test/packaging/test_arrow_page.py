# SPDX-License-Identifier: Apache-2.0
"""The programs on the page about Arrow do what it says."""

import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

pa = pytest.importorskip('pyarrow')
arrow = pytest.importorskip('obbhbb_ros.arrow')
parquet = pytest.importorskip('pyarrow.parquet')

PAGE = Path(__file__).parents[2] / 'doc' / 'arrow.md'
COUNT = 1000


def program(title: str) -> str:
    """Return the program in a section of the page."""
    pattern = rf'^## {title}\n.*?^```python\n(.*?)^```'
    return re.search(pattern, PAGE.read_text(encoding='utf-8'), re.M | re.S)[1]


@pytest.fixture
def ships(tmp_path: Path) -> pa.Table:
    corners = np.array([20, 30, 80, 30, 80, 50, 20, 50]) + np.arange(COUNT)[:, None] / 8
    columns = dict(zip(arrow.CORNERS, corners.T, strict=True))
    table = pa.table({'image': np.arange(COUNT), 'score': np.ones(COUNT), **columns})
    parquet.write_table(table, tmp_path / 'ships.parquet', row_group_size=COUNT // 4)
    return table


@pytest.mark.once
@pytest.mark.parametrize(
    ('title', 'module', 'result'),
    [('DuckDB', 'duckdb', 'boxes.parquet'), ('Dask', 'dask.distributed', 'boxes')],
)
def test_a_program_converts_all_rows(title, module, result, ships, tmp_path: Path) -> None:
    pytest.importorskip(module)
    # As a file, because the processes of a cluster import it.
    script = tmp_path / 'program.py'
    script.write_text(program(title), encoding='utf-8')
    subprocess.run(
        [sys.executable, '-W', 'error::DeprecationWarning:__main__', script],
        cwd=tmp_path,
        check=True,
        timeout=120,
    )
    boxes = parquet.read_table(tmp_path / result).sort_by('image')
    expected = arrow.convert_batch(ships)
    for name in ('image', *arrow.BOUNDS):
        assert boxes[name].to_pylist() == expected[name].to_pylist()
