# SPDX-License-Identifier: Apache-2.0
"""Boxes that end at the border of their image: Ultralytics drops images with others."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from obbhbb_ros.labels.image_labels import ImageBoxes
from obbhbb_ros.labels.text import is_normalised


class ClippedImage(NamedTuple):
    """
    An image whose boxes are within it.

    Attributes
    ----------
    boxes : ImageBoxes
        The boxes that are at least in part in the image, without diagnostics.
    outside : list of int
        The rows that are not.
    cut : int
        Boxes that were larger.
    """

    boxes: ImageBoxes
    outside: list[int]
    cut: int


def clip_to_image(image: ImageBoxes) -> ClippedImage:
    """
    Cut boxes at the border of their image if its size is known.

    Raises ValueError if one lies so far outside that the size must be that of another image.
    """
    if image.size is None:
        return ClippedImage(image, [], 0)
    far = np.tile(np.array(image.size, np.float64), 2)
    if not is_normalised((image.xyxy / far).flat):
        raise ValueError(f'image {image.image!r}: a box lies far outside its size {image.size}')
    clipped = np.clip(image.xyxy, 0.0, far)
    within = np.all(clipped[:, :2] < clipped[:, 2:], axis=1)
    rows = np.flatnonzero(within)
    boxes = replace(
        image,
        xyxy=clipped[rows],
        class_ids=tuple(image.class_ids[row] for row in rows),
        ids=tuple(image.ids[row] for row in rows),
        scores=image.scores[rows],
        diagnostics=None,
        extras=image.extras.take(rows),
    )
    cut = int(np.count_nonzero(np.any(clipped != image.xyxy, axis=1) & within))
    return ClippedImage(boxes, np.flatnonzero(~within).tolist(), cut)
