# SPDX-License-Identifier: Apache-2.0
"""
What happens to a message: bytes and settings in, bytes and counts out. No ROS in here.

    batch = Batch(data, INPUT_TYPES['Detection2DArray'], settings)
    boxes = batch.boxes_message()
    regions = batch.crop_regions_message(image_size)
"""

from __future__ import annotations

from collections import Counter

import numpy as np
from numpy.typing import NDArray

from obbhbb_ros.boxes import Defect
from obbhbb_ros.boxes import FloatArray
from obbhbb_ros.boxes import OrientedBoxes
from obbhbb_ros.converter import HullRule
from obbhbb_ros.converter import half_extents
from obbhbb_ros.converter import to_xyxy
from obbhbb_ros.downlink.crops import CropPlan
from obbhbb_ros.downlink.crops import plan_crops
from obbhbb_ros.settings import Settings
from obbhbb_ros.wire.detections import Detections
from obbhbb_ros.wire.layouts import InputType

OUTER = (HullRule('outer'),)


class Batch:
    """
    The detections of one message, converted under one snapshot of the settings.

    Parameters
    ----------
    data : bytes
        The serialized message.
    input_type : InputType
        Its type.
    settings : Settings
        The settings.

    Attributes
    ----------
    counts : Counter of str
        What there was and what became of it; crop regions are added when they are planned.
    complaint : str
        Which detections could not be converted and why; empty if all could.

    Raises
    ------
    obbhbb_ros.wire.cdr.WireError
        If the bytes are no such message.
    """

    def __init__(self, data: bytes, input_type: InputType, settings: Settings) -> None:
        self._settings = settings
        self._detections = detections = Detections(data, input_type)
        self._boxes = _oriented_boxes(detections, settings.theta_scale)
        self._rule_of: NDArray[np.intp] | None = None
        if settings.rule_of_class:
            rule_of_class = settings.rule_of_class
            self._rule_of = np.array(
                [rule_of_class.get(class_id, 0) for class_id in detections.class_ids()], np.intp
            )
        self._extents = half_extents(self._boxes, settings.rules, self._rule_of, settings.caps)
        self.counts = Counter({'messages_converted': 1, 'detections_received': len(detections)})
        self.complaint = '' if self._boxes.regular else self._count_invalid()

    def boxes_message(self) -> bytes:
        """Write the message with axis-aligned boxes in place of the oriented ones."""
        xywh = np.concatenate((self._boxes.center, 2.0 * self._extents)).T
        if self._boxes.regular:
            return self._detections.rewrite(xywh)
        valid = np.isfinite(self._extents[0])
        if self._settings.keep_invalid or valid.all():
            return self._detections.rewrite(xywh, valid)
        return self._detections.selected(np.flatnonzero(valid), xywh[valid])

    def crop_regions_message(self, image_size: tuple[int, int]) -> bytes:
        """Plan the crop regions of an image of `image_size` pixels, and write them as a message."""
        plan = self._plan(self._extents, image_size)
        self._count_crops(plan)
        if self._settings.compare_outer:
            outer = self._plan(half_extents(self._boxes, OUTER), image_size)
            self.counts['crop_pixels.compared'] += plan.pixels
            self.counts['crop_pixels.outer_boxes'] += outer.pixels
        low, high = plan.regions.T[:2], plan.regions.T[2:]
        xywh = np.concatenate(((low + high) / 2.0, high - low)).T
        if plan.merged:
            return self._detections.joined(plan.groups(), xywh)
        return self._detections.selected(plan.sources, xywh)

    def _plan(self, extents: FloatArray, image_size: tuple[int, int]) -> CropPlan:
        """Plan the crop regions of boxes."""
        settings = self._settings
        weights = None if self._rule_of is None else settings.weights[self._rule_of]
        xyxy = to_xyxy(self._boxes.center, extents)
        return plan_crops(xyxy, self._detections.scores(), image_size, settings.crop, weights)

    def _count_crops(self, plan: CropPlan) -> None:
        """Count the regions of a plan, and the boxes that have none."""
        self.counts['crops_planned'] += len(plan.regions)
        self.counts['crop_pixels.planned'] += plan.pixels
        if plan.merged:
            self.counts['crops_merged_away'] += len(plan.sources) - len(plan.regions)
        for reason, count in plan.left_out.items():
            self.counts[f'crops_left_out.{reason.value}'] += count

    def _count_invalid(self) -> str:
        """Count the detections that cannot be converted by reason; say which is the first."""
        rows = np.flatnonzero(np.isnan(self._extents[0]))
        if not rows.size:
            return ''
        # A box without a defect that has no extents overflowed.
        defects = np.maximum(self._boxes.defects[rows], np.uint8(Defect.NOT_FINITE))
        action = 'kept' if self._settings.keep_invalid else 'dropped'
        for defect, count in zip(*np.unique(defects, return_counts=True), strict=True):
            self.counts[f'detections_{action}.{Defect(defect).name.lower()}'] += int(count)
        seconds, nanoseconds = self._detections.stamp
        return (
            f'{action} {len(rows)} of {len(self._boxes)} detections at stamp '
            f'{seconds}.{nanoseconds:09d}: index {rows[0]} is {Defect(defects[0]).name.lower()}'
        )


def _oriented_boxes(detections: Detections, theta_scale: float) -> OrientedBoxes:
    """Read oriented boxes; `theta_scale` turns the angles of the input into radians."""
    if detections.polygons is not None:
        return OrientedBoxes.from_polygons(detections.polygons)
    xywhr = detections.xywhr()
    if theta_scale != 1.0:
        xywhr[:, 4] *= theta_scale
    return OrientedBoxes.from_xywhr(xywhr)
