# SPDX-License-Identifier: Apache-2.0
"""Match the oriented boxes of one source to the reference boxes of another, by overlap."""

from __future__ import annotations

from collections.abc import Iterable
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import shapely
from numpy.typing import NDArray

from obbhbb_ros.geometry.boxes import FloatArray
from obbhbb_ros.labels import ImageLabels
from obbhbb_ros.labels.image_names import bare_name
from obbhbb_ros.study.metrics import bounds
from obbhbb_ros.study.metrics import iou

MIN_IOU = 0.3


def match_references(
    boxes: Iterable[ImageLabels], references: Iterable[ImageLabels], min_iou: float = MIN_IOU
) -> tuple[ImageLabels, ...]:
    """
    Replace the reference boxes of oriented boxes by those of another source, matched by overlap.

    Images are the same if their names are, without folder and suffix. Within an image the pair
    with the highest IoU is matched first, then the next highest of those left; at equal IoU the
    earlier oriented box comes first, and gets the earlier reference box. Classes are not compared,
    because sources name them differently.

    Parameters
    ----------
    boxes : iterable of ImageLabels
        The oriented boxes; their `reference` is ignored.
    references : iterable of ImageLabels
        The reference boxes, in `reference`; NaN rows are ignored.
    min_iou : float
        Lowest IoU of a reference box with the bounds of an oriented box, in (0, 1]. Bounds do not
        depend on a conversion rule, so the choice favours none. The reference box of a thin ship
        may be half as large as its bounds, so a higher limit would drop the difficult cases.

    Returns
    -------
    tuple of ImageLabels
        The oriented boxes, in their order; the rows of `reference` are NaN without a match.

    Raises
    ------
    ValueError
        If `min_iou` is out of range, or two images of a source have the same bare name.
    """
    if not 0.0 < min_iou <= 1.0:
        raise ValueError(f'min_iou must be in (0, 1], not {min_iou}')
    images, others = list(boxes), list(references)
    pools = {
        name: np.concatenate([others[index].reference for index in rows])
        for name, rows in _rows_by_name(others).items()
    }
    matched = [np.full((len(image.class_ids), 4), np.nan) for image in images]
    for name, rows in _rows_by_name(images).items():
        if name not in pools:
            continue
        corners = np.concatenate([images[index].corners for index in rows])
        reference = np.full((len(corners), 4), np.nan)
        box_rows, pool_rows = match_boxes(bounds(corners), pools[name], min_iou)
        reference[box_rows] = pools[name][pool_rows]
        ends = np.cumsum([len(matched[index]) for index in rows])[:-1]
        for index, part in zip(rows, np.split(reference, ends), strict=True):
            matched[index] = part
    pairs = zip(images, matched, strict=True)
    return tuple(replace(image, reference=reference) for image, reference in pairs)


def match_boxes(
    boxes: FloatArray, references: FloatArray, min_iou: float
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """
    Match each box of an image, (N, 4), to at most one reference, (M, 4); best IoU first.

    Returns the rows of `boxes` and of `references` of each pair, the best pair first; NaN rows
    match nothing.
    """
    rows, others = (np.flatnonzero(np.isfinite(xyxy).all(axis=1)) for xyxy in (boxes, references))
    # Only the pairs that touch: all pairs of a large scene would be millions.
    tree = shapely.STRtree(shapely.box(*references[others].T))
    near_rows, near_others = tree.query(shapely.box(*boxes[rows].T))
    rows, others = rows[near_rows], others[near_others]
    # Two boxes without area have no IoU, and do not match.
    with np.errstate(invalid='ignore'):
        overlap = iou(boxes[rows], references[others])
    candidates = np.flatnonzero(overlap >= min_iou)
    ranking = (others[candidates], rows[candidates], -overlap[candidates])
    best_first = candidates[np.lexsort(ranking)]
    free_boxes, free_references = np.ones(len(boxes), bool), np.ones(len(references), bool)
    pairs: list[int] = []
    for pair in best_first.tolist():
        if free_boxes[rows[pair]] and free_references[others[pair]]:
            free_boxes[rows[pair]] = free_references[others[pair]] = False
            pairs.append(pair)
    chosen = np.array(pairs, dtype=np.intp)
    return rows[chosen], others[chosen]


def _rows_by_name(images: Sequence[ImageLabels]) -> dict[str, list[int]]:
    """Group the indices of images by bare name; several entries of one name are one image."""
    groups: dict[str, list[int]] = {}
    for index, image in enumerate(images):
        group = groups.setdefault(bare_name(image.image), [])
        if group and images[group[0]].image != image.image:
            names = f'{images[group[0]].image!r} and {image.image!r}'
            raise ValueError(f'{names} have the same name without folder and suffix')
        group.append(index)
    return groups
