# SPDX-License-Identifier: Apache-2.0
"""Tables of text cells: aligned for the terminal, and as Markdown."""

from __future__ import annotations

from collections.abc import Collection
from collections.abc import Sequence


def aligned(rows: Sequence[Sequence[str]], left: Collection[int] = (0,)) -> list[str]:
    """Align the columns of rows, those in `left` to the left and the others to the right."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return [
        '  '.join(
            cell.ljust(width) if i in left else cell.rjust(width)
            for i, (cell, width) in enumerate(zip(row, widths, strict=True))
        ).rstrip()
        for row in rows
    ]


def text_table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """
    Write a table with a line below its head: the first column to the left, the others to the right.

    Examples
    --------
    >>> print(text_table(('method', 'IoU'), [('outer', '0.81'), ('superellipse', '0.92')]))
    method         IoU
    ------------  ----
    outer         0.81
    superellipse  0.92
    """
    widths = [max(map(len, column)) for column in zip(head, *rows, strict=True)]
    return '\n'.join(aligned([head, ['-' * width for width in widths], *rows]))


def markdown_table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """
    Write a table as Markdown, each line with its newline.

    Examples
    --------
    >>> print(markdown_table(('q', 'shape'), [('2', 'ellipse')]), end='')
    | q | shape |
    | --- | --- |
    | 2 | ellipse |
    """
    lines = [head, ['---'] * len(head), *rows]
    return ''.join('| ' + ' | '.join(line) + ' |\n' for line in lines)
