# SPDX-License-Identifier: Apache-2.0
"""The size of the image that a label file belongs to, for formats that do not tell it."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from obbhbb_ros.labels.files import IMAGE_SUFFIXES
from obbhbb_ros.labels.records import LabelError

ADVICE = 'pass image_size=(width, height)'
# 32768 x 32768; three bytes each are 3 GB.
MOST_PIXELS = 2**30
EXIF_ORIENTATION = 0x0112
EXIF_TURNED = (5, 6, 7, 8)


def stored_size(labels: Path) -> tuple[int, int]:
    """
    Read width and height of the image that belongs to a label file.

    The image has the same stem and lies beside the label file, or where Ultralytics keeps it:
    in the folder that has ``images`` for the last ``labels`` in the path.

    Parameters
    ----------
    labels : Path
        The label file.

    Returns
    -------
    tuple of int
        Width and height in pixels, as the image is shown (EXIF orientation of JPEG applied).

    Raises
    ------
    LabelError
        If there is no such image, it cannot be read, or Pillow is not installed.
    """
    image = image_of(labels, labels.stem)
    if image is None:
        raise LabelError(labels, None, f'no image beside it or in images/ to size it: {ADVICE}')
    try:
        return _shown_size(image)
    except ImportError:
        message = f'the size of {image} takes Pillow, which is not installed: {ADVICE}'
        raise LabelError(labels, None, message) from None
    except Exception as error:
        # As wide as that because Pillow's readers raise whatever a damaged file leads them to.
        raise LabelError(labels, None, f'cannot read {image} ({error}): {ADVICE}') from error


def image_of(labels: Path, stem: str) -> Path | None:
    """
    Find the image of a name that belongs to a label file.

    Parameters
    ----------
    labels : Path
        The label file.
    stem : str
        Name of the image without folder and suffix.

    Returns
    -------
    Path or None
        The image beside the label file or, as `stored_size` looks for it, in images/.
    """
    for folder in _image_folders(labels.absolute().parent):
        for suffix in IMAGE_SUFFIXES:
            for name in (f'{stem}{suffix}', f'{stem}{suffix.upper()}'):
                if (folder / name).is_file():
                    return folder / name
    return None


def _image_folders(folder: Path) -> Iterator[Path]:
    yield folder
    parts = folder.parts
    if 'labels' in parts:
        last = len(parts) - 1 - parts[::-1].index('labels')
        yield Path(*parts[:last], 'images', *parts[last + 1 :])


@contextmanager
def opened_image(path: Path) -> Iterator[Any]:
    """
    Open an image that may be as large as a satellite scene.

    Yields
    ------
    PIL.Image.Image
        The image, not decoded yet.

    Raises
    ------
    ModuleNotFoundError
        If Pillow is not installed.
    OSError, ValueError
        If it cannot be read, or has more than `MOST_PIXELS` pixels.
    """
    from PIL import Image

    # Pillow refuses what has twice as many pixels as this, and warns before.
    limit, Image.MAX_IMAGE_PIXELS = Image.MAX_IMAGE_PIXELS, MOST_PIXELS // 2
    try:
        with warnings.catch_warnings():
            warnings.simplefilter('ignore', Image.DecompressionBombWarning)
            image = Image.open(path)
    except Image.DecompressionBombError as error:
        raise ValueError(f'{path}: {error}') from None
    finally:
        Image.MAX_IMAGE_PIXELS = limit
    with image:
        yield image


def _shown_size(path: Path) -> tuple[int, int]:
    with opened_image(path) as image:
        width, height = image.size
        # Only for JPEG: of other formats Pillow may decode the whole image to find it.
        turned = image.format == 'JPEG' and image.getexif().get(EXIF_ORIENTATION) in EXIF_TURNED
    return (height, width) if turned else (width, height)
