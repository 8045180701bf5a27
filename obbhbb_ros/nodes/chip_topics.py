# SPDX-License-Identifier: Apache-2.0
"""The topics of a chip: file, place and identity, with a stamp that no other chip has."""

from __future__ import annotations

from array import array
from collections.abc import Callable
from copy import copy
from typing import Any

from builtin_interfaces.msg import Time
from sensor_msgs.msg import CameraInfo
from sensor_msgs.msg import CompressedImage
from std_msgs.msg import Header
from vision_msgs.msg import Detection2DArray

from obbhbb_ros.downlink.chips import CodecSettings
from obbhbb_ros.downlink.chips import EncodedChip
from obbhbb_ros.downlink.chips import format_text
from obbhbb_ros.downlink.stamps import ChipStamps
from obbhbb_ros.nodes.camera_info import region_of_interest
from obbhbb_ros.nodes.lifecycle.node_topics import TopicOutput
from obbhbb_ros.wire.image import WireImage
from obbhbb_ros.wire.plans import WirePlan

# All chips of a frame are published at once: in a shorter queue, the later ones would push out a
# large one before its last piece is sent.
_DEPTH = 1000


class ChipTopics:
    """
    The outputs for chips.

    Parameters
    ----------
    create : callable
        Creates an output, given message class, topic and depth.
    stamps : ChipStamps
        Hands out their stamps.
    """

    def __init__(self, create: Callable[[Any, str, int], TopicOutput], stamps: ChipStamps) -> None:
        self.files = create(CompressedImage, 'chip/compressed', _DEPTH)
        self.places = create(CameraInfo, 'chip/camera_info', _DEPTH)
        self.identities = create(Detection2DArray, 'chip/detections', _DEPTH)
        self.stamps = stamps

    def wanted(self) -> bool:
        """Return whether any of them has a subscriber."""
        return any(output.wanted() for output in (self.files, self.places, self.identities))


class FrameTopics:
    """The topics for the chips of one image, cut by a plan and seen by a camera."""

    def __init__(
        self,
        topics: ChipTopics,
        image: WireImage,
        plan: WirePlan,
        camera: Any,
        settings: CodecSettings,
    ) -> None:
        self._topics, self._image, self._plan, self._camera = topics, image, plan, camera
        self._format = format_text(image.encoding, settings.codec, settings.develop)
        self._stamps = topics.stamps.of_image(image.stamp)
        self._with_identity = topics.identities.wanted()

    def publish(self, chip: EncodedChip, data: bytes) -> None:
        """Publish a chip with its file, which comes last."""
        topics, image = self._topics, self._image
        stamp = seconds, nanoseconds = next(self._stamps)
        header = Header(stamp=Time(sec=seconds, nanosec=nanoseconds), frame_id=image.frame_id)
        if self._with_identity:
            topics.identities.publish(
                self._plan.alone(chip.index, stamp, image.stamp, image.frame_id)
            )
        place = copy(self._camera)
        place.header, place.roi = header, region_of_interest(self._camera, chip.region)
        topics.places.publish(place)
        topics.files.publish(
            CompressedImage(header=header, format=self._format, data=array('B', data))
        )
