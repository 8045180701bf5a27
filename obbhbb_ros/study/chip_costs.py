# SPDX-License-Identifier: Apache-2.0
"""
What the tight box is worth on the downlink: pixels and encoded bytes of each method's chips.

The synthetic picture shows the harbour that the package carries; no pixel of it is real. Encoding
takes Pillow, the extra `chips`; drawing takes matplotlib, the extra `plots`.
"""

from __future__ import annotations

from collections.abc import Iterable
from collections.abc import Mapping
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from obbhbb_ros.boxes import FloatArray
from obbhbb_ros.boxes import OrientedBoxes
from obbhbb_ros.converter import HullRule
from obbhbb_ros.converter import convert_by_rule
from obbhbb_ros.downlink.chips import CODECS
from obbhbb_ros.downlink.chips import CodecSettings
from obbhbb_ros.downlink.chips import encode
from obbhbb_ros.downlink.crops import CropSettings
from obbhbb_ros.downlink.crops import plan_crops
from obbhbb_ros.files import replacing
from obbhbb_ros.labels import ImageLabels
from obbhbb_ros.study.plots import COLORS
from obbhbb_ros.study.summary import text_table

RULES: dict[str, HullRule] = {
    'outer': HullRule('outer'),
    'shape_aware': HullRule('shape_aware', q=2.2, f=0.9, s=1.0),
    'superellipse': HullRule(),
}
ENCODERS: dict[str, CodecSettings] = {
    name: CodecSettings(name, quality=80) for name in CODECS if name != 'jpeg2000'
} | {'jpeg2000': CodecSettings('jpeg2000', quality=20)}

_SEA = (38.0, 62.0, 78.0)
_SEED = 20261122


@dataclass
class Cost:
    """
    What the chips of a method cost.

    Attributes
    ----------
    chips, pixels : int
        How many there are, and their pixels together.
    sizes : dict of str to int
        Bytes of their files by codec.
    hull, hull_lost : float
        Area of the hulls that are known, and what of it lies in no chip of its ship; square
        pixels.
    """

    chips: int
    pixels: int
    sizes: dict[str, int]
    hull: float
    hull_lost: float


def chip_costs(
    images: Iterable[tuple[ImageLabels, NDArray[Any]]],
    settings: CropSettings,
) -> dict[str, Cost]:
    """
    Cut and encode the chips of some images by each of `RULES` with each of `ENCODERS`.

    Parameters
    ----------
    images : iterable of (ImageLabels, ndarray of uint8 of shape (H, W, C))
        Labels and pixels.
    settings : CropSettings
        How boxes become regions; without merging or limits, so that each ship has its chip.

    Returns
    -------
    dict of str to Cost
        By method.
    """
    costs = {name: Cost(0, 0, dict.fromkeys(ENCODERS, 0), 0.0, 0.0) for name in RULES}
    for labels, pixels in images:
        boxes = OrientedBoxes.from_corners(labels.corners)
        size = pixels.shape[1], pixels.shape[0]
        for name, rule in RULES.items():
            plan = plan_crops(convert_by_rule(boxes, rule), labels.scores, size, settings)
            _add(costs[name], labels, pixels, plan.regions, plan.sources)
    return costs


def _add(
    cost: Cost,
    labels: ImageLabels,
    pixels: NDArray[Any],
    regions: NDArray[np.int64],
    sources: NDArray[np.intp],
) -> None:
    """Add the chips of one image."""
    chips = [pixels[y0:y1, x0:x1] for x0, y0, x1, y1 in regions.tolist()]
    cost.chips += len(chips)
    cost.pixels += sum(chip.shape[0] * chip.shape[1] for chip in chips)
    for codec, settings in ENCODERS.items():
        cost.sizes[codec] += sum(len(encode(chip, settings)) for chip in chips)
    known = [i for i, row in enumerate(sources) if labels.hulls[row] is not None]
    hulls = [_visible(labels.hulls[sources[i]], pixels.shape) for i in known]
    area = sum(hull.area for hull in hulls)
    kept = [
        shapely.intersection(hull, shapely.box(*regions[i])).area
        for hull, i in zip(hulls, known, strict=True)
    ]
    cost.hull += area
    cost.hull_lost += area - sum(kept)


def _visible(hull: FloatArray | None, shape: Sequence[int]) -> Any:
    """Give the part of a hull that lies in the image."""
    polygon = shapely.make_valid(shapely.polygons(hull))
    return shapely.intersection(polygon, shapely.box(0, 0, shape[1], shape[0]))


def cost_table(costs: Mapping[str, Cost]) -> str:
    """Write costs as a table; in brackets what is saved against `outer`."""
    outer = costs['outer']
    rows = []
    for name, cost in costs.items():
        cells = [_against(cost.pixels, outer.pixels)]
        cells += [_against(cost.sizes[codec], outer.sizes[codec]) for codec in ENCODERS]
        lost = f'{cost.hull_lost / cost.hull:.2%}' if cost.hull else 'unknown'
        rows.append((name, str(cost.chips), *cells, lost))
    head = [f'{codec} [bytes]' for codec in ENCODERS]
    return text_table(('method', 'chips', 'pixels', *head, 'hull pixels lost'), rows)


def _against(value: int, outer: int) -> str:
    """Write a number and how it differs from that of the outer boxes."""
    return f'{value} ({value / outer - 1.0:+.1%})' if outer else str(value)


def render(labels: ImageLabels) -> NDArray[np.uint8]:
    """
    Paint a synthetic picture of labelled hulls: grey ships with decks and noise on a noisy sea.

    Parameters
    ----------
    labels : ImageLabels
        Ships with hulls, and the size of the image.

    Returns
    -------
    ndarray of uint8, shape (H, W, 3)
        Red, green, blue; the same every time.

    Raises
    ------
    ValueError
        If the size of the image is not known.
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
    """Paint waves: noise of several sizes."""
    total = np.zeros((height, width))
    for step in (64, 16, 4):
        coarse = random.normal(0.0, 5.0, (height // step + 2, width // step + 2))
        total += np.kron(coarse, np.ones((step, step)))[:height, :width]
    return np.clip(np.array(_SEA) + total[..., None], 0, 255).astype(np.uint8)


def draw_costs(
    costs: Mapping[str, Cost], labels: ImageLabels, pixels: NDArray[Any], path: Path, title: str
) -> None:
    """
    Draw a picture's regions, and what the chips cost against those of the outer boxes.

    Parameters
    ----------
    costs : mapping of str to Cost
        By method, `outer` among them.
    labels : ImageLabels
        Labels of the picture shown.
    pixels : ndarray of uint8, shape (H, W, C)
        The picture.
    path : Path
        File to write.
    title : str
        Says where the data come from.

    Raises
    ------
    ModuleNotFoundError
        If matplotlib is not installed.
    """
    from matplotlib.figure import Figure
    from matplotlib.patches import Rectangle

    figure = Figure(figsize=(15.0, 5.6), layout='constrained')
    scene, bars = figure.subplots(1, 2, width_ratios=(1.1, 1.0))
    scene.imshow(pixels, cmap='gray' if pixels.shape[2] == 1 else None)
    scene.set(title=title, xticks=[], yticks=[])
    boxes = OrientedBoxes.from_corners(labels.corners)
    for name in ('outer', 'superellipse'):
        for x0, y0, x1, y1 in convert_by_rule(boxes, RULES[name]).tolist():
            style: dict[str, Any] = {'fill': False, 'edgecolor': COLORS[name], 'lw': 1.3}
            scene.add_patch(Rectangle((x0, y0), x1 - x0, y1 - y0, **style))
    labels_of_bars = ['pixels', *ENCODERS]
    for index, (name, cost) in enumerate(costs.items()):
        outer = costs['outer']
        values = [cost.pixels / outer.pixels]
        values += [cost.sizes[codec] / outer.sizes[codec] for codec in ENCODERS]
        lost = f', {cost.hull_lost / cost.hull:.1%} of the hulls lost' if cost.hull else ''
        places = np.arange(len(values)) + 0.27 * (index - 1)
        drawn = bars.bar(places, values, 0.25, color=COLORS[name], label=name + lost)
        bars.bar_label(drawn, [f'{value:.0%}' for value in values], fontsize=8)
    bars.set_xticks(np.arange(len(labels_of_bars)), labels_of_bars)
    bars.set(ylabel='of what the outer boxes cost', ylim=(0.0, 1.25))
    bars.set_title('cost of the chips')
    bars.legend(loc='upper center', ncols=1, frameon=False)
    with replacing(path) as whole:
        figure.savefig(whole, dpi=75, format=path.suffix[1:] or 'png')
