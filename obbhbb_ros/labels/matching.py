# SPDX-License-Identifier: Apache-2.0
"""Oriented boxes and reference boxes of different files, brought together by their overlap."""

from __future__ import annotations

from collections.abc import Iterable
from collections.abc import Sequence
from dataclasses import dataclass
from dataclasses import replace

import numpy as np
import shapely
from numpy.typing import NDArray

from obbhbb_ros.labels.files import bare_name
from obbhbb_ros.labels.records import FloatArray
from obbhbb_ros.labels.records import ImageLabels

IndexArray = NDArray[np.intp]

MIN_IOU = 0.3


@dataclass(frozen=True, eq=False)
class Matching:
    """
    Oriented boxes with the reference boxes found for them.

    Attributes
    ----------
    images : tuple of ImageLabels
        The images of the oriented boxes with all their boxes, in their order; rows of `reference`
        are NaN where no reference box was found.
    matched : int
        Oriented boxes that have a reference box.
    unmatched_boxes : tuple of (str, int)
        Image and row of each oriented box that has none.
    unmatched_references : tuple of (str, FloatArray)
        Image and xyxy of each reference box that no oriented box has, pixels.
    """

    images: tuple[ImageLabels, ...]
    matched: int
    unmatched_boxes: tuple[tuple[str, int], ...]
    unmatched_references: tuple[tuple[str, FloatArray], ...]


def match_references(
    boxes: Iterable[ImageLabels], references: Iterable[ImageLabels], min_iou: float = MIN_IOU
) -> Matching:
    """
    Give oriented boxes the reference boxes of another source.

    Images are the same if their names are, folders and image suffix aside. Within an image the
    pair of highest IoU is matched first, then the next of what is left; at equal IoU the earlier
    oriented box goes first, and takes the earlier reference box. Classes are not compared, because
    sources name them differently.

    Parameters
    ----------
    boxes : iterable of ImageLabels
        The oriented boxes; a `reference` of their own is not looked at.
    references : iterable of ImageLabels
        The reference boxes, in `reference`; rows without are ignored.
    min_iou : float
        Least IoU of a reference box with the bounds of an oriented box, in (0, 1]. Bounds are
        free of any conversion rule, so that the choice favours none. A thin ship's reference box
        may be as little as half of them, so a stricter bound would drop the hard cases.

    Returns
    -------
    Matching
        Images with references, and what found no partner.

    Raises
    ------
    ValueError
        If `min_iou` is out of range, or two images of a source have the same bare name.
    """
    if not 0.0 < min_iou <= 1.0:
        raise ValueError(f'min_iou must be in (0, 1], not {min_iou}')
    images = list(boxes)
    groups = _rows_by_name(images)
    pools = {name: _pool(found) for name, found in _by_name(references).items()}
    matched = [np.full((len(image.class_ids), 4), np.nan) for image in images]
    for name, rows in groups.items():
        pool = pools.get(name)
        if pool is None:
            continue
        bounds = _bounds(np.concatenate([images[index].corners for index in rows]))
        own, other = match_boxes(bounds, pool, min_iou)
        found = np.full((len(bounds), 4), np.nan)
        found[own] = pool[other]
        cuts = np.cumsum([len(images[index].class_ids) for index in rows])[:-1]
        for index, part in zip(rows, np.split(found, cuts), strict=True):
            matched[index] = part
        pools[name] = np.delete(pool, other, axis=0)
    return _matching(images, matched, pools)


def _matching(
    images: Sequence[ImageLabels], matched: Sequence[FloatArray], left: dict[str, FloatArray]
) -> Matching:
    pairs = list(zip(images, matched, strict=True))
    bare = tuple(
        (image.image, int(row))
        for image, reference in pairs
        for row in np.flatnonzero(np.isnan(reference[:, 0]))
    )
    return Matching(
        images=tuple(replace(image, reference=reference) for image, reference in pairs),
        matched=sum(map(len, matched)) - len(bare),
        unmatched_boxes=bare,
        unmatched_references=tuple((name, row) for name, pool in left.items() for row in pool),
    )


def match_boxes(
    boxes: FloatArray, references: FloatArray, min_iou: float
) -> tuple[IndexArray, IndexArray]:
    """
    Match the boxes of one image, each with one reference at most, best IoU first.

    Parameters
    ----------
    boxes : ndarray, shape (N, 4)
        x_min, y_min, x_max, y_max, pixels; rows of NaN match nothing.
    references : ndarray, shape (M, 4)
        The same.
    min_iou : float
        Least IoU of a pair, above 0.

    Returns
    -------
    ndarray of int, ndarray of int
        Rows of `boxes` and of `references` that belong together, by falling IoU.
    """
    own, other = _overlapping(boxes, references)
    overlap = _iou(boxes[own], references[other])
    good = overlap >= min_iou
    own, other, overlap = own[good], other[good], overlap[good]
    best_first = np.lexsort((other, own, -overlap))
    taken_own, taken_other, chosen = set(), set(), []
    candidates = zip(own[best_first].tolist(), other[best_first].tolist(), strict=True)
    for pair in candidates:
        if pair[0] in taken_own or pair[1] in taken_other:
            continue
        taken_own.add(pair[0])
        taken_other.add(pair[1])
        chosen.append(pair)
    pairs = np.array(chosen, dtype=np.intp).reshape(-1, 2)
    return pairs[:, 0], pairs[:, 1]


def _overlapping(boxes: FloatArray, references: FloatArray) -> tuple[IndexArray, IndexArray]:
    """List the pairs whose bounds meet: few, where all pairs of a large scene would be millions."""
    finite = [np.flatnonzero(np.isfinite(each).all(axis=1)) for each in (boxes, references)]
    tree = shapely.STRtree(shapely.box(*references[finite[1]].T))
    own, other = tree.query(shapely.box(*boxes[finite[0]].T))
    return finite[0][own], finite[1][other]


def _iou(boxes: FloatArray, references: FloatArray) -> FloatArray:
    low = np.maximum(boxes[:, :2], references[:, :2])
    high = np.minimum(boxes[:, 2:], references[:, 2:])
    shared = np.prod(np.maximum(high - low, 0.0), axis=1)
    areas = [np.prod(each[:, 2:] - each[:, :2], axis=1) for each in (boxes, references)]
    union = areas[0] + areas[1] - shared
    # Two boxes without area share nothing.
    return np.asarray(np.divide(shared, union, out=np.zeros_like(shared), where=union > 0.0))


def _bounds(corners: FloatArray) -> FloatArray:
    return np.hstack((corners.min(axis=1), corners.max(axis=1)))


def _pool(images: Sequence[ImageLabels]) -> FloatArray:
    rows = np.concatenate([image.reference for image in images])
    return np.asarray(rows[np.isfinite(rows).all(axis=1)])


def _rows_by_name(images: Sequence[ImageLabels]) -> dict[str, list[int]]:
    places = {id(image): index for index, image in enumerate(images)}
    return {
        name: [places[id(image)] for image in group] for name, group in _by_name(images).items()
    }


def _by_name(images: Iterable[ImageLabels]) -> dict[str, list[ImageLabels]]:
    """Group images by bare name; several entries of one name are one image."""
    groups: dict[str, list[ImageLabels]] = {}
    for image in images:
        group = groups.setdefault(bare_name(image.image), [])
        if group and group[0].image != image.image:
            names = f'{group[0].image!r} and {image.image!r}'
            raise ValueError(f'{names} cannot be told apart by their bare names')
        group.append(image)
    return groups
