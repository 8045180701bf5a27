# SPDX-License-Identifier: Apache-2.0
"""`python -m obbhbb_ros.study [PICTURE]`: the paper's Table 1 and ours; the synthetic hulls."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

from obbhbb_ros.study.paper_table import PAPER_ROWS
from obbhbb_ros.study.paper_table import mean_deviation
from obbhbb_ros.study.paper_table import paper_comparison
from obbhbb_ros.study.tables import comparison_table


def main(arguments: Sequence[str]) -> None:
    """Print the comparison, and draw the hulls to the picture files."""
    comparisons = paper_comparison()
    print(comparison_table(comparisons))
    for row, rule in PAPER_ROWS.items():
        deviation = mean_deviation(comparisons, row)
        print(f'{row} ({rule.method}): mean absolute deviation {deviation:.4f}')
    for path in arguments:
        from obbhbb_ros.study import figures

        figures.save(figures.hull_panel(), Path(path))
        print(f'picture: {path}')


if __name__ == '__main__':
    main(sys.argv[1:])
