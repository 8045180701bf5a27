# SPDX-License-Identifier: Apache-2.0
"""What label files say of an image besides its boxes, taken from the image file."""

from __future__ import annotations

from collections.abc import Callable
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

from obbhbb_ros.labels.image_files import image_beside
from obbhbb_ros.labels.image_files import size_of_file
from obbhbb_ros.labels.image_labels import ImageBoxes
from obbhbb_ros.labels.image_names import IMAGE_SUFFIXES
from obbhbb_ros.labels.image_names import bare_name
from obbhbb_ros.labels.label_format import Format


def completed(
    images: Iterable[ImageBoxes], target: Format, report: Callable[[str], None]
) -> list[ImageBoxes]:
    """
    Take sizes and file names that labels lack from the image files, where `target` has them.

    `report` gets a line if sizes stay unknown. Raises ValueError if `target` needs one of them.
    """
    if not target.needs_sizes and 'image sizes' not in target.holds:
        return list(images)
    done, unknown = [], []
    for labels in images:
        image, problem = _completed(labels, keep_name='file names' in target.holds)
        done.append(image)
        if not problem:
            continue
        if target.needs_sizes and image.class_ids:
            advice = f'{problem}: give the image size'
            raise ValueError(f'image {image.image!r}: {target.name} needs its size: {advice}')
        unknown.append(f'image {image.image!r}: {problem}')
    if unknown and not target.needs_sizes:
        lack = f'{target.name}: {len(unknown)} of {len(done)} images have no size'
        report(f'{lack}, which many tools need: {unknown[0]}')
    return done


def _completed(image: ImageBoxes, keep_name: bool) -> tuple[ImageBoxes, str]:
    """Return the image with size and file name, and why its size is unknown; '' if it is not."""
    named = image.file_name.lower().endswith(IMAGE_SUFFIXES)
    named = named or bool(keep_name and image.extras.file_name)
    if image.extras.label_set.crs or (named and image.size is not None):
        return image, ''
    path = image_beside(image.source, image.image)
    if path is None:
        problem = 'no image beside the labels or in images/ to read the size from'
        return image, '' if image.size is not None else problem
    if not named:
        extras = replace(image.extras, file_name=_in_folder_of(image.image, path))
        image = replace(image, extras=extras)
    if image.size is not None:
        return image, ''
    try:
        return replace(image, size=size_of_file(path)), ''
    except ValueError as error:
        return image, str(error)


def _in_folder_of(image: str, path: Path) -> str:
    return f'{image.removesuffix(bare_name(image))}{path.name}'
