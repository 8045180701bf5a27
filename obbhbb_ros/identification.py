# SPDX-License-Identifier: Apache-2.0
"""
What `ship_tracker` does to a message: bytes and settings in, bytes and counts out, without ROS.

    identifier = ShipIdentifier()
    outcome = identifier.answer(data, INPUT_TYPES['Detection2DArray'], settings, camera, outputs)
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import NamedTuple
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from obbhbb_ros.downlink.cameras import CameraChoice
from obbhbb_ros.earth.pose_source import PoseSource
from obbhbb_ros.earth.reprojection import Viewpoint
from obbhbb_ros.geometry.boxes import FloatArray
from obbhbb_ros.geometry.boxes import OrientedBoxes
from obbhbb_ros.pipeline import NOBODY
from obbhbb_ros.pipeline import ConversionOutcome
from obbhbb_ros.pipeline import Output
from obbhbb_ros.pipeline import camera_doubt
from obbhbb_ros.pipeline import known_image_size
from obbhbb_ros.pipeline import no_size_complaint
from obbhbb_ros.placing import PlacedShips
from obbhbb_ros.placing import ShipPlacer
from obbhbb_ros.reports.seen_ships import ShipCollector
from obbhbb_ros.settings.ship_tracker import TrackerSettings
from obbhbb_ros.tracking.matcher import ShipMatcher
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
    """The topics for the answers to a message."""

    tracked: Output
    positions: Output = NOBODY
    image_pose: Output = NOBODY

    def wanted(self) -> bool:
        """Return whether anybody wants one of them."""
        return any(output.wanted() for output in self)


Finding: TypeAlias = tuple[dict[str, int], dict[str, str]]
"""Counts by key of the diagnostics, and complaints by kind."""


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
        self._placer = None if poses is None else ShipPlacer(poses)
        self._matcher = ShipMatcher()
        self._watch = IdWatch()
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
    ) -> ConversionOutcome:
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
        ConversionOutcome
            What became of it. If no answer is wanted, and no list, the message is not read.

        Raises
        ------
        obbhbb_ros.wire.buffer.WireError
            If the bytes are no such message.
        """
        if self._collector is None and not outputs.wanted():
            return ConversionOutcome({'messages_without_subscriber': 1}, {})
        detections = Detections(data, input_type)
        image_size, used = known_image_size(settings.image_size, camera)
        boxes = _image_boxes(detections, settings, image_size)
        placed = self._placed(detections.stamp, boxes, settings, camera if image_size else None)
        rows = np.arange(len(detections))
        if placed is not None and settings.place is not None:
            rows = np.flatnonzero(placed.within(settings.place.lengths))
        own = detections.ids()
        passed = [own[row] for row in rows.tolist()]
        ids = passed if settings.keeps_ids else [''] * len(passed)
        findings = [
            ({'detections_received': len(own), 'ids_kept': sum(map(bool, ids))}, {}),
            (used, {}),
            _placing(placed, len(own) - len(rows)),
            self._id_doubts(ids),
            self._stamp_doubt(detections.stamp),
            camera_doubt(detections.frame_id, camera if used else None),
        ]
        if image_size is None:
            no_size = no_size_complaint(['ships get no ids'])
            findings.append(({'messages_without_image_size': 1}, no_size))
        elif not ids or not all(ids):
            passed_boxes = boxes[rows]
            numbers = self._numbers(
                detections.stamp, passed_boxes, settings.memory, image_size, self._carry(placed)
            )
            findings.append(_untracked(ids, numbers, passed_boxes.valid, detections.stamp))
            ids = self._filled(ids, numbers)
        if placed is not None:
            # First, so that they arrive before the chips are cut.
            _publish_places(placed, detections, ids, rows, outputs)
            findings.append(self._collected(placed, detections, boxes, ids, rows, image_size))
        outputs.tracked.publish(_with_ids(detections, own, ids, rows, settings))
        counts: dict[str, int] = {}
        complaints: dict[str, str] = {}
        for counted, texts in findings:
            counts |= counted
            complaints |= texts
        return ConversionOutcome(counts, complaints, image_size)

    def _placed(
        self,
        stamp: Stamp,
        boxes: OrientedBoxes,
        settings: TrackerSettings,
        camera: CameraChoice[WireCamera] | None,
    ) -> PlacedShips | None:
        """Place the ships of an image on Earth; None if that is not asked for."""
        if self._placer is None or settings.place is None:
            return None
        known = None if camera is None else camera.camera
        return self._placer.place(boxes, stamp, known, settings.place)

    def _collected(
        self,
        placed: PlacedShips,
        detections: Detections,
        boxes: OrientedBoxes,
        ids: Sequence[str],
        rows: NDArray[np.intp],
        image_size: tuple[int, int] | None,
    ) -> Finding:
        """Note the ships of an image for the next list, and count those that are not in it."""
        if self._collector is None or image_size is None:
            return {}, {}
        classes = detections.class_ids()
        corners = boxes[rows].corners
        inside = (corners > 1.0) & (corners < np.array(image_size) - 1.0)
        whole: NDArray[np.bool_] = np.asarray(inside.all(axis=(1, 2)))
        unlisted = self._collector.note(
            nanoseconds_of(detections.stamp),
            ids,
            [classes[row] for row in rows.tolist()],
            detections.scores()[rows],
            whole,
            placed.placement[rows],
        )
        return ({'ships_unlisted': unlisted}, {}) if unlisted else ({}, {})

    def _filled(self, ids: Sequence[str], numbers: NDArray[np.int64]) -> list[str]:
        """Give ids to detections without one, by their numbers."""
        return [
            own or (tracker_id(self.session, number) if number >= 0 else '')
            for own, number in zip(ids, numbers.tolist(), strict=True)
        ]

    def _numbers(
        self,
        stamp: Stamp,
        boxes: OrientedBoxes,
        memory: float,
        image_size: tuple[int, int],
        carry: Carry | None,
    ) -> NDArray[np.int64]:
        """Follow the boxes of an image; -1 for those that are not followed."""
        self._matcher.memory = memory
        valid, numbers = boxes.valid, np.full(len(boxes), -1, np.int64)
        x, y = boxes.center[valid].T
        numbers[valid] = self._matcher.track(
            nanoseconds_of(stamp) / 1e9,
            x + 1j * y,
            boxes.length[valid],
            boxes.theta[valid],
            complex(*image_size),
            carry,
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
        return (
            {doubt.key: doubt.detections for doubt in doubts},
            {doubt.key: doubt.text for doubt in doubts},
        )

    def _stamp_doubt(self, stamp: Stamp) -> Finding:
        """Count and report a stamp that is not later than the last one."""
        last, self._stamp = self._stamp, stamp
        if last is None or stamp > last:
            return {}, {}
        text = (
            f'a message has the stamp {stamp_text(stamp)}, the one before it '
            f'{stamp_text(last)}: the node follows ships by stamps, which must increase'
        )
        return {'stamps_not_later': 1}, {'stamps': text}


def _untracked(
    ids: Sequence[str], numbers: NDArray[np.int64], valid: NDArray[np.bool_], stamp: Stamp
) -> Finding:
    """Count the detections without own id that get one, and those that do not, by reason."""
    without = np.array([not own for own in ids], np.bool_)
    untracked = without & (numbers < 0)
    found = {
        'ids_assigned': without & ~untracked,
        'detections_untracked.invalid': untracked & ~valid,
        'detections_untracked.not_followed': untracked & valid,
    }
    counts = {key: int(rows.sum()) for key, rows in found.items() if rows.any()}
    if not untracked.any():
        return counts, {}
    text = (
        f'{np.count_nonzero(untracked)} of {len(ids)} detections at stamp {stamp_text(stamp)} get '
        f'no id: index {untracked.argmax()} is '
        f'{"not followed" if valid[untracked.argmax()] else "invalid"}'
    )
    return counts, {'untracked': text}


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


def _placing(placed: PlacedShips | None, left_out: int) -> Finding:
    """Count the ships without a place, and those of another length."""
    if placed is None:
        return {}, {}
    counts = dict(placed.counts)
    if left_out:
        counts['detections_left_out.length'] = left_out
    return counts, placed.complaints


def _publish_places(
    placed: PlacedShips,
    detections: Detections,
    ids: Sequence[str],
    rows: NDArray[np.intp],
    outputs: TrackerOutputs,
) -> None:
    """Publish where ships are, and the pose of the image."""
    if outputs.image_pose.wanted() and (pose := placed.pose_message()):
        outputs.image_pose.publish(pose)
    if outputs.positions.wanted():
        outputs.positions.publish(placed.message(detections, ids, rows))


def _with_ids(
    detections: Detections,
    own: Sequence[str],
    ids: Sequence[str],
    rows: NDArray[np.intp],
    settings: TrackerSettings,
) -> bytes:
    """Write a message of some detections with ids; of polygons, with their boxes."""
    if detections.polygons is not None:
        return detections.with_ids(ids, _boxes_of_polygons(detections, settings), rows)
    if ids == own:
        # This keeps ids that are not UTF-8.
        none = np.zeros(len(own), np.bool_)
        return detections.rewrite(np.zeros((len(own), 4)), none)
    return detections.with_ids(ids, rows=rows)


def _boxes_of_polygons(detections: Detections, settings: TrackerSettings) -> FloatArray:
    """Return the boxes of polygons as a detector would send them; (N, 5)."""
    boxes = _image_boxes(detections, settings, None)
    theta = boxes.theta / settings.input_frame.theta_scale
    return np.column_stack((boxes.center, boxes.length, boxes.width, theta))
