# SPDX-License-Identifier: Apache-2.0
"""
Run-length encoded masks, and the hull around them; the mask itself is never unpacked.

Runs are the lengths of background and foreground in turn, the background first, down the columns
(COCO) or along the rows (CVAT). COCO's compressed text has five bits of a number in each character,
the lowest first, and from the fourth number on the difference from the last but one, as
``rleFrString`` of the COCO API reads it.
"""

from __future__ import annotations

from typing import Any
from typing import TypeGuard

import numpy as np
import shapely

from obbhbb_ros.geometry.boxes import FloatArray
from obbhbb_ros.labels.documents import json_member
from obbhbb_ros.labels.text import is_index

FIRST_CHARACTER = 48
MORE = 0x20
SIGN = 0x10
BITS = 5
MAX_SHIFT = 60
MAX_SIDE = 1 << 24
MAX_RUNS = 1 << 20
BOX_SIDES = 2


def coco_mask_ring(segmentation: dict[str, Any]) -> FloatArray:
    """Return the convex hull of a mask of COCO; raise ValueError if it has none."""
    size, counts = json_member(segmentation, 'size'), json_member(segmentation, 'counts')
    if not isinstance(size, list) or len(size) != BOX_SIDES:
        raise ValueError(f"'size' of the mask is {size!r}, not height and width")
    runs = _unpacked(counts) if isinstance(counts, str) else counts
    return mask_ring(runs, *size)


def mask_ring(runs: object, line: object, lines: object) -> FloatArray:
    """
    Return the convex hull of the pixels of a mask, shape (K, 2): line number, place in the line.

    Parameters
    ----------
    runs : list of int
        Lengths of background and foreground in turn.
    line, lines : int
        Pixels in a line (a column of COCO, a row of CVAT), and number of lines.

    Raises
    ------
    ValueError
        If the runs do not fill the mask exactly, or there is no foreground.
    """
    if not (_is_count(line) and _is_count(lines) and 0 < line <= MAX_SIDE >= lines > 0):
        raise ValueError(f'a mask cannot have {line!r} x {lines!r} pixels')
    if not isinstance(runs, list) or not all(map(_is_count, runs)):
        raise ValueError('the runs of the mask are not whole numbers')
    if len(runs) > MAX_RUNS:
        raise ValueError(f'the mask has {len(runs)} runs, more than {MAX_RUNS}')
    if min(runs, default=0) < 0 or sum(runs) != line * lines:
        raise ValueError(f'the runs of the mask do not fill {line} x {lines} pixels')
    ends = np.cumsum(runs)
    starts, ends = ends[:-1:2], ends[1::2]
    filled = ends > starts
    if not filled.any():
        raise ValueError('the mask is empty')
    return _hull(starts[filled], ends[filled] - 1, line)


def _is_count(value: object) -> TypeGuard[int]:
    return isinstance(value, int) and not isinstance(value, bool)


def _hull(first: Any, last: Any, line: int) -> FloatArray:
    """Return the hull of runs from the first to the last pixel, numbered along the lines."""
    (start, start_at), (end, end_at) = divmod(first, line), divmod(last, line)
    one, long = start == end, end - start > 1
    rectangles = np.concatenate(
        [
            # What a run has of its first line, of its last line and of those between.
            np.column_stack([start, start + 1, start_at, np.where(one, end_at + 1, line)]),
            np.column_stack([end, end + 1, np.where(one, start_at, 0), end_at + 1]),
            np.column_stack([start + 1, end, 0 * start, 0 * start + line])[long],
        ]
    )
    corners = rectangles[:, [[0, 2], [0, 3], [1, 3], [1, 2]]].reshape(-1, 2).astype(np.float64)
    return shapely.get_coordinates(shapely.convex_hull(shapely.multipoints(corners)))[:-1]


def _unpacked(text: str) -> list[int]:
    """Unpack the compressed runs; raise ValueError if the text is not one."""
    runs: list[int] = []
    value = shift = 0
    for character in text:
        bits = ord(character) - FIRST_CHARACTER
        if not 0 <= bits < 2 * MORE or shift > MAX_SHIFT:
            raise ValueError(f'the compressed mask has {character!r}, which does not belong there')
        value |= (bits % MORE) << shift
        shift += BITS
        if bits & MORE:
            continue
        if bits & SIGN:
            value -= 1 << shift
        runs.append(value + (runs[-2] if len(runs) > BOX_SIDES else 0))
        value = shift = 0
    if shift:
        raise ValueError('the compressed mask is cut off')
    return runs


def listed_runs(text: str) -> list[int]:
    """Return the runs that a text lists with commas between, as CVAT writes them."""
    fields = [field.strip() for field in text.split(',')]
    if not all(map(is_index, fields)):
        raise ValueError('the runs of the mask are not whole numbers')
    return [int(field) for field in fields]
