# SPDX-License-Identifier: Apache-2.0
"""Splits of ships by image: ships of one image resemble each other, and stay together."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from obbhbb_ros.study.ships import Ships


def folds_of(ships: Ships, folds: int, seed: int = 0) -> NDArray[np.intp]:
    """
    Find the fold of each of N ships, (N,), so that no image lies in two folds.

    Raises ValueError if there are fewer than two folds, or fewer images than folds.
    """
    images = ships.image_count
    if not 2 <= folds <= images:
        raise ValueError(
            f'{images} images cannot be split into {folds} folds: give 2 or more, at most one per '
            'image'
        )
    order = np.random.default_rng(seed).permutation(images)
    return np.asarray(order[ships.image_of] % folds)


def held_out_folds(
    ships: Ships, folds: int, seed: int = 0
) -> Iterator[tuple[Ships, NDArray[np.bool_]]]:
    """Yield the ships outside each fold, and a mask, (N,), of the ships in it."""
    fold = folds_of(ships, folds, seed)
    for index in range(folds):
        yield ships.take(fold != index), fold == index


def split(ships: Ships, seed: int = 0) -> tuple[Ships, Ships]:
    """Split the ships of two or more images into two halves by image, see `folds_of`."""
    fold = folds_of(ships, 2, seed)
    return ships.take(fold == 0), ships.take(fold == 1)
