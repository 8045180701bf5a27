# SPDX-License-Identifier: Apache-2.0
"""
What happens to a message: bytes and settings in, bytes and counts out. No ROS in here.

    batch = Batch(data, INPUT_TYPES['Detection2DArray'], settings, image_size)
    boxes = batch.boxes_message()
    regions = batch.crop_regions_message()

`answer` decides what is published for a message, for the node and for bags alike.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from obbhbb_ros.downlink.crops import CropPlan
from obbhbb_ros.downlink.crops import plan_crops
from obbhbb_ros.geometry.boxes import Defect
from obbhbb_ros.geometry.boxes import FloatArray
from obbhbb_ros.geometry.converter import HullRule
from obbhbb_ros.geometry.converter import centers_and_extents
from obbhbb_ros.geometry.converter import half_extents
from obbhbb_ros.geometry.converter import to_xyxy
from obbhbb_ros.settings.obb_to_hbb import ConversionSettings
from obbhbb_ros.wire.detections import Detections
from obbhbb_ros.wire.layouts import InputType

OUTER = (HullRule('outer'),)


@dataclass(frozen=True)
class Output:
    """
    A topic that is answered on.

    Attributes
    ----------
    publish : callable
        Takes the bytes of a message.
    wanted : callable
        Tells, when a message would be made, whether anybody wants it.
    """

    publish: Callable[[bytes], object]
    wanted: Callable[[], object] = lambda: True


NOBODY = Output(lambda data: None, lambda: False)


class Outputs(NamedTuple):
    """The topics that a message is answered on."""

    boxes: Output
    crop_regions: Output
    crop_sources: Output = NOBODY


@dataclass(frozen=True)
class ConversionOutcome:
    """
    What became of a message.

    Attributes
    ----------
    counts : Counter of str
        As in the diagnostics.
    complaints : dict of str
        What went wrong, by kind.
    """

    counts: Counter[str]
    complaints: dict[str, str]


def answer(
    data: bytes,
    input_type: InputType,
    settings: ConversionSettings,
    camera_size: tuple[int, int],
    outputs: Outputs,
) -> ConversionOutcome:
    """
    Convert one message under one snapshot of the settings, and publish what is wanted.

    Parameters
    ----------
    data : bytes
        The serialized message.
    input_type : InputType
        Its type.
    settings : ConversionSettings
        The settings.
    camera_size : tuple of int
        Width and height of the image by the last camera info, pixels; 0 where there was none.
    outputs : Outputs
        Where the answers go.

    Returns
    -------
    ConversionOutcome
        What became of it.

    Raises
    ------
    obbhbb_ros.wire.buffer.WireError
        If the bytes are no such message.
    """
    width, height = (
        given or seen for given, seen in zip(settings.image_size, camera_size, strict=True)
    )
    image_size = (width, height) if width and height else None
    if image_size is None and not settings.input_frame.is_image:
        return _without_image_size(Counter(), 'no boxes')
    batch = Batch(data, input_type, settings, image_size)
    wants_boxes = outputs.boxes.wanted()
    if wants_boxes:
        outputs.boxes.publish(batch.boxes_message())
    # Asked only now: whoever waits for the boxes does not wait for this.
    wants_sources, wants_regions = outputs.crop_sources.wanted(), outputs.crop_regions.wanted()
    outcome = ConversionOutcome(batch.counts, {})
    if image_size is None:
        missed = {
            'no crop regions': wants_regions or wants_sources,
            'boxes are not clipped': wants_boxes and settings.clip_boxes,
        }
        if any(missed.values()):
            consequence = ', '.join(each for each in missed if missed[each])
            outcome = _without_image_size(batch.counts, consequence)
    else:
        # First, so that they are there when the regions are cut.
        if wants_sources:
            outputs.crop_sources.publish(batch.crop_sources_message())
        if wants_regions:
            outputs.crop_regions.publish(batch.crop_regions_message())
    if batch.complaint:
        outcome.complaints['invalid detections'] = batch.complaint
    return outcome


def _without_image_size(counts: Counter[str], consequence: str) -> ConversionOutcome:
    """Count a message that needs the size of the image, and say what follows."""
    counts['messages_without_image_size'] += 1
    return ConversionOutcome(
        counts,
        {
            'no image size': f'{consequence} without the size of the image: set image_width and '
            'image_height, or publish camera_info'
        },
    )


class Batch:
    """
    The detections of one message, converted under one snapshot of the settings.

    Parameters
    ----------
    data : bytes
        The serialized message.
    input_type : InputType
        Its type.
    settings : ConversionSettings
        The settings.
    image_size : tuple of int, optional
        Width and height of the image, pixels; needed for an `input_frame` other than the image,
        for `clip_boxes` and for crop regions.

    Attributes
    ----------
    counts : Counter of str
        What there was and what became of it; crop regions are added when they are planned.
    complaint : str
        Which detections could not be converted and why; empty if all could.

    Raises
    ------
    obbhbb_ros.wire.buffer.WireError
        If the bytes are no such message.
    """

    def __init__(
        self,
        data: bytes,
        input_type: InputType,
        settings: ConversionSettings,
        image_size: tuple[int, int] | None = None,
    ) -> None:
        self._settings = settings
        self._image_size = image_size
        self._detections = detections = Detections(data, input_type)
        self._boxes = settings.input_frame.oriented_boxes(
            detections.xywhr(),
            detections.polygons,
            image_size,
            theta_scale=settings.theta_scale,
            bow=settings.bow,
        )
        self._rule_of: NDArray[np.intp] | None = None
        if settings.rule_of_class:
            rule_of_class = settings.rule_of_class
            self._rule_of = np.array(
                [rule_of_class.get(class_id, 0) for class_id in detections.class_ids()], np.intp
            )
        self._center, self._extents = centers_and_extents(
            self._boxes, settings.rules, self._rule_of, settings.caps
        )
        self._regular, self._defects = self._boxes.regular, self._boxes.defects
        # Crop regions are planned from boxes as they are.
        self._unclipped = self._center, self._extents
        if settings.clip_boxes and image_size:
            self._clip(image_size)
        self.counts = Counter({'messages_converted': 1, 'detections_received': len(detections)})
        self.complaint = '' if self._regular else self._count_invalid()

    def boxes_message(self) -> bytes:
        """Write the message with axis-aligned boxes in place of the oriented ones."""
        xywh = np.hstack((self._center, 2.0 * self._extents))
        if self._regular:
            return self._detections.rewrite(xywh)
        valid = np.isfinite(self._extents[:, 0])
        if self._settings.keep_invalid or valid.all():
            return self._detections.rewrite(xywh, valid)
        return self._detections.selected(np.flatnonzero(valid), xywh[valid])

    def _clip(self, image_size: tuple[int, int]) -> None:
        """End boxes at the border of the image; those outside cannot be converted."""
        low = np.maximum(self._center - self._extents, 0.0)
        high = np.minimum(self._center + self._extents, image_size)
        outside = (low >= high).any(axis=1)
        self._center, self._extents = (low + high) / 2.0, (high - low) / 2.0
        if outside.any():
            self._defects = np.where(outside, np.uint8(Defect.OUTSIDE_IMAGE), self._defects)
            self._extents[outside] = np.nan
            self._regular = False

    def crop_regions_message(self) -> bytes:
        """
        Plan the crop regions, and write them as a message.

        Raises
        ------
        ValueError
            If the size of the image is not known.
        """
        plan = self._crop_plan
        low, high = plan.regions.T[:2], plan.regions.T[2:]
        xywh = np.concatenate(((low + high) / 2.0, high - low)).T
        if plan.merged:
            return self._detections.joined(plan.groups(), xywh)
        return self._detections.selected(plan.sources, xywh)

    def crop_sources_message(self) -> bytes:
        """
        Write the oriented box of the most valuable detection of each crop region, in their order.

        The long side lies along theta, and the score is the value of the region.

        Raises
        ------
        ValueError
            If the size of the image is not known.
        """
        plan, boxes = self._crop_plan, self._boxes
        rows = plan.sources[plan.offsets[:-1]]
        xywhr = np.vstack((boxes.center.T, boxes.length, boxes.width, boxes.theta))
        return self._detections.ranked(rows, xywhr[:, rows], plan.values)

    @cached_property
    def _crop_plan(self) -> CropPlan:
        """Plan the crop regions once, and count them."""
        if self._image_size is None:
            raise ValueError('crop regions need the size of the image')
        plan = self._plan(self._crop_boxes(), self._image_size)
        self._count_crops(plan)
        if self._settings.compare_outer:
            outer_extents = half_extents(self._boxes, OUTER)
            outer = self._plan(to_xyxy(self._boxes.center, outer_extents), self._image_size)
            self.counts['crop_pixels.compared'] += plan.pixels
            self.counts['crop_pixels.outer_boxes'] += outer.pixels
        return plan

    def _crop_boxes(self) -> FloatArray:
        """Lay boxes, (N, 4), around the boxes and the hulls that are to be kept."""
        settings = self._settings
        xyxy = to_xyxy(*self._unclipped)
        if not settings.crop_rules:
            return xyxy
        rules = [rule or OUTER[0] for rule in settings.crop_rules]
        hulls = half_extents(self._boxes, rules, self._rule_of, settings.caps)
        around = to_xyxy(self._boxes.center, hulls)
        if None in settings.crop_rules:
            box_alone = np.array([rule is None for rule in settings.crop_rules])[self._rule_of]
            around[box_alone] = xyxy[box_alone]
        return np.hstack(
            (np.minimum(xyxy[:, :2], around[:, :2]), np.maximum(xyxy[:, 2:], around[:, 2:]))
        )

    def _plan(self, xyxy: FloatArray, image_size: tuple[int, int]) -> CropPlan:
        """Plan the crop regions of boxes."""
        settings, rule_of = self._settings, self._rule_of
        weights = None if rule_of is None else settings.weights[rule_of]
        min_scores = None if rule_of is None else settings.min_scores[rule_of]
        return plan_crops(
            xyxy, self._detections.scores(), image_size, settings.crop, weights, min_scores
        )

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
        rows = np.flatnonzero(np.isnan(self._extents[:, 0]))
        if not rows.size:
            return ''
        # A box without a defect that has no extents overflowed.
        defects = np.maximum(self._defects[rows], np.uint8(Defect.NOT_FINITE))
        action = 'kept' if self._settings.keep_invalid else 'dropped'
        for defect, count in zip(*np.unique(defects, return_counts=True), strict=True):
            self.counts[f'detections_{action}.{Defect(defect).name.lower()}'] += int(count)
        seconds, nanoseconds = self._detections.stamp
        return (
            f'{action} {len(rows)} of {len(self._boxes)} detections at stamp '
            f'{seconds}.{nanoseconds:09d}: index {rows[0]} is {Defect(defects[0]).name.lower()}'
        )
