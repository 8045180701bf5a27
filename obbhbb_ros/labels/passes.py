# SPDX-License-Identifier: Apache-2.0
"""A camera that flies over the image of labels: a window that moves down it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from obbhbb_ros.labels.image_labels import ImageLabels


def pass_over(labels: ImageLabels, height: int, step: int) -> Iterator[tuple[int, ImageLabels]]:
    """
    Yield what a window sees as it moves down an image.

    Parameters
    ----------
    labels : ImageLabels
        The labels of the image, whose size is known.
    height : int
        Height of the window, pixels; it is as wide as the image.
    step : int
        By how much it moves, pixels. It stops where it would leave the image.

    Yields
    ------
    int
        The row of the image at which the window begins.
    ImageLabels
        The labels whose middles are inside, in pixels of the window, without ids: a detector does
        not know what it has seen before.

    Raises
    ------
    ValueError
        If the size of the image is not known.
    """
    if labels.size is None:
        raise ValueError(f'{labels.source}: image {labels.image!r}: no pass without its size')
    width, whole = labels.size
    height = min(height, whole)
    middles = labels.boxes().center[:, 1]
    for top in range(0, whole - height + 1, step):
        seen = labels.take(np.flatnonzero((middles >= top) & (middles < top + height)))
        yield top, _moved(seen, -float(top), (width, height))


def _moved(labels: ImageLabels, down: float, size: tuple[int, int]) -> ImageLabels:
    """Move labels down an image of another size."""
    shift = np.array((0.0, down))
    return replace(
        labels,
        corners=labels.corners + shift,
        reference=labels.reference + np.tile(shift, 2),
        hulls=tuple(None if hull is None else hull + shift for hull in labels.hulls),
        ids=('',) * len(labels.class_ids),
        size=size,
    )
