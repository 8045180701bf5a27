# SPDX-License-Identifier: Apache-2.0
"""
What `ship_tracker` does to a message: bytes and settings in, bytes and counts out, without ROS.

    identifier = ShipIdentifier()
    outcome = identifier.answer(data, INPUT_TYPES['Detection2DArray'], settings, camera, outputs)
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from obbhbb_ros.downlink.cameras import CameraChoice
from obbhbb_ros.earth.pose_source import PoseSource
from obbhbb_ros.earth.reprojection import Viewpoint
from obbhbb_ros.geometry.boxes import FloatArray
from obbhbb_ros.geometry.boxes import OrientedBoxes
from obbhbb_ros.pipeline.image_size import camera_doubt
from obbhbb_ros.pipeline.image_size import known_image_size
from obbhbb_ros.pipeline.image_size import no_size_complaint
from obbhbb_ros.pipeline.outcome import NOBODY
from obbhbb_ros.pipeline.outcome import OTHER_POSE
from obbhbb_ros.pipeline.outcome import Finding
from obbhbb_ros.pipeline.outcome import Outcome
from obbhbb_ros.pipeline.outcome import Output
from obbhbb_ros.pipeline.placing import PlacedShips
from obbhbb_ros.pipeline.placing import ShipPlacer
from obbhbb_ros.pipeline.plausibility import OutsideWatch
from obbhbb_ros.pipeline.plausibility import angle_findings
from obbhbb_ros.pipeline.plausibility import frames_text
from obbhbb_ros.reports.seen_ships import ShipCollector
from obbhbb_ros.settings.ship_tracker import TrackerSettings
from obbhbb_ros.tracking.matcher import ShipMatcher
from obbhbb_ros.tracking.object_ids import ObjectIds
from obbhbb_ros.tracking.sightings import Carry
from obbhbb_ros.tracking.sightings import Places
from obbhbb_ros.tracking.track_ids import IdWatch
from obbhbb_ros.tracking.track_ids import new_session
from obbhbb_ros.tracking.track_ids import tracker_id
from obbhbb_ros.wire.camera import WireCamera
from obbhbb_ros.wire.detections import Detections
from obbhbb_ros.wire.layouts import InputType
from obbhbb_ros.wire.stamp import Stamp
from obbhbb_ros.wire.stamp import nanoseconds_of
from obbhbb_ros.wire.stamp import stamp_text


class TrackerOutputs(NamedTuple):
    """The topics for the answers of `ship_tracker`."""

    tracked: Output
    positions: Output = NOBODY
    image_pose: Output = NOBODY

    def wanted(self) -> bool:
        """Return whether anybody wants one of them."""
        return any(output.wanted() for output in self)


@dataclass(frozen=True, eq=False)
class TrackedImage:
    """
    The detections of an image, and which of them are passed on.

    Attributes
    ----------
    detections : Detections
        The message.
    own_ids : list of str
        The ids of all its detections.
    boxes : OrientedBoxes
        All its boxes, pixels of the image.
    placed : PlacedShips or None
        Where they are, if that is asked for.
    rows : ndarray of int, shape (M,)
        The detections that are passed on.
    size : tuple of int or None
        Width and height of the image, if they are known.
    """

    detections: Detections
    own_ids: list[str]
    boxes: OrientedBoxes
    placed: PlacedShips | None
    rows: NDArray[np.intp]
    size: tuple[int, int] | None

    @property
    def stamp(self) -> Stamp:
        """Stamp of the image."""
        return self.detections.stamp

    @cached_property
    def passed_boxes(self) -> OrientedBoxes:
        """The boxes that are passed on."""
        return self.boxes[self.rows]

    def passed(self, texts: Sequence[str]) -> list[str]:
        """Choose the texts of the detections that are passed on."""
        return [texts[row] for row in self.rows.tolist()]

    def count_outside(self, size: tuple[int, int]) -> int:
        """Count the boxes of which no part is in the image of a size."""
        reach = self.boxes.length[:, None] / 2
        with np.errstate(invalid='ignore'):
            outside = (self.boxes.center < -reach) | (self.boxes.center > np.array(size) + reach)
        return int(outside.any(axis=1).sum())

    def are_whole(self) -> NDArray[np.bool_]:
        """Tell which ships that are passed on lie inside the image, as far as its size is known."""
        corners = self.passed_boxes.corners
        inside = (corners > 1.0) & (corners < np.array(self.size or (0, 0)) - 1.0)
        whole: NDArray[np.bool_] = np.asarray(inside.all(axis=(1, 2)))
        return whole


class ShipIdentifier:
    """
    Gives the detections of message after message the ids of ships.

    Parameters
    ----------
    poses : PoseSource, optional
        Knows where the camera is; needed where the settings say how to place ships.
    collector : ShipCollector, optional
        Takes note of the ships that have a place.

    Attributes
    ----------
    session : str
        First half of the ids that it gives; every object of this class draws its own at random.
    """

    def __init__(
        self, poses: PoseSource | None = None, collector: ShipCollector | None = None
    ) -> None:
        self.session = new_session()
        self._collector = collector
        self._poses = poses
        self._placer = None if poses is None else ShipPlacer(poses)
        self._matcher = ShipMatcher()
        self._watch = IdWatch()
        self._outside = OutsideWatch()
        self._objects = ObjectIds()
        self._stamp: Stamp | None = None
        # Of the last image whose boxes were followed.
        self._viewpoint: Viewpoint | None = None

    @property
    def ships_remembered(self) -> int:
        """How many ships are remembered."""
        return self._matcher.object_count

    def answer(
        self,
        data: bytes,
        input_type: InputType,
        settings: TrackerSettings,
        camera: CameraChoice[WireCamera] | None,
        outputs: TrackerOutputs,
    ) -> Outcome:
        """
        Publish a message with ids, and where its ships are, if anybody wants it.

        Parameters
        ----------
        data : bytes
            The serialized message.
        input_type : InputType
            Its type.
        settings : TrackerSettings
            The settings.
        camera : CameraChoice of WireCamera, optional
            The camera of the image, by its stamp or the latest. It gives the size of the image
            where the settings do not, and places need it.
        outputs : TrackerOutputs
            Where the answers go.

        Returns
        -------
        Outcome
            What became of it. If no answer is wanted, and no list, the message is not read.

        Raises
        ------
        obbhbb_ros.wire.buffer.WireError
            If the bytes are no such message.
        """
        if self._collector is None and not outputs.wanted():
            return Outcome({'messages_without_subscriber': 1}, {})
        detections = Detections(data, input_type)
        size, used = known_image_size(settings.image_size, camera)
        image = self._image(detections, settings, camera, size)
        ids, tracked = self._tracked(image, settings)
        if image.placed is not None:
            # First, so that they arrive before the chips are cut.
            _publish_places(image.placed, image, ids, outputs)
        outputs.tracked.publish(_with_ids(image, ids, settings))
        findings = (
            Finding({'detections_received': len(detections)}),
            Finding(used),
            _placing(image),
            *angle_findings(detections.xywhr()[:, 4], settings.input_frame, image.stamp),
            self._outside_doubt(image),
            self._stamp_doubt(image.stamp),
            camera_doubt(detections.frame_id, camera if used or image.placed else None),
            self._pose_doubt(detections.frame_id),
            *tracked,
            self._collected(image, ids),
        )
        return Outcome.of(findings, size)

    def _image(
        self,
        detections: Detections,
        settings: TrackerSettings,
        camera: CameraChoice[WireCamera] | None,
        size: tuple[int, int] | None,
    ) -> TrackedImage:
        """Place the ships of an image, where that is asked for, and choose those to pass on."""
        boxes, rows = _image_boxes(detections, settings, size), np.arange(len(detections))
        own_ids, placed = detections.ids(), None
        if self._placer is not None and settings.place is not None:
            known = camera.camera if camera and size else None
            placed = self._placer.place(boxes, detections.stamp, known, size, settings.place)
            rows = np.flatnonzero(placed.within(settings.place.lengths))
        return TrackedImage(detections, own_ids, boxes, placed, rows, size)

    def _tracked(
        self, image: TrackedImage, settings: TrackerSettings
    ) -> tuple[list[str], list[Finding]]:
        """Return the ids of the detections that are passed on: their own, or those of ships."""
        ids = image.passed(image.own_ids)
        if not settings.keeps_ids:
            ids = [''] * len(ids)
        findings = [Finding({'ids_kept': sum(map(bool, ids))}), self._id_doubts(ids)]
        if image.size is None:
            no_size = no_size_complaint(['ships get no ids'])
            findings.append(Finding({'messages_without_image_size': 1}, no_size))
        elif not ids or not all(ids):
            numbers = self._numbers(image, image.size, settings.memory)
            findings.append(_untracked(ids, numbers, image))
            ids = self._filled(ids, numbers)
        return ids, findings

    def _collected(self, image: TrackedImage, ids: Sequence[str]) -> Finding:
        """Note the ships of an image for the next list, and count those that are not in it."""
        if self._collector is None or image.placed is None or image.size is None:
            return Finding({})
        unlisted = self._collector.note(
            nanoseconds_of(image.stamp),
            self._objects.name(ids, time.monotonic()),
            image.passed(image.detections.class_ids()),
            image.detections.scores()[image.rows],
            image.are_whole(),
            image.placed.placement[image.rows],
        )
        return Finding({'ships_unlisted': unlisted} if unlisted else {})

    def _filled(self, ids: Sequence[str], numbers: NDArray[np.int64]) -> list[str]:
        """Give ids to detections without one, by their numbers."""
        return [
            own or (tracker_id(self.session, number) if number >= 0 else '')
            for own, number in zip(ids, numbers.tolist(), strict=True)
        ]

    def _numbers(
        self, image: TrackedImage, size: tuple[int, int], memory: float
    ) -> NDArray[np.int64]:
        """Follow the boxes of an image; -1 for those that are not followed."""
        self._matcher.memory = memory
        boxes = image.passed_boxes
        valid, numbers = boxes.valid, np.full(len(boxes), -1, np.int64)
        x, y = boxes.center[valid].T
        numbers[valid] = self._matcher.track(
            nanoseconds_of(image.stamp) / 1e9,
            x + 1j * y,
            boxes.length[valid],
            boxes.theta[valid],
            complex(*size),
            self._carry(image.placed),
        )
        return numbers

    def _carry(self, placed: PlacedShips | None) -> Carry | None:
        """Return how the image moved since the last one that was followed, if poses say so."""
        before, self._viewpoint = self._viewpoint, None if placed is None else placed.viewpoint
        if before is None or self._viewpoint is None:
            return None
        return partial(_carried, before, self._viewpoint)

    def _id_doubts(self, ids: Sequence[str]) -> Finding:
        """Count and report ids that are not those of tracks."""
        doubts = [*self._watch.note(ids)]
        return Finding(
            {doubt.key: doubt.detections for doubt in doubts},
            {doubt.key: doubt.text for doubt in doubts},
        )

    def _outside_doubt(self, image: TrackedImage) -> Finding:
        """Count the boxes that lie outside the image, and complain if most of them do."""
        if image.size is None:
            return Finding({})
        count, total = image.count_outside(image.size), len(image.boxes)
        counts = {'detections_outside_image': count} if count else {}
        return Finding(counts, self._outside.complaint(count, total, image.size))

    def _pose_doubt(self, frame_id: str) -> Finding:
        """Count and report detections of another frame than that whose pose is told."""
        told = '' if self._poses is None else self._poses.frame_id
        advice = "the pose has to be that of the camera's optical frame"
        text = frames_text(('detections', frame_id), ('a pose', told), advice)
        if not text:
            return Finding({})
        return Finding({'frame_ids_differ.camera_pose': 1}, {OTHER_POSE: text})

    def _stamp_doubt(self, stamp: Stamp) -> Finding:
        """Count and report a stamp that is not later than the last one."""
        last, self._stamp = self._stamp, stamp
        if last is None or stamp > last:
            return Finding({})
        text = (
            f'a message has the stamp {stamp_text(stamp)}, the one before it '
            f'{stamp_text(last)}: the node follows ships by stamps, which must increase'
        )
        return Finding({'stamps_not_later': 1}, {'stamps': text})


def _untracked(ids: Sequence[str], numbers: NDArray[np.int64], image: TrackedImage) -> Finding:
    """Count the detections without own id that get one, and those that do not, by reason."""
    valid, without = image.passed_boxes.valid, np.array([not own for own in ids], np.bool_)
    untracked = without & (numbers < 0)
    reasons = {
        'ids_assigned': without & ~untracked,
        'detections_untracked.invalid': untracked & ~valid,
        'detections_untracked.not_followed': untracked & valid,
    }
    counts = {key: int(rows.sum()) for key, rows in reasons.items() if rows.any()}
    if not untracked.any():
        return Finding(counts)
    first = int(untracked.argmax())
    text = (
        f'{np.count_nonzero(untracked)} of {len(ids)} detections at stamp '
        f'{stamp_text(image.stamp)} get no id: index {image.rows[first]} is '
        f'{"not followed" if valid[first] else "invalid"}'
    )
    return Finding(counts, {'untracked': text})


def _image_boxes(
    detections: Detections, settings: TrackerSettings, image_size: tuple[int, int] | None
) -> OrientedBoxes:
    """Return the boxes in pixels of the image, if its size is known."""
    return settings.input_frame.oriented_boxes(
        detections.xywhr(), detections.polygons, image_size, bow=settings.has_bow
    )


def _carried(before: Viewpoint, after: Viewpoint, places: Places) -> Places:
    """Carry places from the last image to this one."""
    x, y = before.pixels_in(after, np.stack((places.real, places.imag), axis=-1)).T
    carried: Places = x + 1j * y
    return carried


def _placing(image: TrackedImage) -> Finding:
    """Count the ships without a place, and those of another length."""
    if image.placed is None:
        return Finding({})
    counts, complaints = image.placed.finding
    if left_out := len(image.detections) - len(image.rows):
        counts = {**counts, 'detections_left_out.length': left_out}
    return Finding(counts, complaints)


def _publish_places(
    placed: PlacedShips, image: TrackedImage, ids: Sequence[str], outputs: TrackerOutputs
) -> None:
    """Publish where ships are, and the pose of the image."""
    if outputs.image_pose.wanted() and (pose := placed.pose_message()):
        outputs.image_pose.publish(pose)
    if outputs.positions.wanted():
        outputs.positions.publish(placed.message(image.detections, ids, image.rows))


def _with_ids(image: TrackedImage, ids: Sequence[str], settings: TrackerSettings) -> bytes:
    """Write a message of the detections that are passed on, with ids; of polygons, their boxes."""
    detections = image.detections
    if detections.polygons is not None:
        return detections.with_ids(ids, _boxes_of_polygons(detections, settings), image.rows)
    if ids == image.own_ids:
        # This keeps ids that are not UTF-8.
        none = np.zeros(len(ids), np.bool_)
        return detections.rewrite(np.zeros((len(ids), 4)), none)
    return detections.with_ids(ids, rows=image.rows)


def _boxes_of_polygons(detections: Detections, settings: TrackerSettings) -> FloatArray:
    """Return the boxes of polygons as a detector would send them; (N, 5)."""
    boxes = _image_boxes(detections, settings, None)
    theta = boxes.theta / settings.input_frame.theta_scale
    return np.column_stack((boxes.center, boxes.length, boxes.width, theta))
