# SPDX-License-Identifier: Apache-2.0
"""The order of classes in files that number them."""

from __future__ import annotations

from collections.abc import Sequence

from obbhbb_ros.labels.extras import LabelSet
from obbhbb_ros.labels.image_labels import ImageBoxes
from obbhbb_ros.labels.image_labels import ImageLabels


def ordered_classes(images: Sequence[ImageLabels | ImageBoxes]) -> list[str]:
    """
    List the classes of images, so that all parts of a data set have the same order.

    Classes that the source lists come first, also those without boxes: by their number or id. The
    others follow in the order of their names.
    """
    sets = {id(image.extras.label_set): image.extras.label_set for image in images}
    listed = [name for one in sets.values() for name in _listed(one)]
    used = sorted({name for image in images for name in image.class_ids})
    return list(dict.fromkeys([*listed, *used]))


def _listed(label_set: LabelSet) -> list[str]:
    ids = label_set.categories
    by_id = sorted(ids, key=lambda name: (isinstance(ids[name], str), ids[name]))
    return [*filter(None, label_set.class_names), *by_id]
