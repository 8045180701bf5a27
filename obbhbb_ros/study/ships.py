# SPDX-License-Identifier: Apache-2.0
"""The labels of many images as one set of arrays."""

from __future__ import annotations

import os
from collections.abc import Iterable
from collections.abc import Iterator
from collections.abc import Sequence
from dataclasses import dataclass
from dataclasses import replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from obbhbb_ros.geometry.boxes import FloatArray
from obbhbb_ros.geometry.boxes import OrientedBoxes
from obbhbb_ros.labels import ImageLabels
from obbhbb_ros.labels import OnError
from obbhbb_ros.labels import map_images
from obbhbb_ros.labels import maps
from obbhbb_ros.labels import read_labels
from obbhbb_ros.labels.image_labels import BOW_SOURCES
from obbhbb_ros.progress import track
from obbhbb_ros.study.bows import bow_sides
from obbhbb_ros.study.bows import with_bows
from obbhbb_ros.study.matching import match_references
from obbhbb_ros.study.metrics import outlines

# `hull`: the end of the hull with less area; the others as the labels say.
BOWS = (*BOW_SOURCES, 'hull')


@dataclass(frozen=True, eq=False)
class Ships:
    """
    The labels of N ships.

    Attributes
    ----------
    boxes : OrientedBoxes
        The oriented boxes, all of them valid.
    reference : ndarray, shape (N, 4)
        Axis-aligned boxes that a conversion should find, xyxy, pixels; NaN rows if unknown.
    class_ids : ndarray of str, shape (N,)
        Classes.
    image_of : ndarray of int, shape (N,)
        Index of each ship's image, counted from 0 without gaps.
    names : tuple of str
        Image and id of each ship.
    hulls : tuple of (ndarray or None)
        Hull polygons, each of shape (K, 2), pixels.
    skipped : int
        Number of boxes that were left out because they cannot be converted.
    crowds, difficult : int
        Number of boxes that were left out because they are groups of ships, or marked difficult.
    """

    boxes: OrientedBoxes
    reference: FloatArray
    class_ids: NDArray[np.str_]
    image_of: NDArray[np.intp]
    names: tuple[str, ...]
    hulls: tuple[FloatArray | None, ...]
    skipped: int = 0
    crowds: int = 0
    difficult: int = 0

    @classmethod
    def from_labels(cls, images: Iterable[ImageLabels], bow: str = 'none') -> Ships:
        """
        Join the labels of images; images with the same name become one.

        `bow` is how the bow is known: as in `ImageLabels.boxes`, or `hull`, see
        `obbhbb_ros.study.bows.bow_sides`.

        Boxes without area or with numbers that are not finite are left out, and so are crowds and
        difficult boxes. Ships in degrees are scaled to metres, each at its own latitude. Raises
        ValueError if no ship remains.
        """
        labels = [maps.on_ground(image) for image in images]
        image_of = [image.image for image in labels for _ in image.class_ids]
        if not image_of:
            raise ValueError('no ships in the labels')
        if bow not in BOWS:
            raise ValueError(f'bow must be one of {", ".join(BOWS)}, not {bow!r}')
        source: Any = 'none' if bow == 'hull' else bow
        boxes = OrientedBoxes.concatenate(image.boxes(source) for image in labels)
        ships = cls(
            boxes=boxes,
            reference=np.concatenate([image.reference for image in labels]),
            class_ids=np.array([name for image in labels for name in image.class_ids]),
            image_of=_numbered(image_of),
            names=tuple(
                f'{image.image} {name or row}'
                for image in labels
                for row, name in enumerate(image.ids)
            ),
            hulls=tuple(hull for image in labels for hull in image.hulls),
            skipped=int(np.sum(~boxes.valid)),
        )
        crowds = np.concatenate([_marked(image, image.extras.crowd) for image in labels])
        difficult = ~crowds & np.concatenate(
            [_marked(image, image.extras.difficulty) for image in labels]
        )
        ships = replace(ships, crowds=int(crowds.sum()), difficult=int(difficult.sum()))
        clear = boxes.valid & ~crowds & ~difficult
        if not clear.all():
            ships = ships.take(clear)
        return ships.heading_by_hull() if bow == 'hull' else ships

    def __len__(self) -> int:
        """Count the ships."""
        return len(self.boxes)

    def take(self, rows: Any) -> Ships:
        """
        Select ships by any NumPy index of N rows; their images are renumbered.

        Raises ValueError if none is selected.
        """
        chosen = np.arange(len(self))[rows]
        if not chosen.size:
            raise ValueError('no ships selected')
        return Ships(
            boxes=self.boxes[chosen],
            reference=self.reference[chosen],
            class_ids=self.class_ids[chosen],
            image_of=_numbered(self.image_of[chosen].tolist()),
            names=tuple(self.names[row] for row in chosen),
            hulls=tuple(self.hulls[row] for row in chosen),
            skipped=self.skipped,
            crowds=self.crowds,
            difficult=self.difficult,
        )

    @property
    def image_count(self) -> int:
        """Number of images."""
        return int(self.image_of.max()) + 1

    @property
    def with_reference(self) -> NDArray[np.bool_]:
        """Whether each ship has a reference box with an area, shape (N,)."""
        with np.errstate(invalid='ignore'):
            return np.asarray((self.reference[:, 2:] > self.reference[:, :2]).all(axis=1))

    def heading_by_hull(self) -> Ships:
        """Return the ships with their bows from their hulls, see `bow_sides`."""
        return replace(self, boxes=with_bows(self.boxes, bow_sides(self.boxes, self.hulls)))

    @cached_property
    def outlines(self) -> NDArray[np.object_]:
        """Hulls as geometries, shape (N,), see `obbhbb_ros.study.metrics.outlines`."""
        return outlines(self.hulls)

    @property
    def tilt(self) -> FloatArray:
        """
        Angle between the long axis and the nearest image axis, degrees in [0, 45], shape (N,).

        The paper's angle bands are bands of this angle.
        """
        degrees = np.degrees(self.boxes.theta)
        return np.abs(np.mod(degrees + 45.0, 90.0) - 45.0)

    @property
    def aspect(self) -> FloatArray:
        """Length over width, 1 or more, shape (N,)."""
        return self.boxes.length / self.boxes.width


def read_ships(
    paths: Sequence[str | os.PathLike[str]],
    format: str | None = None,  # noqa: A002
    *,
    reference: str | os.PathLike[str] | None = None,
    image_size: tuple[int, int] | None = None,
    bow: str = 'none',
    on_error: OnError | None = None,
) -> Ships:
    """
    Read the ships of label files.

    Parameters
    ----------
    paths : sequence of path-like
        Files or folders, as `obbhbb_ros.labels.read_labels` takes them.
    format : str, optional
        Format of `paths`; by default it is detected.
    reference : path-like, optional
        Labels with the reference boxes, matched by image and best overlap, see
        `obbhbb_ros.study.matching.match_references`. By default those in `paths`. Labels in
        different reference systems, or in a map and in pixels, meet in the pixels of the GeoTIFF
        beside them.
    image_size : tuple of int, optional
        Width and height of every image, pixels, for normalised formats.
    bow : str
        How the bow is known, one of `BOWS`; see `Ships.from_labels`.
    on_error : callable, optional
        Called with the error of each malformed record; by default the first one is raised.

    Raises
    ------
    ValueError
        If there are no ships, or a record is malformed and there is no `on_error`.
    """

    def read(path: str | os.PathLike[str], name: str | None = None) -> Iterator[ImageLabels]:
        labels = read_labels(path, name, image_size=image_size, on_error=on_error)
        return track(labels, f'reading {path}')

    images = tuple(labels for path in paths for labels in read(path, format))
    if reference is not None:
        pair = map_images.in_one_system(images, list(read(reference)))
        images = match_references(*pair)
    return Ships.from_labels(images, bow)


def _marked(image: ImageLabels, marks: NDArray[Any] | None) -> NDArray[np.bool_]:
    return np.zeros(len(image.class_ids), bool) if marks is None else marks.astype(bool)


def _numbered(names: Sequence[Any]) -> NDArray[np.intp]:
    """Give each name a number, from 0 in the order of first appearance."""
    number: dict[Any, int] = {}
    return np.array([number.setdefault(name, len(number)) for name in names], dtype=np.intp)
