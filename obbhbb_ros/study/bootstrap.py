# SPDX-License-Identifier: Apache-2.0
"""Bootstrap intervals of means and medians, by drawing whole images with replacement."""

from __future__ import annotations

from collections.abc import Iterator
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from obbhbb_ros.geometry.boxes import FloatArray

_TAIL = (1.0 - 0.95) / 2.0
# Number of draws at once, to limit the memory for many images.
_BATCH = 50


class Interval(NamedTuple):
    """A 95 % confidence interval."""

    low: float
    high: float


def bootstrap_intervals(
    values: Sequence[FloatArray], images: NDArray[np.intp], samples: int = 1000, seed: int = 0
) -> list[Interval]:
    """
    Compute 95 % intervals of means over the same ships, by drawing whole images with replacement.

    Ships in one image resemble each other; drawing single ships would make the intervals too
    narrow. The draws are the same for all means.

    Parameters
    ----------
    values : sequence of ndarray, each of shape (N,)
        One value per ship, for each mean.
    images : ndarray of int, shape (N,)
        Image of each ship.
    samples, seed : int
        Number of draws and their seed; without draws, or with one image, the intervals are NaN.
    """
    _, index = np.unique(images, return_inverse=True)
    counts = np.bincount(index).astype(float)
    sums = np.stack([np.bincount(index, weights=column) for column in values], axis=1)
    # The means are two products of matrices.
    means = [
        times @ sums / (times @ counts)[:, None] for times in draws(len(counts), samples, seed)
    ]
    return _intervals(means, len(values))


def median_intervals(
    values: Sequence[FloatArray], images: NDArray[np.intp], samples: int = 1000, seed: int = 0
) -> list[Interval]:
    """Compute 95 % intervals of medians, drawing whole images; see `bootstrap_intervals`."""
    _, index = np.unique(images, return_inverse=True)
    orders = [np.argsort(column, kind='stable') for column in values]
    medians = []
    for times in draws(int(index.max()) + 1, samples, seed):
        batch = []
        for column, order in zip(values, orders, strict=True):
            reached = np.cumsum(times[:, index[order]], axis=1)
            total = reached[:, -1:]
            # The middle value, or the mean of the two in the middle.
            lower = (2.0 * reached >= total).argmax(axis=1)
            upper = (2.0 * reached > total).argmax(axis=1)
            batch.append((column[order[lower]] + column[order[upper]]) / 2.0)
        medians.append(np.stack(batch, axis=1))
    return _intervals(medians, len(values))


def _intervals(samples: Sequence[FloatArray], count: int) -> list[Interval]:
    """Find the 95 % intervals of M = `count` statistics from batches of samples, (batch, M)."""
    if not samples:
        return [Interval(np.nan, np.nan)] * count
    ends = np.quantile(np.concatenate(samples), (_TAIL, 1.0 - _TAIL), axis=0)
    return [Interval(low, high) for low, high in ends.T.tolist()]


def draws(images: int, samples: int, seed: int) -> Iterator[FloatArray]:
    """
    Draw images with replacement: in batches, how often each image was drawn, (batch, images).

    There is no batch if there is one image.
    """
    random = np.random.default_rng(seed)
    # One image says nothing about others.
    for start in range(0, samples if images > 1 else 0, _BATCH):
        batch = min(_BATCH, samples - start)
        drawn = random.integers(images, size=(batch, images))
        offset = np.arange(batch)[:, None] * images
        times = np.bincount((drawn + offset).ravel(), minlength=drawn.size)
        yield times.reshape(drawn.shape).astype(float)
