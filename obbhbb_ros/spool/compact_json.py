# SPDX-License-Identifier: Apache-2.0
"""
The JSON of a chip in fewer bytes: short numbers, and its camera in a file of its own.

Many chips share one camera. The facts about the camera are a pair of files like a chip, with a name
made from its content. The chips name it, and keep only what differs from image to image.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from hashlib import sha256
from typing import Any
from typing import NamedTuple

from obbhbb_ros.spool.seals import digest_of
from obbhbb_ros.spool.seals import sealed

CAMERA_KIND = 'camera'
"""`kind` in the JSON of a camera, and the suffix of its file."""
_CAMERA_ID = re.compile(f'{CAMERA_KIND}_[0-9a-f]{{16}}')
# Of `camera` in the JSON of a chip: what belongs to the camera alone.
SHARED_KEYS = ('size', 'k', 'model', 'd')
# Decimals of the oriented box: 0.01 px, and as much at the ends of a ship of 2000 px.
_BOX_DECIMALS = (2, 2, 2, 2, 5)
# Of other numbers.
_SIGNIFICANT_DIGITS = 6
# What is not known before a chip is claimed, at its greatest length.
_LONGEST = {'rank': -1.23456e-300, 'view': 10_000_000}


class CameraFile(NamedTuple):
    """The file of a camera: its name without suffix, and its content, JSON."""

    id: str
    content: bytes

    def json_bytes(self) -> bytes:
        """Return the content of the JSON file beside it."""
        return compact_bytes(
            {
                'id': self.id,
                'kind': CAMERA_KIND,
                'bytes': len(self.content),
                'sha256': sha256(self.content).hexdigest(),
            }
        )


def camera_id(content: bytes) -> str:
    """Return the id of a camera, by the content of its file."""
    return f'{CAMERA_KIND}_{digest_of(content)}'


def names_camera(file_id: str) -> bool:
    """Return whether an id is that of a camera."""
    return _CAMERA_ID.fullmatch(file_id) is not None


def compact_bytes(description: Mapping[str, Any]) -> bytes:
    """Return a description as JSON without spaces; it ends with a digest of itself."""
    text = json.dumps(description, ensure_ascii=False, separators=(',', ':'))
    return sealed(text.encode(errors='replace'))


def shortened(description: Mapping[str, Any]) -> dict[str, Any]:
    """
    Round what a chip says: the oriented box to 0.01 px, score, value and rank to 6 digits.

    Examples
    --------
    >>> shortened({'score': 0.8999999761581421, 'obb': [10.1234, 20.0, 38.456, 12.0, 0.123456]})
    {'score': 0.9, 'obb': [10.12, 20.0, 38.46, 12.0, 0.12346]}
    """
    short = dict(description)
    for key in ('score', 'value', 'rank'):
        if short.get(key) is not None:
            short[key] = float(f'{short[key]:.{_SIGNIFICANT_DIGITS}g}')
    if short.get('obb') is not None:
        short['obb'] = list(map(round, short['obb'], _BOX_DECIMALS))
    return short


def without_camera(description: Mapping[str, Any]) -> tuple[dict[str, Any], CameraFile | None]:
    """
    Take out of a description what belongs to its camera alone; `with_camera` puts it back.

    Returns
    -------
    dict
        The description; its `camera` names the file.
    CameraFile or None
        The file, None if the camera is not known.
    """
    camera = description.get('camera')
    if camera is None:
        return dict(description), None
    shared = {key: camera[key] for key in SHARED_KEYS if key in camera}
    content = json.dumps(shared, ensure_ascii=False, separators=(',', ':')).encode(errors='replace')
    file = CameraFile(camera_id(content), content)
    own = {key: value for key, value in camera.items() if key not in SHARED_KEYS}
    return {**description, 'camera': {'id': file.id, **own}}, file


def compact_cost(description: Mapping[str, Any]) -> int:
    """
    Return the bytes that a chip costs with compact JSON, at most; those of its camera if more.

    The camera goes before the chip, so that what has room for the cost has room for both of them,
    one after the other.

    Parameters
    ----------
    description : mapping
        What `StoredChip.describe` returns; rank and view may not be known yet.
    """
    chip, camera = without_camera(shortened({**description, **_LONGEST}))
    cost = int(description['bytes']) + len(compact_bytes(chip))
    if camera is None:
        return cost
    return max(cost, len(camera.content) + len(camera.json_bytes()))


def with_camera(camera: Mapping[str, Any], shared: Mapping[str, Any]) -> dict[str, Any]:
    """
    Return a camera as in the full JSON of a chip.

    Parameters
    ----------
    camera : mapping
        `camera` of a compact JSON.
    shared : mapping
        Content of the file that it names.
    """
    return {**shared, **{key: value for key, value in camera.items() if key != 'id'}}
