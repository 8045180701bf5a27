# SPDX-License-Identifier: Apache-2.0
"""
One input message as the node sees it, whichever way it was read.

`WireFrame` works on the message's bytes, `TypedFrame` on message objects: it takes what the other
declines, and is the reference that tests hold it against. Both write the same bytes.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any
from typing import Protocol

import numpy as np
from rclpy.serialization import deserialize_message
from rclpy.serialization import serialize_message
from vision_msgs.msg import Detection2DArray

from obbhbb_ros.boxes import FEW
from obbhbb_ros.boxes import FloatArray
from obbhbb_ros.boxes import OrientedBoxes
from obbhbb_ros.downlink.crops import CropPlan
from obbhbb_ros.nodes import messages
from obbhbb_ros.wire import Detections
from obbhbb_ros.wire import Forms
from obbhbb_ros.wire import canonical


class Frame(Protocol):
    """What the node asks of an input message."""

    @property
    def stamp(self) -> tuple[int, int]:
        """Seconds and nanoseconds of the message's stamp."""

    def boxes(self, theta_scale: float) -> OrientedBoxes:
        """Read the N oriented boxes; `theta_scale` turns the input's angles into radians."""

    def few_boxes(self, theta_scale: float) -> list[Sequence[float]] | None:
        """Read the boxes of a message that has but a few, rows of xywhr; None if it has more."""

    def class_ids(self) -> list[str]:
        """Read the class of each detection's best hypothesis."""

    def scores(self) -> FloatArray:
        """Read the score of each detection's best hypothesis, NaN where there is none; (N,)."""

    def boxes_message(
        self, boxes: OrientedBoxes, extents: FloatArray, keep_invalid: bool
    ) -> bytes:
        """Write the message with axis-aligned boxes; a NaN extent keeps or drops its detection."""

    def few_boxes_message(self, extents: Sequence[tuple[float, float]]) -> bytes:
        """Write the message with axis-aligned boxes of half-extents, for `few_boxes`."""

    def crops_message(self, plan: CropPlan) -> bytes:
        """Write a crop plan with the ids and hypotheses of its detections."""


class WireFrame:
    """
    A `Detection2DArray` in its bytes.

    Parameters
    ----------
    data : bytes
        The serialized message.
    forms : Forms
        Memory of the forms of detection in earlier messages.

    Raises
    ------
    obbhbb_ros.wire.NotPlainCdrError
        If the bytes want the typed path.
    obbhbb_ros.wire.WireError
        If they cannot be read at all.
    """

    def __init__(self, data: bytes, forms: Forms) -> None:
        self._detections = Detections(data, forms)
        self._hypotheses: Any = None

    @property
    def stamp(self) -> tuple[int, int]:
        """See `Frame`."""
        return self._detections.stamp

    def boxes(self, theta_scale: float) -> OrientedBoxes:
        """See `Frame`."""
        xywhr = self._detections.xywhr()
        if theta_scale != 1.0:
            xywhr[:, 4] *= theta_scale
        return OrientedBoxes.from_xywhr(xywhr)

    def few_boxes(self, theta_scale: float) -> list[Sequence[float]] | None:
        """See `Frame`."""
        return _scaled(self._detections.few_boxes(), theta_scale)

    def class_ids(self) -> list[str]:
        """See `Frame`."""
        return self._detections.class_ids(self._best()[0])

    def scores(self) -> FloatArray:
        """See `Frame`."""
        scores: FloatArray = self._best()[1]
        return scores

    def boxes_message(
        self, boxes: OrientedBoxes, extents: FloatArray, keep_invalid: bool
    ) -> bytes:
        """See `Frame`."""
        if boxes.tame:
            return self._detections.rewrite(extents)
        valid = np.isfinite(extents[0])
        if keep_invalid or valid.all():
            return self._detections.rewrite(extents, valid)
        xywh = np.concatenate((boxes.center, 2.0 * extents)).T
        return self._detections.selected(np.flatnonzero(valid), xywh[valid])

    def few_boxes_message(self, extents: Sequence[tuple[float, float]]) -> bytes:
        """See `Frame`."""
        return self._detections.rewrite_few(extents)

    def crops_message(self, plan: CropPlan) -> bytes:
        """See `Frame`."""
        boxes = messages.region_boxes(plan)
        if plan.merged:
            return self._detections.joined(plan.groups(), boxes)
        return self._detections.selected(plan.sources, boxes)

    def _best(self) -> Any:
        """Find the best hypotheses once."""
        if self._hypotheses is None:
            self._hypotheses = self._detections.best_hypotheses()
        return self._hypotheses


class TypedFrame:
    """
    A message of any input type, by way of message objects.

    Parameters
    ----------
    data : bytes
        The serialized message.
    message_type : type
        Its class.

    Raises
    ------
    Exception
        Whatever the middleware raises on bytes that are no such message.
    """

    def __init__(self, data: bytes, message_type: Any) -> None:
        message = deserialize_message(data, message_type)
        self._polygons = None
        if message_type is not Detection2DArray:
            self._polygons = message
            message = messages.detections_from(message)
        self._message = message
        self._hypotheses: Any = None

    @property
    def stamp(self) -> tuple[int, int]:
        """See `Frame`."""
        stamp = self._message.header.stamp
        return stamp.sec, stamp.nanosec

    def boxes(self, theta_scale: float) -> OrientedBoxes:
        """See `Frame`."""
        if self._polygons is not None:
            return messages.boxes_of_polygons(self._polygons)
        return messages.boxes_of_detections(self._message, theta_scale)

    def few_boxes(self, theta_scale: float) -> list[Sequence[float]] | None:
        """See `Frame`."""
        if self._polygons is not None or len(self._message.detections) >= FEW:
            return None
        return _scaled(messages.xywhr_of(self._message).tolist(), theta_scale)

    def class_ids(self) -> list[str]:
        """See `Frame`."""
        class_ids: list[str] = self._best()[0]
        return class_ids

    def scores(self) -> FloatArray:
        """See `Frame`."""
        scores: FloatArray = self._best()[1]
        return scores

    def boxes_message(
        self, boxes: OrientedBoxes, extents: FloatArray, keep_invalid: bool
    ) -> bytes:
        """See `Frame`."""
        message = messages.boxes_message(self._message, boxes.center, extents, keep_invalid)
        return canonical(serialize_message(message))

    def few_boxes_message(self, extents: Sequence[tuple[float, float]]) -> bytes:
        """See `Frame`."""
        center = messages.xywhr_of(self._message)[:, :2].T
        columns = np.array(extents, np.float64).reshape(-1, 2).T
        message = messages.boxes_message(self._message, center, columns, True)
        return canonical(serialize_message(message))

    def crops_message(self, plan: CropPlan) -> bytes:
        """See `Frame`."""
        return canonical(serialize_message(messages.crop_message(self._message, plan)))

    def _best(self) -> Any:
        """Find the best hypotheses once."""
        if self._hypotheses is None:
            self._hypotheses = messages.best_hypotheses(self._message)
        return self._hypotheses


def _scaled(
    rows: list[Sequence[float]] | None, theta_scale: float
) -> list[Sequence[float]] | None:
    """Turn the angles of some rows of xywhr into radians."""
    if rows is None or theta_scale == 1.0:
        return rows
    return [(x, y, width, height, theta * theta_scale) for x, y, width, height, theta in rows]
