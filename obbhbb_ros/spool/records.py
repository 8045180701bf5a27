# SPDX-License-Identifier: Apache-2.0
"""The record of a chip: what the spool stores and the ground learns of it."""

from __future__ import annotations

import math
from collections.abc import Callable
from collections.abc import Sequence

from obbhbb_ros.downlink.chips import EncodedChip
from obbhbb_ros.earth.reported import ShipPlaces
from obbhbb_ros.spool.chip_rows import NewChip
from obbhbb_ros.wire.camera import WireCamera
from obbhbb_ros.wire.image import WireImage
from obbhbb_ros.wire.plans import Source
from obbhbb_ros.wire.plans import WirePlan


def recorder_of(
    image: WireImage,
    plan: WirePlan,
    sources: Sequence[Source],
    codec: str,
    camera: WireCamera | None,
    name_objects: Callable[[Sequence[str]], Sequence[str]],
    places: ShipPlaces | None = None,
) -> Callable[[EncodedChip], NewChip]:
    """
    Return a function that makes the records of the chips of a frame.

    Parameters
    ----------
    image : WireImage
        The image that the chips are cut from.
    plan : WirePlan
        The plan that they are cut by.
    sources : sequence of Source
        Value and oriented box of each region of the plan; empty if they are not known, and then
        the score is the value.
    codec : str
        Name of the codec.
    camera : WireCamera or None
        The camera of the image, if it is known.
    name_objects : callable
        Returns the objects of a frame, given the ids of its detections; as `ObjectIds.name`.
    places : ShipPlaces, optional
        Where the ships of the image are on Earth.
    """
    detection_ids = plan.detection_ids()
    all_ids = [text for ids in detection_ids for text in ids]
    objects = dict(zip(all_ids, name_objects(all_ids), strict=True))
    common = {
        'frame_id': image.frame_id,
        'image_size': [image.width, image.height],
        'codec': codec,
        'camera': None if camera is None else _camera_facts(camera),
    }

    def record(chip: EncodedChip) -> NewChip:
        x0, y0, x1, y1 = chip.region
        score, class_id = plan.scores[chip.index], plan.class_ids[chip.index]
        source = sources[chip.index] if sources else Source('', score or 0.0, ())
        facts = {
            'roi': [x0, y0, x1 - x0, y1 - y0],
            'score': score,
            'detection_ids': detection_ids[chip.index],
            'obb': _finite(source.obb),
            **common,
        }
        # A chip of several ships counts for the ship of its most valuable detection.
        first = source.id or next(iter(detection_ids[chip.index]), '')
        if places is not None:
            facts['position'] = places.facts(first)
        object_id = objects.get(first, '')
        return NewChip(source.value, class_id, image.stamp, facts, chip.data, object_id)

    return record


def _camera_facts(camera: WireCamera) -> dict[str, object]:
    """List what the ground needs to turn pixels of the image into directions."""
    return {
        'size': camera.size,
        'k': _finite(camera.k if any(camera.k) else ()),
        'model': camera.model,
        'd': _finite(camera.d),
        'roi': camera.roi,
        'binning': camera.binning,
    }


def _finite(numbers: Sequence[float]) -> list[float] | None:
    """List numbers; None if there are none, or some that JSON cannot express."""
    return list(numbers) if numbers and all(map(math.isfinite, numbers)) else None
