# SPDX-License-Identifier: Apache-2.0
"""The chip node: an image and its crop regions in, encoded chips within the link's budget out."""

from __future__ import annotations

import time
from array import array
from collections import Counter
from collections.abc import Sequence
from typing import Any

from builtin_interfaces.msg import Time
from rclpy.qos import ReliabilityPolicy
from sensor_msgs.msg import CameraInfo
from sensor_msgs.msg import CompressedImage
from sensor_msgs.msg import Image
from sensor_msgs.msg import RegionOfInterest
from std_msgs.msg import Header
from vision_msgs.msg import Detection2DArray

from obbhbb_ros.downlink.budget import Chip
from obbhbb_ros.downlink.budget import Dropped
from obbhbb_ros.downlink.budget import TokenBucket
from obbhbb_ros.downlink.budget import chips_within_budget
from obbhbb_ros.downlink.chips import ChipError
from obbhbb_ros.downlink.chips import Region
from obbhbb_ros.downlink.chips import format_text
from obbhbb_ros.downlink.chips import pixel_format
from obbhbb_ros.downlink.chips import view_of
from obbhbb_ros.downlink.pairing import Pairing
from obbhbb_ros.downlink.pairing import Stamp
from obbhbb_ros.downlink.pairing import Unpaired
from obbhbb_ros.nodes.managed import ManagedNode
from obbhbb_ros.settings import CHIP_EXTRACTOR
from obbhbb_ros.settings import IMAGES_KEPT
from obbhbb_ros.settings import PLANS_KEPT
from obbhbb_ros.settings import ChipSettings
from obbhbb_ros.wire.cdr import WireError
from obbhbb_ros.wire.detections import read_regions
from obbhbb_ros.wire.image import WireImage
from obbhbb_ros.wire.image import read_image

_CHIPS_KEPT = 1000
_IMAGE, _REGIONS = 0, 1
_KINDS = ('images', 'crop_plans')
_REMEDIES = {
    Unpaired.EXPIRED: 'no image of its stamp came within cache.max_age',
    Unpaired.CROWDED_OUT: 'more than cache.regions wait for their images',
    Unpaired.DUPLICATE: 'another of the same stamp came before',
    Unpaired.ZERO_STAMP: 'its stamp is zero',
}
_LOST_FOR_GOOD = {
    Dropped.OUTSIDE.value: 'they lie outside the image; is it the one that the plan is for?',
    Dropped.LARGER_THAN_BURST.value: 'each is larger than budget.burst, so no pause is enough',
}
_MISTAKES = (Unpaired.DUPLICATE, Unpaired.ZERO_STAMP)


class ChipExtractor(ManagedNode[ChipSettings]):
    """
    Managed node `chip_extractor`.

    Subscribes to `image` and `crop_regions`, publishes `chip/compressed`, `chip/camera_info` and
    `/diagnostics`. Topics and parameters: `doc/chip_extractor.md`.

    Parameters
    ----------
    **kwargs
        Passed to `rclpy.lifecycle.LifecycleNode`.

    Raises
    ------
    ValueError, rclpy.exceptions.ParameterException
        If the parameters given at start cannot be used.
    StartError
        If `autostart` is set and the node cannot be configured or activated.
    """

    def __init__(self, **kwargs: Any) -> None:
        super().__init__(
            'chip_extractor', CHIP_EXTRACTOR, ('images_received', 'chips_sent', 'bytes_sent'),
            **kwargs,
        )
        self._pairing = Pairing(self._let_go, self._ran_back)
        self._budget = self._parameters_in_force.settings.budget
        # The link does not forget what was sent because the node was switched off and on.
        self._bucket = TokenBucket(self._budget, time.monotonic())
        self._autostart()

    def _create_topics(self) -> None:
        """Create publishers and subscriptions; without an encoder there is no point in that."""
        # Found out here rather than at the first chip.
        import PIL.Image  # noqa: F401

        # A frame's chips go out at once: those behind a large one would push it out of a short
        # queue before its last piece is sent.
        self._chips = self._output(CompressedImage, 'chip/compressed', _CHIPS_KEPT)
        self._places = self._output(CameraInfo, 'chip/camera_info', _CHIPS_KEPT)
        # A large image travels in many pieces; one that is lost unnoticed would cost all of it. Its
        # pieces fill the middleware's buffers, which would cost the plan beside it.
        self._images_in, self._regions_in = (
            self._input(
                kind, topic, callback, reliability=ReliabilityPolicy.RELIABLE, depth=depth
            )
            for kind, topic, callback, depth in (
                (Image, 'image', self._on_image, IMAGES_KEPT),
                (Detection2DArray, 'crop_regions', self._on_regions, PLANS_KEPT),
            )
        )

    def _forget(self) -> None:
        """Drop the images and plans that wait for each other."""
        self._pairing.clear()

    def _facts(self) -> dict[str, str]:
        """Report what is waiting, and the bytes that the link has left."""
        settings = self._settings()
        self._pairing.expire(time.monotonic(), settings.pairing)
        waiting = self._pairing.waiting(_REGIONS)
        return {
            'chips_waiting': str(sum(map(len, waiting))),
            'images_waiting': str(len(self._pairing.waiting(_IMAGE))),
            'budget_available': f'{self._bucket.available(time.monotonic()):.0f}',
        }

    def _settings(self) -> ChipSettings:
        """Return the settings in force, and update the budget of the link."""
        settings = self._parameters_in_force.settings
        if settings.budget != self._budget:
            self._bucket.change(settings.budget, time.monotonic())
            self._budget = settings.budget
        return settings

    def _on_image(self, data: bytes) -> None:
        """Keep an image for its regions, or cut it if they are there."""
        self._monitor.add('images_received')
        if not self._active:
            self._monitor.add('messages_while_inactive')
            return
        try:
            image = read_image(data)
        except WireError as error:
            self._drop_unreadable(data, self._images_in, error)
            return
        self._pair(_IMAGE, image.stamp, image)

    def _on_regions(self, data: bytes) -> None:
        """Keep regions for their image, or cut them if it is there."""
        self._monitor.add('crop_plans_received')
        if not self._active:
            self._monitor.add('messages_while_inactive')
            return
        try:
            stamp, regions = read_regions(data)
        except WireError as error:
            self._drop_unreadable(data, self._regions_in, error)
            return
        self._monitor.add('chips_planned', len(regions))
        self._pair(_REGIONS, stamp, regions)

    def _pair(self, kind: int, stamp: tuple[int, int], item: Any) -> None:
        """Find the partner of a message; cut the frame that the two make."""
        started = time.perf_counter()
        settings = self._settings()
        pair = self._pairing.add(kind, stamp, item, time.monotonic(), settings.pairing)
        if pair is not None:
            self._cut(*pair, settings)
            self._monitor.took(time.perf_counter() - started)

    def _let_go(self, kind: int, reason: Unpaired, item: Any) -> None:
        """Count what found no partner."""
        self._monitor.add(f'{_KINDS[kind]}_dropped.{reason.value}')
        if kind == _REGIONS:
            self._drop(f'crop_plan_{reason.value}', len(item))
        # An image without a plan is no loss: a detector may look at every third one only.
        if reason in _MISTAKES or (kind == _REGIONS and item and reason in _REMEDIES):
            self._warn(
                f'{_KINDS[kind]} {reason.value}',
                f'dropped a message on {self._topic(kind)}: {_REMEDIES[reason]}',
            )

    def _ran_back(self, kind: int, latest: Stamp, stamp: Stamp) -> None:
        """Count and tell that time has begun again."""
        self._monitor.add('stamps_ran_back')
        self._warn(
            f'{_KINDS[kind]} ran back',
            f'stamps on {self._topic(kind)} ran back from {_seconds(latest)} to {_seconds(stamp)}: '
            'a bag that loops, a clock that was set back, or two publishers',
        )

    def _topic(self, kind: int) -> str:
        """Name the topic of a kind."""
        subscription = self._images_in if kind == _IMAGE else self._regions_in
        name: str = subscription.topic_name
        return name

    def _drop(self, reason: str, count: int) -> None:
        """Count chips that were planned and are not sent."""
        if count:
            self._monitor.add(f'chips_dropped.{reason}', count)

    def _cut(self, image: WireImage, regions: Sequence[Region], settings: ChipSettings) -> None:
        """Cut one frame and publish what the budget allows."""
        self._monitor.add('frames_paired')
        if not (self._chips.get_subscription_count() or self._places.get_subscription_count()):
            self._drop('no_subscriber', len(regions))
            return
        try:
            layout = pixel_format(image.encoding, settings.codec.codec)
            view = view_of(image)
        except ChipError as error:
            self._drop('image_refused', len(regions))
            self._warn(
                'image refused',
                f'no chips of the image on {self._images_in.topic_name} at stamp '
                f'{_seconds(image.stamp)}: {error}'
            )
            return
        def warn_of_failure(region: Region, error: Exception) -> None:
            x0, y0, x1, y1 = region
            self._warn(
                'encoder failure',
                f'{settings.codec.codec} cannot hold the chip of {x1 - x0} x {y1 - y0} pixels at '
                f'({x0}, {y0}), stamp {_seconds(image.stamp)}: {error}; see crop.max_size',
            )

        dropped: Counter[str] = Counter()
        chips = chips_within_budget(
            view, layout, regions, settings.codec, settings.budget, self._bucket,
            time.monotonic, dropped, warn_of_failure,
        )
        for chip in chips:
            self._publish(chip, image, settings.codec.codec)
            self._monitor.add('chips_sent')
            self._monitor.add('bytes_sent', len(chip.data) + settings.budget.overhead)
        for reason, count in dropped.items():
            self._drop(reason, count)
            if reason in _LOST_FOR_GOOD:
                self._warn(
                    reason,
                    f'dropped {count} of {len(regions)} chips at stamp {_seconds(image.stamp)}: '
                    f'{_LOST_FOR_GOOD[reason]}',
                )

    def _publish(self, chip: Chip, image: WireImage, codec: str) -> None:
        """Publish a chip and its place."""
        seconds, nanoseconds = image.stamp
        header = Header(stamp=Time(sec=seconds, nanosec=nanoseconds), frame_id=image.frame_id)
        x0, y0, x1, y1 = chip.region
        roi = RegionOfInterest(
            x_offset=x0, y_offset=y0, width=x1 - x0, height=y1 - y0, do_rectify=False
        )
        self._places.publish(
            CameraInfo(header=header, width=image.width, height=image.height, roi=roi)
        )
        self._chips.publish(
            CompressedImage(
                header=header, format=format_text(image.encoding, codec),
                data=array('B', chip.data),
            )
        )


def _seconds(stamp: Stamp) -> str:
    """Write a stamp as a number."""
    seconds, nanoseconds = stamp
    return f'{seconds}.{nanoseconds:09d}'
