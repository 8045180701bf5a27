# SPDX-License-Identifier: Apache-2.0
"""Names of images, with and without folder and suffix."""

IMAGE_SUFFIXES = ('.png', '.jpg', '.jpeg', '.tif', '.tiff', '.bmp', '.webp', '.jp2')


def bare_name(image: str) -> str:
    """Strip folders and an image suffix from an image name, as label files are named."""
    name = image.replace('\\', '/').rpartition('/')[2]
    stem, dot, suffix = name.rpartition('.')
    return stem if f'{dot}{suffix}'.lower() in IMAGE_SUFFIXES else name
