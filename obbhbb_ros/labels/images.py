# SPDX-License-Identifier: Apache-2.0
"""The images that labels belong to: where they are, and their pixels. Reading takes Pillow."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from obbhbb_ros.labels.files import IMAGE_SUFFIXES
from obbhbb_ros.labels.image_size import image_of
from obbhbb_ros.labels.image_size import opened_image
from obbhbb_ros.labels.records import ImageLabels

_EXACT_MODES = {'L': 'mono8', 'RGB': 'rgb8', 'RGBA': 'rgba8', 'I;16': 'mono16'}
# Pillow before 10.3 has these for grey images of 16 bits.
_WIDER_MODES = ('I', 'I;16B', 'I;16L')


def find_images(labels: Sequence[ImageLabels]) -> list[Path | None]:
    """
    Find the image file of each of some labels.

    Parameters
    ----------
    labels : sequence of ImageLabels
        Labels of N images.

    Returns
    -------
    list of (Path or None)
        N files: beside the label file, or in images/ where that has labels/, with the name of the
        image, or with the stem of a label file that holds this image only.
    """
    images_in = Counter(each.source for each in labels)
    found = []
    for each in labels:
        path = image_of(each.source, _stem(each.image)) if _stem(each.image) else None
        if path is None and images_in[each.source] == 1:
            path = image_of(each.source, each.source.stem)
        found.append(path)
    return found


def load_image(path: Path) -> tuple[str, NDArray[Any]]:
    """
    Read an image.

    Parameters
    ----------
    path : Path
        The file.

    Returns
    -------
    encoding : str
        As in `sensor_msgs/Image`: mono8, mono16, rgb8 or rgba8; what is stored in another way is
        turned into rgb8.
    pixels : ndarray of uint8 or uint16, shape (H, W) or (H, W, C)
        As the image is shown (EXIF orientation applied).

    Raises
    ------
    ModuleNotFoundError
        If Pillow is not installed.
    OSError, ValueError
        If the file cannot be read.
    """
    from PIL import ImageOps

    with opened_image(path) as stored:
        shown = ImageOps.exif_transpose(stored)
        if shown.mode in _WIDER_MODES and (pixels := _as_16_bits(np.asarray(shown))) is not None:
            return 'mono16', pixels
        if shown.mode not in _EXACT_MODES:
            shown = shown.convert('RGB')
        return _EXACT_MODES[shown.mode], np.asarray(shown)


def _as_16_bits(pixels: NDArray[Any]) -> NDArray[np.uint16] | None:
    """Give pixels as 16 bits, if they fit."""
    if pixels.size and (pixels.min() < 0 or pixels.max() > np.iinfo(np.uint16).max):
        return None
    return pixels.astype(np.uint16)


def _stem(image: str) -> str:
    """Take folder and image suffix off a name."""
    name = image.replace('\\', '/').rpartition('/')[2]
    stem, dot, suffix = name.rpartition('.')
    return stem if f'{dot}{suffix}'.lower() in IMAGE_SUFFIXES else name
