# SPDX-License-Identifier: Apache-2.0
"""The image files that labels belong to: path, size and pixels. Reading them needs Pillow."""

from __future__ import annotations

import os
import warnings
from collections import Counter
from collections.abc import Iterator
from collections.abc import Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from obbhbb_ros.labels.image_labels import ImageLabels
from obbhbb_ros.labels.image_labels import ImageSize
from obbhbb_ros.labels.image_names import IMAGE_SUFFIXES
from obbhbb_ros.labels.image_names import bare_name
from obbhbb_ros.labels.label_file import LabelError

# 32768 x 32768: 3 GB at three bytes per pixel.
MAX_PIXELS = 2**30
# Those of `IMAGE_SUFFIXES`: other readers of Pillow run other programs.
IMAGE_FORMATS = ('PNG', 'JPEG', 'TIFF', 'BMP', 'WEBP', 'JPEG2000')
EXIF_ORIENTATION = 0x0112
EXIF_TURNED = (5, 6, 7, 8)
_EXACT_MODES = {'L': 'mono8', 'RGB': 'rgb8', 'RGBA': 'rgba8', 'I;16': 'mono16'}
# Modes of grey images of more than 8 bits; those of 16 bits are I in Pillow before 10.3.
_WIDER_MODES = ('I', 'I;16B', 'I;16L', 'F')
# Percent of the pixels of wider images that become black, and white.
_CLIPPED = 0.5
# Maximum number of rows, and of columns, of the sample that gives these pixels.
_MAX_SAMPLES = 1024


def find_images(labels: Sequence[ImageLabels]) -> list[Path | None]:
    """
    Find the image files that labels belong to; None for those without one.

    An image is beside the label file, or in images/ if that is in labels/. It has the name of the
    image, or the stem of a label file that holds only this image.
    """
    images_in = Counter(image.source for image in labels)
    return [_find_image(image, images_in[image.source] == 1) for image in labels]


def _find_image(labels: ImageLabels, only_one: bool) -> Path | None:
    path = image_beside(labels.source, labels.image)
    return image_beside(labels.source, labels.source.stem) if path is None and only_one else path


def image_beside(labels: Path, image: str) -> Path | None:
    """
    Return the file of an image that a label file has labels of; None if there is none.

    It has the bare name of `image` and is beside the label file, or where Ultralytics keeps it: in
    the folder that has ``images`` instead of the last ``labels`` in the path.
    """
    stem = bare_name(image)
    if not stem:
        return None
    names = [f'{stem}{end}' for suffix in IMAGE_SUFFIXES for end in (suffix, suffix.upper())]
    folders = _image_folders(labels.absolute().parent)
    paths = (folder / name for folder in folders for name in names)
    # Unlike Path.is_file, this answers for names that no file can have.
    return next(filter(os.path.isfile, paths), None)


def _image_folders(folder: Path) -> Iterator[Path]:
    yield folder
    parts = folder.parts
    if 'labels' in parts:
        last = len(parts) - 1 - parts[::-1].index('labels')
        yield Path(*parts[:last], 'images', *parts[last + 1 :])


def size_of_file(path: Path) -> ImageSize:
    """
    Read width and height in pixels of an image file.

    The size is that of the image as it is shown (EXIF orientation of JPEG applied). Raises
    ValueError if it cannot be read or Pillow is not installed.
    """
    try:
        return _shown_size(path)
    except ImportError:
        message = f'reading the size of {path} needs Pillow, which is not installed'
        raise ValueError(message) from None
    except Exception as error:
        # Any exception: Pillow raises errors of many kinds for damaged files.
        raise ValueError(f'cannot read {path} ({error})') from error


def stored_size(labels: Path) -> ImageSize:
    """
    Read the size, as `size_of_file` does, of the image that has the stem of a label file.

    Raises LabelError if there is no such image or its size cannot be read.
    """
    image = image_beside(labels, labels.stem)
    if image is None:
        raise LabelError(labels, None, 'no image beside it or in images/ to read the size from')
    try:
        return size_of_file(image)
    except ValueError as error:
        raise LabelError(labels, None, str(error)) from error


def _shown_size(path: Path) -> ImageSize:
    with opened_image(path) as image:
        width, height = image.size
        # Only JPEG: with other formats Pillow may decode the whole image to find the tag.
        turned = image.format == 'JPEG' and image.getexif().get(EXIF_ORIENTATION) in EXIF_TURNED
    return (height, width) if turned else (width, height)


@contextmanager
def opened_image(
    path: Path, formats: Sequence[str] = IMAGE_FORMATS, max_pixels: int | None = None
) -> Iterator[Any]:
    """
    Open a PIL image, not decoded yet, that may be as large as a satellite scene.

    Raises ModuleNotFoundError if Pillow is not installed; OSError or ValueError if the image cannot
    be read, is of none of the formats, as Pillow names them, or has more than `max_pixels` pixels,
    by default `MAX_PIXELS`.
    """
    from PIL import Image

    # Pillow warns above this number of pixels, and refuses twice as many.
    limit, Image.MAX_IMAGE_PIXELS = Image.MAX_IMAGE_PIXELS, (max_pixels or MAX_PIXELS) // 2
    try:
        with warnings.catch_warnings():
            warnings.simplefilter('ignore', Image.DecompressionBombWarning)
            image = Image.open(path, formats=formats)
    except Image.DecompressionBombError as error:
        raise ValueError(f'{path}: {error}') from None
    finally:
        Image.MAX_IMAGE_PIXELS = limit
    with image:
        yield image


def load_image(path: Path) -> tuple[str, NDArray[Any]]:
    """
    Read an image; raises what `opened_image` does.

    Returns
    -------
    encoding : str
        As in `sensor_msgs/Image`: mono8, mono16, rgb8 or rgba8; other images are converted to
        rgb8.
    pixels : ndarray of uint8 or uint16, shape (H, W) or (H, W, C)
        As the image is shown (EXIF orientation applied). Grey values that 16 bits do not hold,
        such as fractions, are stretched to them: the darkest and the brightest half percent become
        0 and 65535, and so do infinite ones; NaN becomes 0.

    Raises
    ------
    ValueError
        Also if it has colours of 16 bits, of which Pillow reads the upper 8 alone, or no finite
        pixel.
    """
    try:
        return _loaded(path)
    except (ImportError, OSError, ValueError, MemoryError):
        raise
    except Exception as error:
        # Pillow raises errors of many kinds for damaged files.
        raise ValueError(f'{path}: {error or type(error).__name__}') from error


def _loaded(path: Path) -> tuple[str, NDArray[Any]]:
    """Read an image; any exception if it is damaged."""
    from PIL import ImageOps

    with opened_image(path) as stored:
        if ';16' in str(stored.tile) and stored.mode in ('LA', 'RGB', 'RGBA'):
            raise ValueError(f'{path}: colours of 16 bits cannot be read: convert it to 8 bits')
        shown = ImageOps.exif_transpose(stored)
        if shown.mode in _WIDER_MODES:
            try:
                return 'mono16', as_16_bits(np.asarray(shown))
            except ValueError as error:
                raise ValueError(f'{path}: {error}') from None
        if shown.mode not in _EXACT_MODES:
            shown = shown.convert('RGB')
        return _EXACT_MODES[shown.mode], np.asarray(shown)


def as_16_bits(pixels: NDArray[Any]) -> NDArray[np.uint16]:
    """Return pixels, (H, W), as 16 bits, stretched if they do not fit; ValueError without any."""
    maximum = np.iinfo(np.uint16).max
    if (
        pixels.dtype.kind in 'iu'
        and pixels.min(initial=0) >= 0
        and pixels.max(initial=0) <= maximum
    ):
        return pixels.astype(np.uint16)
    height, width = pixels.shape
    sample = pixels[:: -(-height // _MAX_SAMPLES), :: -(-width // _MAX_SAMPLES)].astype(np.float64)
    sample = sample[np.isfinite(sample)]
    if not sample.size:
        raise ValueError('the image has no finite pixel')
    low, high = np.percentile(sample, (_CLIPPED, 100.0 - _CLIPPED))
    span = high - low
    stretched = (pixels - low) * (maximum / span if span > 0.0 else 0.0)
    return np.nan_to_num(np.clip(stretched, 0.0, maximum)).astype(np.uint16)
