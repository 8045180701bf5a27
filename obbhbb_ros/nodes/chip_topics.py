# SPDX-License-Identifier: Apache-2.0
"""The topics of a chip: file, place and identity, under a stamp that no other chip has."""

from __future__ import annotations

from array import array
from copy import copy
from typing import Any

from builtin_interfaces.msg import Time
from sensor_msgs.msg import CameraInfo
from sensor_msgs.msg import CompressedImage
from std_msgs.msg import Header
from vision_msgs.msg import Detection2DArray

from obbhbb_ros.downlink.chips import Chip
from obbhbb_ros.downlink.chips import format_text
from obbhbb_ros.downlink.stamps import ChipStamps
from obbhbb_ros.nodes.camera import region_of_interest
from obbhbb_ros.wire.image import WireImage
from obbhbb_ros.wire.plans import WirePlan

# A frame's chips go out at once: those behind a large one would push it out of a short queue
# before its last piece is sent.
_KEPT = 1000


class ChipTopics:
    """
    Publishers of chips.

    Parameters
    ----------
    create : callable
        Creates a publisher, given message type, topic and depth.
    stamps : ChipStamps
        Gives out the stamps.
    """

    def __init__(self, create: Any, stamps: ChipStamps) -> None:
        self._files = create(CompressedImage, 'chip/compressed', _KEPT)
        self._places = create(CameraInfo, 'chip/camera_info', _KEPT)
        self._identities = create(Detection2DArray, 'chip/detections', _KEPT)
        self._stamps = stamps

    @property
    def wanted(self) -> bool:
        """Whether anybody subscribes to any of them."""
        publishers = self._files, self._places, self._identities
        return any(each.get_subscription_count() for each in publishers)

    def of_frame(self, image: WireImage, plan: WirePlan, camera: Any, codec: str) -> FrameTopics:
        """Prepare the chips of an image, cut by a plan and seen by a camera."""
        return FrameTopics(self, image, plan, camera, codec)


class FrameTopics:
    """The topics for the chips of one image; made by `ChipTopics.of_frame`."""

    def __init__(
        self, topics: ChipTopics, image: WireImage, plan: WirePlan, camera: Any, codec: str
    ) -> None:
        self._topics, self._image, self._plan, self._camera = topics, image, plan, camera
        self._format = format_text(image.encoding, codec)
        self._stamps = topics._stamps.of_image(image.stamp)
        self._with_identity = bool(topics._identities.get_subscription_count())

    def publish(self, chip: Chip, data: bytes) -> None:
        """Publish a chip; the file last."""
        topics, image = self._topics, self._image
        stamp = seconds, nanoseconds = next(self._stamps)
        header = Header(stamp=Time(sec=seconds, nanosec=nanoseconds), frame_id=image.frame_id)
        if self._with_identity:
            topics._identities.publish(
                self._plan.alone(chip.index, stamp, image.stamp, image.frame_id)
            )
        place = copy(self._camera)
        place.header, place.roi = header, region_of_interest(self._camera, chip.region)
        topics._places.publish(place)
        topics._files.publish(
            CompressedImage(header=header, format=self._format, data=array('B', data))
        )
