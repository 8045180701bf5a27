# SPDX-License-Identifier: Apache-2.0
"""What the spool and the ground know of a chip."""

from __future__ import annotations

import math
from collections.abc import Sequence

from obbhbb_ros.downlink.chips import Chip
from obbhbb_ros.spool.spool import NewChip
from obbhbb_ros.wire.image import WireImage
from obbhbb_ros.wire.plans import Source
from obbhbb_ros.wire.plans import WirePlan


class Recorder:
    """
    Describes the chips of a frame for the spool.

    Parameters
    ----------
    image : WireImage
        The image they are cut from.
    plan : WirePlan
        The plan they are cut by.
    sources : sequence of Source
        Where each region of the plan comes from; empty if that is not known, and then the score is
        the value.
    codec : str
        Name of the codec.
    camera_matrix : sequence of float
        K of the camera, 9 numbers row by row; zeros if it is not known.
    """

    def __init__(
        self,
        image: WireImage,
        plan: WirePlan,
        sources: Sequence[Source],
        codec: str,
        camera_matrix: Sequence[float],
    ) -> None:
        self._stamp, self._plan, self._sources = image.stamp, plan, sources
        self._ids = plan.detection_ids()
        self._common = {
            'frame_id': image.frame_id,
            'image_size': [image.width, image.height],
            'codec': codec,
            'camera_matrix': _finite(camera_matrix if any(camera_matrix) else ()),
        }

    def record(self, chip: Chip) -> NewChip:
        """Describe a chip."""
        x0, y0, x1, y1 = chip.region
        score, class_id = self._plan.scores[chip.index], self._plan.class_ids[chip.index]
        source = self._sources[chip.index] if self._sources else Source('', score or 0.0, ())
        facts = {
            'roi': [x0, y0, x1 - x0, y1 - y0],
            'score': score,
            'detection_ids': self._ids[chip.index],
            'obb': _finite(source.obb),
            **self._common,
        }
        return NewChip(source.value, class_id, self._stamp, facts, chip.data)


def _finite(numbers: Sequence[float]) -> list[float] | None:
    """List numbers; None if there are none, or some that JSON does not have."""
    return list(numbers) if numbers and all(map(math.isfinite, numbers)) else None
