# SPDX-License-Identifier: Apache-2.0
"""A camera that flies over the image of labels: a window that moves down it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from obbhbb_ros.labels.image_labels import ImageLabels
from obbhbb_ros.labels.image_labels import ImageSize


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
        By how much it moves, pixels, no more than `height`. Where the last step would leave the
        image, it is a shorter one, to the end.

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
        If the size of the image is not known, or a step skips rows.
    """
    if step > height:
        raise ValueError(f'a step of {step} skips rows of the image: the window has {height}')
    width, whole = _size(labels)
    height = min(height, whole)
    middles = labels.boxes().center[:, 1]
    for top in _tops(whole - height, step):
        seen = labels.take(np.flatnonzero((middles >= top) & (middles < top + height)))
        yield top, _moved(seen, -float(top), (width, height))


def inside_image(labels: ImageLabels) -> ImageLabels:
    """
    Return the labels that a pass sees: those whose middles are inside the image.

    Raises ValueError if its size is not known.
    """
    middles = labels.boxes().center
    return labels.take(np.flatnonzero(((middles >= 0.0) & (middles < _size(labels))).all(axis=1)))


def _size(labels: ImageLabels) -> ImageSize:
    """Return the size of the image of labels; ValueError if it is not known."""
    if labels.size is None:
        raise ValueError(f'{labels.source}: image {labels.image!r}: no pass without its size')
    return labels.size


def _tops(last: int, step: int) -> Iterator[int]:
    """Yield the first rows of the windows, up to the last one."""
    yield from range(0, last, step)
    yield last


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
