# SPDX-License-Identifier: Apache-2.0
"""What the labels of images have that a format cannot hold."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection
from typing import Literal
from typing import TypeAlias
from typing import get_args

import numpy as np

from obbhbb_ros.labels.image_labels import ImageBoxes

Part: TypeAlias = Literal[
    'scores',
    'ids',
    'diagnostics',
    'crowd marks',
    'difficulties',
    'properties',
    'images without boxes',
    'image sizes',
    'image ids',
    'file names',
    'category ids',
    'reference system',
]
"""What a format may hold besides boxes and classes."""

PARTS: tuple[Part, ...] = get_args(Part)


class LossCount:
    """
    Counts what a format cannot hold.

    Parameters
    ----------
    holds : collection of Part
        What the format holds.
    reserved : collection of str
        Names of its own fields, in lower case, which no property can have.
    """

    def __init__(self, holds: Collection[Part], reserved: Collection[str] = ()) -> None:
        self._holds = holds
        self._reserved = reserved
        self._counts: Counter[Part] = Counter()
        self._properties: dict[str, None] = {}
        self._categories: dict[str, None] = {}
        self._systems: dict[str, None] = {}

    def add(self, image: ImageBoxes) -> None:
        """Count what the format loses of an image."""
        extras = image.extras
        names: Collection[str] = extras.properties
        if 'properties' in self._holds:
            names = [name for name in names if name.lower() in self._reserved]
        self._properties.update(dict.fromkeys(names))
        if 'category ids' not in self._holds:
            self._categories.update(dict.fromkeys(extras.label_set.categories))
        if extras.label_set.crs and 'reference system' not in self._holds:
            self._systems[extras.label_set.crs] = None
        for part, count in _counts(image).items():
            if part not in self._holds and count:
                self._counts[part] += count

    def __str__(self) -> str:
        """List the losses: ``12 scores, 2 properties (mmsi, time)``; '' if there are none."""
        texts = [f'{self._counts[part]} {part}' for part in PARTS if part in self._counts]
        if self._properties:
            texts.append(f'{len(self._properties)} properties ({_some(self._properties)})')
        if self._categories:
            texts.append(f'{len(self._categories)} category ids ({_some(self._categories)})')
        if self._systems:
            texts.append(f'reference system ({_some(self._systems)})')
        return ', '.join(texts)


def _counts(image: ImageBoxes) -> dict[Part, int]:
    extras = image.extras
    return {
        'scores': int(np.count_nonzero(image.scores != 1.0)),
        'ids': sum(map(bool, image.ids)),
        'crowd marks': 0 if extras.crowd is None else int(extras.crowd.sum()),
        'difficulties': 0
        if extras.difficulty is None
        else int(np.count_nonzero(extras.difficulty)),
        'images without boxes': int(not image.class_ids),
        'image sizes': int(image.size is not None),
        'image ids': int(extras.image_id is not None),
        'file names': int(bool(extras.file_name)),
    }


def _some(names: Collection[str]) -> str:
    shown = [name if len(name) <= 40 else f'{name[:39]}…' for name in names][:5]
    return ', '.join([*shown, '…'] if len(names) > len(shown) else shown)
