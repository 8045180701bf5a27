# SPDX-License-Identifier: Apache-2.0
"""
Images that lie in a map, such as GeoTIFFs, and the pixels of labels in map coordinates.

All that GDAL reads and that has a reference system and a transform. Needs rasterio and pyproj, the
extra `geo`.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterable
from collections.abc import Iterator
from collections.abc import Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from obbhbb_ros.geometry.boxes import FloatArray
from obbhbb_ros.labels import maps
from obbhbb_ros.labels.image_files import MAX_PIXELS
from obbhbb_ros.labels.image_files import as_16_bits
from obbhbb_ros.labels.image_files import find_images
from obbhbb_ros.labels.image_labels import ImageLabels

# A reference box that is turned by less, in pixels, is upright: nobody draws more exactly.
UPRIGHT = 0.5
COLORS = 3


def on_images(images: Iterable[ImageLabels]) -> Iterator[ImageLabels]:
    """
    Turn labels in a map into pixels of the images beside them; other labels stay as they are.

    Raises ValueError, with the remedy, if such labels have no image or it lies in no map.
    """
    in_map = []
    for labels in images:
        if labels.extras.label_set.crs:
            in_map.append(labels)
        else:
            yield labels
    for labels, image in zip(in_map, find_images(in_map), strict=True):
        if image is None:
            raise ValueError(
                f'{labels.source}: image {labels.image!r}: the labels are in a map '
                f'({labels.extras.label_set.crs:.60}), and pixels are needed: no GeoTIFF of that '
                'name is beside them'
            )
        yield in_pixels(labels, image)


def in_one_system(
    images: Sequence[ImageLabels], others: Sequence[ImageLabels]
) -> tuple[Sequence[ImageLabels], Sequence[ImageLabels]]:
    """
    Turn two sets of labels into pixels of the images beside them, if their systems differ.

    Without an image, coordinates of no named system, as CSV has them, are taken as those of the
    other labels; two named systems are refused as `on_images` does.
    """
    everything = [*images, *others]
    systems = {labels.extras.label_set.crs for labels in everything}
    in_map = [labels for labels in everything if labels.extras.label_set.crs]
    alone = None in find_images(in_map) and len(systems - {''}) == 1
    if len(systems) < 2 or alone:
        return images, others
    return list(on_images(images)), list(on_images(others))


def in_pixels(labels: ImageLabels, image: Path) -> ImageLabels:
    """
    Turn labels in a map into pixels of an image, which may have another reference system.

    Labels in pixels are returned as they are. Points are placed one by one; those that the system
    of the image does not reach become infinite. Reference boxes that are not upright in the image
    become NaN.

    Raises ValueError, with the remedy, if the image lies in no map or cannot be read, or a system
    is not known.
    """
    if not labels.extras.label_set.crs:
        return labels
    labels = maps.restored(labels)
    with _opened(image) as raster:
        size = raster.width, raster.height
        place = _Placement(image, raster, labels.extras.label_set.crs)
    count = len(labels.class_ids)
    return replace(
        labels,
        corners=place.pixels_of(labels.corners.reshape(-1, 2)).reshape(count, 4, 2),
        reference=_upright(place.pixels_of(_corners_of(labels.reference)).reshape(count, 4, 2)),
        hulls=tuple(None if hull is None else place.pixels_of(hull) for hull in labels.hulls),
        size=size,
        extras=replace(
            labels.extras, label_set=replace(labels.extras.label_set, crs='', placed=True)
        ),
    )


def lies_under(image: Path, points: FloatArray) -> bool:
    """Tell whether an image lies in a map, and some of the points, (N, 2), inside it there."""
    try:
        with _opened(image) as raster:
            if not _has_place(raster):
                return False
            pixels = _moved(~raster.transform, points)
            size = raster.width, raster.height
            return bool(((pixels >= 0.0) & (pixels <= size)).all(axis=1).any())
    except (ImportError, ValueError):
        return False


def load_map_image(image: Path) -> NDArray[np.uint8 | np.uint16]:
    """
    Read the first three bands of an image, or the first if there are fewer, shape (H, W, C).

    Bands that are neither of 8 nor of 16 bits are stretched as `image_files.load_image` does.
    Raises ValueError if the image cannot be read or has more than `MAX_PIXELS` pixels.
    """
    import rasterio

    with _opened(image) as raster:
        if raster.width * raster.height > MAX_PIXELS:
            raise ValueError(f'{image}: {raster.width} x {raster.height} pixels are too many')
        try:
            numbers = list(range(1, COLORS + 1)) if raster.count >= COLORS else [1]
            bands = raster.read(numbers, masked=True)
        except (OSError, rasterio.errors.RasterioError) as error:
            raise ValueError(f'{image}: cannot be read: {error.__cause__ or error}') from None
    if bands.dtype.kind == 'c':
        raise ValueError(f'{image}: pixels are complex numbers: take their magnitude')
    if bands.dtype == np.uint8:
        return np.ascontiguousarray(bands.data.transpose(1, 2, 0))
    if bands.dtype != np.uint16:
        # Pixels without a value would be the darkest.
        bands = bands.astype(np.float32).filled(np.nan)
    try:
        return np.stack([as_16_bits(np.asarray(band)) for band in bands], axis=-1)
    except ValueError as error:
        raise ValueError(f'{image}: {error}') from None


class _Placement:
    """From the coordinates of a reference system to the pixels of an open image."""

    def __init__(self, image: Path, raster: Any, crs: str) -> None:
        import pyproj

        if not _has_place(raster):
            raise ValueError(
                f'{image}: the image lies in no map, but its labels do ({crs:.60}): give it '
                'reference system and transform, with gdalwarp if it has control points'
            )
        if raster.crs is None:
            raise ValueError(
                f'{image}: the image names no reference system, but its labels do ({crs:.60}): '
                'give it one, for example with gdal_edit.py -a_srs EPSG:32633'
            )
        self._inverse = ~raster.transform
        try:
            self._transformer = pyproj.Transformer.from_crs(
                crs, raster.crs.to_wkt(), always_xy=True
            )
        except pyproj.exceptions.ProjError as error:
            raise ValueError(f'{image}: no way from {crs:.60} to its map: {error}') from None

    def pixels_of(self, points: FloatArray) -> FloatArray:
        """Return points of the map, shape (K, 2), in pixels."""
        with np.errstate(invalid='ignore', over='ignore'):
            there = np.column_stack(self._transformer.transform(*points.T))
            pixels = _moved(self._inverse, there)
        # Where the projection ends, infinity times zero is NaN.
        pixels[np.isnan(pixels).any(axis=1) & ~np.isnan(points).any(axis=1)] = np.inf
        return pixels


def _moved(transform: Any, points: FloatArray) -> FloatArray:
    """Apply an affine transform to points, shape (K, 2)."""
    matrix = np.array(transform[:6]).reshape(2, 3)
    return points @ matrix[:, :2].T + matrix[:, 2]


def _has_place(raster: Any) -> bool:
    return not raster.transform.is_identity and not raster.transform.is_degenerate


@contextmanager
def _opened(image: Path) -> Iterator[Any]:
    import rasterio

    try:
        with warnings.catch_warnings():
            warnings.simplefilter('ignore', rasterio.errors.NotGeoreferencedWarning)
            raster = rasterio.open(image)
    except (OSError, rasterio.errors.RasterioError) as error:
        raise ValueError(f'{image}: cannot be read: {error}') from None
    with raster:
        yield raster


def _corners_of(xyxy: FloatArray) -> FloatArray:
    """Return the corners of N axis-aligned boxes, shape (4 N, 2)."""
    return xyxy[:, [0, 1, 2, 1, 2, 3, 0, 3]].reshape(-1, 2)


def _upright(corners: FloatArray) -> FloatArray:
    """Return N quadrilaterals, shape (N, 4, 2), as xyxy; NaN for those that are not upright."""
    xyxy = np.hstack((corners.min(axis=1), corners.max(axis=1)))
    # Each side of an upright one has two corners.
    distance = np.sort(corners, axis=1) - xyxy[:, [[0, 1], [0, 1], [2, 3], [2, 3]]]
    with np.errstate(invalid='ignore'):
        turned = ~(np.abs(distance).max(axis=(1, 2), initial=0.0) <= UPRIGHT)
    xyxy[turned] = np.nan
    return xyxy
