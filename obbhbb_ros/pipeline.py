# SPDX-License-Identifier: Apache-2.0
"""
What happens to a message: bytes and settings in, bytes and counts out, without ROS.

    batch = Batch(data, INPUT_TYPES['Detection2DArray'], settings, image_size)
    boxes = batch.boxes_message()
    plan = batch.plan_crops()
    regions = batch.crop_regions_message(plan)

`answer` decides what is published for a message, for the node and for bags alike.
"""

from __future__ import annotations

from collections.abc import Callable
from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from obbhbb_ros.downlink.cameras import CameraChoice
from obbhbb_ros.downlink.crops import CropPlan
from obbhbb_ros.downlink.crops import plan_crops
from obbhbb_ros.geometry.boxes import Defect
from obbhbb_ros.geometry.boxes import FloatArray
from obbhbb_ros.geometry.boxes import count_crossed
from obbhbb_ros.geometry.converter import HullRule
from obbhbb_ros.geometry.converter import centers_and_extents
from obbhbb_ros.geometry.converter import half_extents
from obbhbb_ros.geometry.converter import to_xyxy
from obbhbb_ros.plausibility import Doubt
from obbhbb_ros.plausibility import OutsideWatch
from obbhbb_ros.plausibility import doubtful_angles
from obbhbb_ros.plausibility import doubtful_scores
from obbhbb_ros.plausibility import frames_text
from obbhbb_ros.settings.obb_to_hbb import ConversionSettings
from obbhbb_ros.wire.camera import WireCamera
from obbhbb_ros.wire.detections import Detections
from obbhbb_ros.wire.layouts import InputType
from obbhbb_ros.wire.stamp import stamp_text

OUTER = (HullRule('outer'),)

OTHER_FRAME = 'other frame'
"""Kind of the complaint that is worth saying once."""

# Of one detection only one of them counts.
_OUTSIDE = (
    'crops_left_out.outside_image',
    'detections_dropped.outside_image',
    'detections_kept.outside_image',
)


@dataclass(frozen=True)
class Output:
    """
    A topic for answers.

    Attributes
    ----------
    publish : callable
        Takes the bytes of a message.
    wanted : callable
        Returns whether anybody wants a message now.
    """

    publish: Callable[[bytes], object]
    wanted: Callable[[], object] = lambda: True


NOBODY = Output(lambda data: None, lambda: False)


class Outputs(NamedTuple):
    """The topics for the answers to a message."""

    boxes: Output
    crop_regions: Output
    crop_sources: Output = NOBODY


class ConversionOutcome(NamedTuple):
    """
    What became of a message.

    Attributes
    ----------
    counts : dict of str to int
        By key of the diagnostics.
    complaints : dict of str
        What went wrong, by kind.
    image_size : tuple of int, optional
        Width and height of the image, if they are known.
    """

    counts: dict[str, int]
    complaints: dict[str, str]
    image_size: tuple[int, int] | None = None


def answer(
    data: bytes,
    input_type: InputType,
    settings: ConversionSettings,
    camera: CameraChoice[WireCamera] | None,
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
    camera : CameraChoice of WireCamera, optional
        The camera of the image, by its stamp or the latest. It gives the size of the image where
        the settings do not.
    outputs : Outputs
        Where the answers go. Each is asked once whether it is wanted.

    Returns
    -------
    ConversionOutcome
        What became of it. If no answer is wanted, the message is not read.

    Raises
    ------
    obbhbb_ros.wire.buffer.WireError
        If the bytes are no such message.
    """
    wants_boxes = bool(outputs.boxes.wanted())
    wants_crops = (False, False) if wants_boxes else _crops_wanted(outputs)
    if not wants_boxes and not any(wants_crops):
        return ConversionOutcome({'messages_without_subscriber': 1}, {})
    image_size, used = known_image_size(settings.image_size, camera)
    if image_size is None and not settings.input_frame.is_image:
        return ConversionOutcome(
            {'messages_without_image_size': 1}, no_size_complaint(['no boxes'])
        )
    batch = Batch(data, input_type, settings, image_size)
    if wants_boxes:
        outputs.boxes.publish(batch.boxes_message())
        # Only now, so that the boxes do not wait for it.
        wants_crops = _crops_wanted(outputs)
    counts, complaints = batch.counts | used, {}
    if image_size is None:
        missed = ['no crop regions'] if any(wants_crops) else []
        if wants_boxes and settings.clip_boxes:
            missed.append('boxes are not clipped')
        if missed:
            counts['messages_without_image_size'] = 1
            complaints = no_size_complaint(missed)
    elif any(wants_crops):
        counts |= _publish_crops(batch, outputs, *wants_crops)
    reported, texts = _reports(batch, camera if used else None, any(wants_crops))
    return ConversionOutcome(counts | reported, complaints | texts, image_size)


def _reports(
    batch: Batch, camera: CameraChoice[WireCamera] | None, wants_crops: bool
) -> tuple[dict[str, int], dict[str, str]]:
    """Count what looks wrong in a message, and complain of it by kind."""
    complaints = {}
    if batch.complaint:
        complaints['invalid detections'] = batch.complaint
    counts, texts = camera_doubt(batch.frame_id, camera)
    complaints |= texts
    for doubt, text in batch.doubts(has_plan=batch.has_image_size and wants_crops):
        counts[doubt.key] = len(doubt.rows)
        complaints[doubt.key] = text
    return counts, complaints


def camera_doubt(
    frame_id: str, camera: CameraChoice[WireCamera] | None
) -> tuple[dict[str, int], dict[str, str]]:
    """
    Count detections of another frame than the camera that gave the size, and complain by kind.

    Parameters
    ----------
    frame_id : str
        Frame of the detections.
    camera : CameraChoice of WireCamera, optional
        The camera, if it gave the size of the image.
    """
    seen = ('camera_info', camera.camera.frame_id if camera else '')
    text = frames_text(('detections', frame_id), seen)
    return ({'frame_ids_differ.camera_info': 1}, {OTHER_FRAME: text}) if text else ({}, {})


def outside_complaint(watch: OutsideWatch, outcome: ConversionOutcome) -> dict[str, str]:
    """Complain, by kind, if most of the latest detections lie outside the image."""
    counts, size = outcome.counts, outcome.image_size
    if size is None:
        return {}
    outside = sum(counts.get(key, 0) for key in _OUTSIDE)
    text = watch.note(outside, counts.get('detections_received', 0), size)
    if not text:
        return {}
    return {
        'outside': f'{text}: is camera_info, or image_width and image_height, that of the image '
        'that the detector saw?'
    }


def known_image_size(
    size: tuple[int, int], camera: CameraChoice[WireCamera] | None
) -> tuple[tuple[int, int] | None, dict[str, int]]:
    """
    Return the size of the image, None if it is unknown, and count the camera that gave it.

    Parameters
    ----------
    size : tuple of int
        Width and height from the parameters, pixels; 0 where the camera decides.
    camera : CameraChoice of WireCamera, optional
        The camera of the image.
    """
    width, height = size
    used = {}
    if camera is not None and not (width and height):
        used[camera.key] = 1
        seen = camera.camera.image_size
        width, height = width or seen[0], height or seen[1]
    return ((width, height) if width and height else None), used


def _crops_wanted(outputs: Outputs) -> tuple[bool, bool]:
    """Ask whether anybody wants crop sources, and crop regions."""
    return bool(outputs.crop_sources.wanted()), bool(outputs.crop_regions.wanted())


def no_size_complaint(consequences: list[str]) -> dict[str, str]:
    """Say what follows from an unknown size of the image."""
    return {
        'no image size': f'{", ".join(consequences)} without the size of the image: set '
        'image_width and image_height, or publish camera_info, or remap camera_info to its topic'
    }


def _publish_crops(
    batch: Batch, outputs: Outputs, wants_sources: bool, wants_regions: bool
) -> dict[str, int]:
    """Plan the crop regions, publish what is wanted, and count."""
    plan = batch.plan_crops()
    # The sources first, so that they are there when the regions are cut.
    if wants_sources:
        outputs.crop_sources.publish(batch.crop_sources_message(plan))
    if wants_regions:
        outputs.crop_regions.publish(batch.crop_regions_message(plan))
    return batch.crop_counts(plan)


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
    counts : dict of str to int
        How many detections there were, and how many of them could not be converted.
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
        xywhr = detections.xywhr()
        self._theta = xywhr[:, 4]
        self._boxes = boxes = settings.input_frame.oriented_boxes(
            xywhr, detections.polygons, image_size, bow=settings.bow
        )
        self._rule_of: NDArray[np.intp] | None = None
        if rule_of_class := settings.rule_of_class:
            self._rule_of = np.array(
                [rule_of_class.get(class_id, 0) for class_id in detections.class_ids()], np.intp
            )
        self._center, self._extents = centers_and_extents(
            boxes, settings.rules, self._rule_of, settings.caps
        )
        # Crop regions are planned from boxes that are not clipped.
        self._unclipped = self._center, self._extents
        self._regular, self._defects = boxes.regular, boxes.defects
        if settings.clip_boxes and image_size:
            self._clip(image_size)
        self.counts = {'messages_converted': 1, 'detections_received': len(detections)}
        if detections.polygons and (crossed := count_crossed(detections.polygons)):
            self.counts['polygons_reordered'] = crossed
        self.complaint = '' if self._regular else self._count_invalid()

    @property
    def frame_id(self) -> str:
        """The frame of the message."""
        return self._detections.frame_id

    @property
    def has_image_size(self) -> bool:
        """Whether the size of the image is known."""
        return self._image_size is not None

    def boxes_message(self) -> bytes:
        """Write the message with axis-aligned boxes in place of the oriented ones."""
        xywh = np.concatenate((self._center, 2.0 * self._extents), axis=1)
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

    def plan_crops(self) -> CropPlan:
        """
        Plan the crop regions.

        Raises
        ------
        ValueError
            If the size of the image is not known.
        """
        return self._plan(self._crop_boxes())

    def crop_regions_message(self, plan: CropPlan) -> bytes:
        """Write the regions of a plan, with the detections in each."""
        low, high = plan.regions.T[:2], plan.regions.T[2:]
        xywh = np.concatenate(((low + high) / 2.0, high - low)).T
        if plan.merged:
            return self._detections.joined(plan.groups(), xywh)
        return self._detections.selected(plan.sources, xywh)

    def crop_sources_message(self, plan: CropPlan) -> bytes:
        """
        Write the oriented box of the most valuable detection of each crop region, in their order.

        The long side lies along theta, and the score is the value of the region.
        """
        boxes = self._boxes
        rows = plan.sources[plan.offsets[:-1]]
        xywhr = np.array((*boxes.center.T, boxes.length, boxes.width, boxes.theta))
        return self._detections.ranked(rows, xywhr[:, rows], plan.values)

    def crop_counts(self, plan: CropPlan) -> dict[str, int]:
        """Count the regions of a plan, and the boxes that have none."""
        counts = {'crops_planned': len(plan.regions), 'crop_pixels.planned': plan.pixels}
        if plan.merged:
            counts['crops_merged_away'] = len(plan.sources) - len(plan.regions)
        for reason, count in plan.left_out.items():
            counts[f'crops_left_out.{reason.value}'] = count
        if self._settings.compare_outer:
            outer = self._plan(to_xyxy(self._boxes.center, half_extents(self._boxes, OUTER)))
            counts['crop_pixels.compared'] = plan.pixels
            counts['crop_pixels.outer_boxes'] = outer.pixels
        return counts

    def _crop_boxes(self) -> FloatArray:
        """Enclose each box and the hull that its crop region is to keep; (N, 4)."""
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
        low, high = np.minimum(xyxy[:, :2], around[:, :2]), np.maximum(xyxy[:, 2:], around[:, 2:])
        return np.concatenate((low, high), axis=1)

    def _plan(self, xyxy: FloatArray) -> CropPlan:
        """Plan the crop regions of boxes."""
        if self._image_size is None:
            raise ValueError('crop regions need the size of the image')
        settings, scores = self._settings, self._detections.scores()
        if self._rule_of is None:
            return plan_crops(xyxy, scores, self._image_size, settings.crop)
        weights, min_scores = settings.weights[self._rule_of], settings.min_scores[self._rule_of]
        return plan_crops(xyxy, scores, self._image_size, settings.crop, weights, min_scores)

    def doubts(self, has_plan: bool) -> Iterator[tuple[Doubt, str]]:
        """
        List what the detector hardly means, with a text for an operator.

        Scores are looked at only where a plan has ranked by them: they are read already.
        """
        if self._settings.input_frame.theta_scale == 1.0:
            for doubt in doubtful_angles(self._theta):
                yield doubt, self._text_of(doubt, self._theta)
        if not has_plan:
            return
        scores = self._detections.scores()
        for doubt in doubtful_scores(scores):
            yield doubt, self._text_of(doubt, scores)

    def _text_of(self, doubt: Doubt, values: FloatArray) -> str:
        """Say which detections are doubtful, and why."""
        first = doubt.rows[0]
        return (
            f'{len(doubt.rows)} of {len(self._boxes)} detections at stamp '
            f'{stamp_text(self._detections.stamp)} have {doubt.what}; index {first} has '
            f'{values[first]:.4g}: {doubt.cause}'
        )

    def _count_invalid(self) -> str:
        """Count the detections that cannot be converted by reason; say which is the first."""
        rows = np.flatnonzero(np.isnan(self._extents[:, 0]))
        if not rows.size:
            return ''
        # A box without a defect that has no extents overflowed.
        defects = np.maximum(self._defects[rows], np.uint8(Defect.NOT_FINITE))
        action = 'kept' if self._settings.keep_invalid else 'dropped'
        for defect, count in zip(*np.unique(defects, return_counts=True), strict=True):
            self.counts[f'detections_{action}.{Defect(defect).name.lower()}'] = int(count)
        return (
            f'{action} {len(rows)} of {len(self._boxes)} detections at stamp '
            f'{stamp_text(self._detections.stamp)}: index {rows[0]} is '
            f'{Defect(defects[0]).name.lower()}'
        )
