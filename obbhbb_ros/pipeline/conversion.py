# SPDX-License-Identifier: Apache-2.0
"""
What `obb_to_hbb` does to a message: bytes and settings in, bytes and counts out, without ROS.

    outcome = answer(data, INPUT_TYPES['Detection2DArray'], settings, camera, outputs)

The node and `obbhbb bag` both call it.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

from obbhbb_ros.downlink.cameras import CameraChoice
from obbhbb_ros.pipeline.batch import Batch
from obbhbb_ros.pipeline.image_size import camera_doubt
from obbhbb_ros.pipeline.image_size import known_image_size
from obbhbb_ros.pipeline.image_size import no_size_complaint
from obbhbb_ros.pipeline.outcome import NOBODY
from obbhbb_ros.pipeline.outcome import Finding
from obbhbb_ros.pipeline.outcome import Outcome
from obbhbb_ros.pipeline.outcome import Output
from obbhbb_ros.pipeline.plausibility import OutsideWatch
from obbhbb_ros.settings.obb_to_hbb import ConversionSettings
from obbhbb_ros.wire.camera import WireCamera
from obbhbb_ros.wire.layouts import InputType

# Of one detection only one of them counts.
_OUTSIDE = (
    'crops_left_out.outside_image',
    'detections_dropped.outside_image',
    'detections_kept.outside_image',
)


class Outputs(NamedTuple):
    """The topics for the answers of `obb_to_hbb`."""

    boxes: Output
    crop_regions: Output
    crop_sources: Output = NOBODY


def answer(
    data: bytes,
    input_type: InputType,
    settings: ConversionSettings,
    camera: CameraChoice[WireCamera] | None,
    outputs: Outputs,
) -> Outcome:
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
    Outcome
        What became of it. If no answer is wanted, the message is not read.

    Raises
    ------
    obbhbb_ros.wire.buffer.WireError
        If the bytes are no such message.
    """
    wants_boxes = bool(outputs.boxes.wanted())
    wants_crops = (False, False) if wants_boxes else _crops_wanted(outputs)
    if not wants_boxes and not any(wants_crops):
        return Outcome({'messages_without_subscriber': 1}, {})
    image_size, used = known_image_size(settings.image_size, camera)
    if image_size is None and not settings.input_frame.is_image:
        return Outcome({'messages_without_image_size': 1}, no_size_complaint(['no boxes']))
    batch = Batch(data, input_type, settings, image_size)
    if wants_boxes:
        outputs.boxes.publish(batch.boxes_message())
        # Only now, so that the boxes do not wait for it.
        wants_crops = _crops_wanted(outputs)
    findings = [Finding(batch.counts), Finding(used)]
    if image_size is None:
        findings.append(_missed(wants_boxes and settings.clip_boxes, any(wants_crops)))
    elif any(wants_crops):
        findings.append(Finding(_publish_crops(batch, outputs, *wants_crops)))
    findings.append(camera_doubt(batch.frame_id, camera if used else None))
    findings.extend(_doubts(batch, any(wants_crops)))
    return Outcome.of(findings, image_size)


def _missed(wants_clipped: bool, wants_crops: bool) -> Finding:
    """Count and report what is wanted but needs the size of the image, which is unknown."""
    missed = [
        *(['no crop regions'] if wants_crops else []),
        *(['boxes are not clipped'] if wants_clipped else []),
    ]
    if not missed:
        return Finding({})
    return Finding({'messages_without_image_size': 1}, no_size_complaint(missed))


def _doubts(batch: Batch, wants_crops: bool) -> Iterator[Finding]:
    """Count and report detections that are invalid, and those that are hardly meant."""
    if batch.complaint:
        yield Finding({}, {'invalid detections': batch.complaint})
    yield from batch.doubts(has_plan=batch.has_image_size and wants_crops)


def outside_complaint(watch: OutsideWatch, outcome: Outcome) -> dict[str, str]:
    """Complain, by kind, if most of the latest detections lie outside the image."""
    counts, size = outcome.counts, outcome.image_size
    if size is None:
        return {}
    outside = sum(counts.get(key, 0) for key in _OUTSIDE)
    return watch.complaint(outside, counts.get('detections_received', 0), size)


def _crops_wanted(outputs: Outputs) -> tuple[bool, bool]:
    """Ask whether anybody wants crop sources, and crop regions."""
    return bool(outputs.crop_sources.wanted()), bool(outputs.crop_regions.wanted())


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
