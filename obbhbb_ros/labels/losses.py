# SPDX-License-Identifier: Apache-2.0
"""What the labels of images have that a format cannot hold."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection
from typing import Literal
from typing import TypeAlias
from typing import get_args

import numpy as np

from obbhbb_ros.labels.extras import Id
from obbhbb_ros.labels.image_labels import DIAGNOSTICS
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
    'image suffixes',
    'category ids',
    'reference system',
]
"""What a format may hold besides boxes and classes."""

PARTS: tuple[Part, ...] = get_args(Part)
SINGULARS: dict[str, str] = {
    'difficulties': 'difficulty',
    'properties': 'property',
    'image suffixes': 'image suffix',
    'images without boxes': 'image without boxes',
}


class LossCount:
    """
    Counts what a format cannot hold.

    Parameters
    ----------
    holds : collection of Part
        What the format holds.
    reserved : collection of str
        Names of its own fields, in lower case, which no property can have.
    longest_name : int or None
        How many bytes of the name of a property it holds; None for all.
    """

    def __init__(
        self,
        holds: Collection[Part],
        reserved: Collection[str] = (),
        longest_name: int | None = None,
    ) -> None:
        self._holds = holds
        self._longest_name = longest_name
        self._long_names: dict[str, None] = {}
        self._others: dict[str, None] = {}
        self._reserved = reserved
        self._counts: Counter[Part] = Counter()
        self._properties: dict[str, None] = {}
        self._image_ids: set[Id | None] = set()
        self._images = 0
        self._categories: dict[tuple[str, Id], None] = {}
        self._systems: dict[str, None] = {}

    def add(self, image: ImageBoxes) -> None:
        """Count what the format loses of an image."""
        extras = image.extras
        lost = self._lost_properties(image)
        self._properties.update(dict.fromkeys(lost))
        self._long_names.update(dict.fromkeys(self._shortened(image, lost)))
        self._others.update(dict.fromkeys(extras.label_set.others))
        self._image_ids.add(extras.image_id)
        self._images += 1
        self._categories.update(dict.fromkeys(extras.label_set.categories.items()))
        if extras.label_set.crs:
            self._systems[extras.label_set.crs] = None
        self._counts.update(_counts(image))

    def _lost_properties(self, image: ImageBoxes) -> Collection[str]:
        names = image.extras.properties
        if 'properties' not in self._holds:
            return names
        taken = {*self._reserved, *(DIAGNOSTICS if image.diagnostics is not None else ())}
        return [name for name in names if name.lower() in taken]

    def _shortened(self, image: ImageBoxes, lost: Collection[str]) -> list[str]:
        if self._longest_name is None:
            return []
        names = (name for name in image.extras.properties if name not in lost)
        return [name for name in names if len(name.encode()) > self._longest_name]

    def __str__(self) -> str:
        """List the losses: ``12 scores, 2 properties (mmsi, time)``; '' if there are none."""
        texts = [_counted(self._counts[part], part) for part in PARTS if self._loses(part)]
        if self._properties:
            number = _counted(len(self._properties), 'properties')
            texts.append(f'{number} ({_some(self._properties)})')
        if self._long_names:
            number = _counted(len(self._long_names), 'long names')
            texts.append(f'{number} ({_some(self._long_names)})')
        if self._others:
            number = _counted(len(self._others), 'other members')
            texts.append(f'{number} ({_some(self._others)})')
        if self._loses_categories():
            names = dict.fromkeys(name for name, _ in self._categories)
            texts.append(f'{_counted(len(names), "category ids")} ({_some(names)})')
        if self._systems and 'reference system' not in self._holds:
            texts.append(f'reference system ({_some(self._systems)})')
        return ', '.join(texts)

    def _loses(self, part: Part) -> bool:
        """Whether a part that is counted by image or box is lost."""
        # Ids of images that repeat, as those of several files do, are replaced by new ones.
        repeats = part == 'image ids' and len(self._image_ids) < self._images
        return self._counts[part] > 0 and (part not in self._holds or repeats)

    def _loses_categories(self) -> bool:
        names = {name for name, _ in self._categories}
        ids = {key for _, key in self._categories}
        contradict = not len(names) == len(ids) == len(self._categories)
        return bool(self._categories) and ('category ids' not in self._holds or contradict)


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
        # That of labels in a map is from the image.
        'image sizes': int(image.size is not None and not extras.label_set.placed),
        'image ids': int(extras.image_id is not None),
        'file names': int(extras.file_name not in ('', image.file_name)),
        'image suffixes': int(image.file_name != image.image),
    }


def _counted(number: int, part: str) -> str:
    singular = SINGULARS.get(part, part.removesuffix('s'))
    return f'{number} {singular if number == 1 else part}'


def _some(names: Collection[str]) -> str:
    shown = [name if len(name) <= 40 else f'{name[:39]}…' for name in names][:5]
    return ', '.join([*shown, '…'] if len(names) > len(shown) else shown)
