# SPDX-License-Identifier: Apache-2.0
"""The columns of a table of boxes: which of them hold the box, and what other tools call them."""

from __future__ import annotations

import re
from collections.abc import Sequence

CORNERS = ('x1', 'y1', 'x2', 'y2', 'x3', 'y3', 'x4', 'y4')
CORNER_LIST = ('xyxyxyxy',)
BOUNDS = ('x_min', 'y_min', 'x_max', 'y_max')
CENTRED = ('cx', 'cy', 'w', 'h')
IN_DEGREES = (*CENTRED, 'angle_deg')
IN_RADIANS = (*CENTRED, 'angle_rad')
REFERENCE = ('hx1', 'hy1', 'hx2', 'hy2')
NAMES = ('image', 'instance', 'class')
COLUMNS = (*NAMES, *CORNERS, *REFERENCE, 'mask', 'score')

# What other tools call a column, the first one that is there; in any case.
ALIASES = {
    'image': ('image_name', 'file_name', 'filename', 'image_path', 'image_id', 'frame'),
    'instance': ('tracker_id', 'track_id', 'id'),
    'class': ('class_name', 'class_id', 'category', 'label', 'name'),
    'score': ('confidence', 'conf'),
}
CENTRED_ALIASES = {
    'cx': ('x_center', 'center_x', 'xc'),
    'cy': ('y_center', 'center_y', 'yc'),
    'w': ('width',),
    'h': ('height',),
}
ANGLE = re.compile(r'(?:(?:angle|theta|rotation)_?)?(deg|rad)(?:rees?|ians?)?')
ANGLE_WITHOUT_UNIT = ('angle', 'theta', 'rotation')
# supervision writes the detections of one image or video without its name.
SINK_COLUMNS = {'class_id', 'confidence', 'tracker_id'}


def own_names(columns: Sequence[str]) -> list[str]:
    """Return the names of the columns, ours instead of those of other tools."""
    lower = [name.lower() for name in columns]
    own = {*COLUMNS, *BOUNDS, *CORNER_LIST, *IN_DEGREES, *IN_RADIANS}
    names = [low if low in own else name for name, low in zip(columns, lower, strict=True)]
    aliases = dict(ALIASES)
    if {*CORNERS, *BOUNDS, *CORNER_LIST}.isdisjoint(names):
        aliases |= CENTRED_ALIASES
        names = [_own_angle(name) for name in names]
    for name, others in aliases.items():
        other = next((other for other in others if other in lower), None)
        if name not in names and other is not None:
            names[lower.index(other)] = name
    return names


def _own_angle(name: str) -> str:
    unit = ANGLE.fullmatch(name.lower())
    return f'angle_{unit[1]}' if unit else name


def has_boxes(columns: Sequence[str]) -> bool:
    """Return whether a header has columns of boxes, perhaps not all of them."""
    names = set(own_names(columns))
    shapes = set(BOUNDS), set(CENTRED), set(CORNER_LIST)
    return not names.isdisjoint(CORNERS) or any(names.issuperset(shape) for shape in shapes)


def box_columns(columns: Sequence[str]) -> tuple[list[str], Sequence[str]]:
    """Return the names of the columns as `own_names`, and which of them hold the box."""
    names = own_names(columns)
    shape = _shape(names)
    reference = () if set(REFERENCE).isdisjoint(names) else REFERENCE
    is_sink = SINK_COLUMNS.issubset(name.lower() for name in columns)
    needed = (*(() if is_sink else ('image',)), 'class', *shape, *reference)
    missing = [name for name in needed if name not in names]
    if missing:
        raise ValueError(f'missing columns: {", ".join(missing)} (header: {",".join(columns)})')
    twice = [name for name in (*COLUMNS, *shape) if names.count(name) > 1]
    if twice:
        raise ValueError(f'columns named more than once: {", ".join(dict.fromkeys(twice))}')
    return names, shape


def _shape(names: Sequence[str]) -> Sequence[str]:
    if not set(CORNERS).isdisjoint(names):
        return CORNERS
    if CORNER_LIST[0] in names:
        return CORNER_LIST
    if not set(BOUNDS).isdisjoint(names):
        return BOUNDS
    if set(CENTRED).issubset(names):
        return _centred_shape(names)
    return CORNERS


def _centred_shape(names: Sequence[str]) -> Sequence[str]:
    angles = [shape for shape in (IN_DEGREES, IN_RADIANS) if shape[-1] in names]
    if len(angles) == 1:
        return angles[0]
    lower = {name.lower() for name in names}
    unclear = next((name for name in ANGLE_WITHOUT_UNIT if name in lower), None)
    if unclear:
        raise ValueError(
            f'column {unclear!r} does not say its unit: call it angle_deg or angle_rad (from x '
            'towards y, along w)'
        )
    raise ValueError('boxes of cx, cy, w, h need one column angle_deg or angle_rad')
