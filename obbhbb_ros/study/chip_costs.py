# SPDX-License-Identifier: Apache-2.0
"""
What tight boxes save on the downlink: pixels and encoded bytes of the chips of each method.

The synthetic picture shows the harbour in the package; none of its pixels are real. Encoding needs
Pillow, the extra `chips`.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from dataclasses import field
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from obbhbb_ros.downlink import chips
from obbhbb_ros.downlink import crops
from obbhbb_ros.geometry.boxes import OrientedBoxes
from obbhbb_ros.geometry.converter import convert_by_rule
from obbhbb_ros.labels import ImageLabels
from obbhbb_ros.study.rules import DEFAULT_RULES

RULES = {name: DEFAULT_RULES[name] for name in ('outer', 'shape_aware', 'superellipse')}
# The quality of JPEG 2000 is a percentage of the uncompressed size.
ENCODERS = {
    name: chips.CodecSettings(name, quality=20 if name == 'jpeg2000' else 80)
    for name in chips.CODECS
}

_SEA = (38.0, 62.0, 78.0)
_SEED = 20261122


@dataclass
class Cost:
    """
    Cost of the chips of a method.

    Attributes
    ----------
    chips, pixels : int
        Number of chips, and pixels of all of them.
    sizes : dict of str to int
        Bytes of all chips, by codec.
    hull, hull_lost : float
        Area of all hulls in the labels, and of their parts outside the chip of their ship, square
        pixels.
    """

    chips: int = 0
    pixels: int = 0
    sizes: dict[str, int] = field(default_factory=lambda: dict.fromkeys(ENCODERS, 0))
    hull: float = 0.0
    hull_lost: float = 0.0


def chip_costs(
    images: Iterable[tuple[ImageLabels, NDArray[Any]]], settings: crops.CropSettings
) -> dict[str, Cost]:
    """
    Cut the chips of images by each of `RULES`, and encode them with each of `ENCODERS`.

    Parameters
    ----------
    images : iterable of (ImageLabels, ndarray of uint8 of shape (H, W, C))
        Labels and pixels.
    settings : CropSettings
        How boxes become regions; without merging and limits, so that every ship has a chip.
    """
    costs = {name: Cost() for name in RULES}
    for labels, pixels in images:
        boxes = OrientedBoxes.from_corners(labels.corners)
        size = pixels.shape[1], pixels.shape[0]
        for name, rule in RULES.items():
            plan = crops.plan_crops(convert_by_rule(boxes, rule), labels.scores, size, settings)
            _add(costs[name], labels, pixels, plan)
    return costs


def _add(cost: Cost, labels: ImageLabels, pixels: NDArray[Any], plan: crops.CropPlan) -> None:
    """Add the chips of one image, cut by a plan."""
    cost.chips += len(plan.regions)
    cost.pixels += plan.pixels
    for codec, settings in ENCODERS.items():
        for x0, y0, x1, y1 in plan.regions:
            cost.sizes[codec] += len(chips.encode(pixels[y0:y1, x0:x1], settings))
    image = shapely.box(0, 0, pixels.shape[1], pixels.shape[0])
    for region, row in zip(plan.regions, plan.sources, strict=True):
        hull = labels.hulls[row]
        if hull is not None:
            visible = shapely.make_valid(shapely.polygons(hull)) & image
            cost.hull += visible.area
            cost.hull_lost += (visible - shapely.box(*region)).area


def render(labels: ImageLabels) -> NDArray[np.uint8]:
    """
    Draw a synthetic picture of labelled hulls: grey ships with decks and noise on a noisy sea.

    The picture, uint8 of shape (H, W, 3), is the same every time. Raises ValueError if the size of
    the image is not known.
    """
    from PIL import Image
    from PIL import ImageDraw

    if labels.size is None:
        raise ValueError(f'{labels.image}: no picture without the size of the image')
    width, height = labels.size
    random = np.random.default_rng(_SEED)
    image = Image.fromarray(_sea(random, width, height))
    draw = ImageDraw.Draw(image)
    for hull in labels.hulls:
        if hull is not None:
            grey = int(random.integers(110, 200))
            center = hull.mean(axis=0)
            deck = center + 0.7 * (hull - center)
            draw.polygon([tuple(point) for point in hull], fill=(grey, grey, grey - 10))
            tint = tuple(int(value) for value in random.integers(80, 230, 3))
            draw.polygon([tuple(point) for point in deck], fill=tint)
    noise = random.normal(0.0, 6.0, (height, width, 3))
    painted: NDArray[np.uint8] = np.clip(np.asarray(image) + noise, 0, 255).astype(np.uint8)
    return painted


def _sea(random: np.random.Generator, width: int, height: int) -> NDArray[np.uint8]:
    """Draw waves: noise of several sizes."""
    total = np.zeros((height, width))
    for step in (64, 16, 4):
        coarse = random.normal(0.0, 5.0, (height // step + 2, width // step + 2))
        total += np.kron(coarse, np.ones((step, step)))[:height, :width]
    return np.clip(np.array(_SEA) + total[..., None], 0, 255).astype(np.uint8)
