# SPDX-License-Identifier: Apache-2.0
"""Crop plans, read from the bytes of `vision_msgs/Detection2DArray`: what to cut, and why."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from obbhbb_ros.wire.detections import ID_SEPARATOR
from obbhbb_ros.wire.detections import Detections
from obbhbb_ros.wire.stamp import Stamp
from obbhbb_ros.wire.writing import header_bytes

# Beyond any image, and still exact as a number of pixels.
_MAX_COORDINATE = 2.0**52


class Source(NamedTuple):
    """
    The detection that a crop region was planned for.

    Attributes
    ----------
    id : str
        Its id; the most valuable one, where there are several in the region.
    value : float
        Value of the region; 0 if it has none.
    obb : tuple of float
        Its centre x and y, length and width (pixels), theta (radians).
    """

    id: str
    value: float
    obb: tuple[float, ...]


class WirePlan:
    """
    A message on `crop_regions`.

    Parameters
    ----------
    data : bytes
        A serialized `vision_msgs/Detection2DArray`.

    Attributes
    ----------
    stamp : Stamp
        The header's stamp.
    frame_id : str
        The header's frame; bytes that are not UTF-8 are escaped.
    regions : list of tuple of int
        x0, y0, x1, y1, rounded outwards to whole pixels; all 0 for a box that is not finite.
    class_ids : list of str
        Class of the best hypothesis of each region, empty if there is none.
    scores : list of float or None
        Score of the best hypothesis, None if it is not finite or there is none.

    Raises
    ------
    obbhbb_ros.wire.buffer.WireError
        If the bytes are no such message.
    """

    def __init__(self, data: bytes) -> None:
        self._detections = detections = Detections(data)
        self.stamp, self.frame_id = detections.stamp, detections.frame_id
        xywhr = detections.xywhr()
        # NumPy warns of what is not finite.
        with np.errstate(invalid='ignore', over='ignore'):
            center, half = xywhr[:, :2], xywhr[:, 2:4] / 2.0
            corners = np.hstack((np.floor(center - half), np.ceil(center + half)))
        corners[~np.isfinite(corners).all(axis=1)] = 0.0
        rows = np.clip(corners, -_MAX_COORDINATE, _MAX_COORDINATE).astype(np.int64).tolist()
        self.regions = [(x0, y0, x1, y1) for x0, y0, x1, y1 in rows]
        self.class_ids = detections.class_ids()
        self.scores = [
            score if math.isfinite(score) else None for score in detections.scores().tolist()
        ]

    def __len__(self) -> int:
        """Count the regions."""
        return len(self.regions)

    def detection_ids(self) -> list[list[str]]:
        """List the ids of the detections in each region; a detection without id has none."""
        return [text.split(ID_SEPARATOR) if text else [] for text in self._detections.ids()]

    def has_sources(self, sources: Sequence[Source]) -> bool:
        """Return whether sources belong to the regions: as many, with the same ids."""
        ids = self._detections.ids()
        return len(sources) == len(ids) and all(
            region == source.id or region.startswith(source.id + ID_SEPARATOR)
            for region, source in zip(ids, sources, strict=True)
        )

    def alone(self, row: int, stamp: Stamp, image_stamp: Stamp, frame_id: str) -> bytes:
        """
        Write a message with the detection of one region; the detection gets the image's header.

        Parameters
        ----------
        row : int
            Which region.
        stamp, image_stamp : Stamp
            Stamps of the message and of the image.
        frame_id : str
            Frame id of both.

        Returns
        -------
        bytes
            A serialized `vision_msgs/Detection2DArray`.
        """
        return self._detections.alone(
            row, header_bytes(stamp, frame_id), header_bytes(image_stamp, frame_id)
        )


def read_sources(data: bytes) -> tuple[Stamp, list[Source]]:
    """
    Read a message on `crop_sources`.

    Parameters
    ----------
    data : bytes
        A serialized `vision_msgs/Detection2DArray`.

    Returns
    -------
    stamp : Stamp
        The header's stamp.
    sources : list of Source
        One for each region of the plan of the same stamp, in its order.

    Raises
    ------
    obbhbb_ros.wire.buffer.WireError
        If the bytes are no such message.
    """
    detections = Detections(data)
    values = np.nan_to_num(detections.scores(), nan=0.0, posinf=0.0, neginf=0.0).tolist()
    boxes = detections.xywhr().tolist()
    return detections.stamp, [
        Source(detection_id, value, tuple(box))
        for detection_id, value, box in zip(detections.ids(), values, boxes, strict=True)
    ]
