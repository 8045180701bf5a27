# SPDX-License-Identifier: Apache-2.0
"""Small fleets to measure on."""

from pathlib import Path

import numpy as np

from obbhbb_ros import OrientedBoxes
from obbhbb_ros.labels import ImageLabels
from obbhbb_ros.study.ships import Ships

REAL = Path(__file__).parents[2] / 'data' / 'real_ships.csv'


def fleet(rows, reference=None, classes=None, images=None):
    """Make ships of xywhr rows; without more, one image and class, references unknown."""
    boxes = OrientedBoxes.from_xywhr(rows)
    count = len(boxes)
    return Ships(
        boxes=boxes,
        reference=np.full((count, 4), np.nan) if reference is None else np.asarray(reference),
        class_ids=np.array(['ship'] * count if classes is None else classes),
        image_of=np.zeros(count, int) if images is None else np.asarray(images),
        names=tuple(map(str, range(count))),
        hulls=(None,) * count,
    )


def labels(image, xyxy, reference=None, classes=None):
    """Label one image with upright boxes."""
    x0, y0, x1, y1 = np.asarray(xyxy, float).reshape(-1, 4).T
    corners = np.stack((x0, y0, x1, y0, x1, y1, x0, y1), axis=1).reshape(-1, 4, 2)
    count = len(corners)
    return ImageLabels(
        image=image,
        corners=corners,
        class_ids=('ship',) * count if classes is None else tuple(classes),
        ids=('',) * count,
        scores=np.ones(count),
        reference=np.full((count, 4), np.nan) if reference is None else np.asarray(reference),
        hulls=(None,) * count,
        size=None,
        source=Path('labels.csv'),
    )
