# SPDX-License-Identifier: Apache-2.0
"""The chip node: cuts crop regions out of images, publishes the chips, and spools them."""

from __future__ import annotations

import time
from functools import partial
from typing import Any

from vision_msgs.msg import Detection2DArray

from obbhbb_ros.downlink.decoding import AnyImage
from obbhbb_ros.downlink.frame_queue import FrameQueue
from obbhbb_ros.downlink.joiner import IMAGES_KEPT
from obbhbb_ros.downlink.joiner import PLANS_KEPT
from obbhbb_ros.downlink.joiner import JoinerSide
from obbhbb_ros.downlink.joiner import Lateness
from obbhbb_ros.downlink.joiner import PairLimits
from obbhbb_ros.downlink.joiner import Unpaired
from obbhbb_ros.nodes.chip_spool import ChipSpool
from obbhbb_ros.nodes.companions import ImageCompanions
from obbhbb_ros.nodes.frame_cutting import FrameCutting
from obbhbb_ros.nodes.frame_cutting import PairedFrame
from obbhbb_ros.nodes.frame_cutting import PlannedFrame
from obbhbb_ros.nodes.image_input import image_input
from obbhbb_ros.nodes.lifecycle.managed import ManagedNode
from obbhbb_ros.nodes.lifecycle.node_topics import reliable
from obbhbb_ros.settings.chip_extractor import CHIP_EXTRACTOR
from obbhbb_ros.settings.chip_extractor import ChipSettings
from obbhbb_ros.wire.plans import WirePlan
from obbhbb_ros.wire.stamp import Stamp
from obbhbb_ros.wire.stamp import stamp_text

_EXPLANATIONS = {
    Unpaired.EXPIRED: 'no image with its stamp arrived within cache.max_age',
    Unpaired.CROWDED_OUT: 'more than cache.regions plans wait for their images',
    Unpaired.DUPLICATE: 'another message with the same stamp came before',
    Unpaired.ZERO_STAMP: 'its stamp is zero',
    Unpaired.OVERLOADED: 'frames are cut more slowly than they come, and more than '
    'cache.max_bytes wait; see crop.max_images',
}
_MISTAKES = (Unpaired.DUPLICATE, Unpaired.ZERO_STAMP)


class ChipExtractor(ManagedNode[ChipSettings]):
    """
    Managed node `chip_extractor`.

    It pairs images with their crop plans; its parts know what else belongs to an image, cut it, and
    store the chips.

    Subscribes to `image`, `crop_regions` and `camera_info`, and with a spool to `crop_sources`,
    `positions` and `image_pose`; publishes `chip/compressed`, `chip/camera_info`, `chip/detections`
    and `/diagnostics`. Topics and parameters: `doc/chip_extractor.md`.

    Parameters
    ----------
    **kwargs
        Passed to `rclpy.lifecycle.LifecycleNode`.

    Raises
    ------
    ValueError, rclpy.exceptions.ParameterException
        If the parameters given at start cannot be used.
    """

    def __init__(self, **kwargs: Any) -> None:
        super().__init__(
            'chip_extractor',
            CHIP_EXTRACTOR,
            ('images_received', 'chips_sent', 'bytes_sent'),
            **kwargs,
        )
        self._images = JoinerSide[AnyImage, PlannedFrame](
            self._on_image_dropped,
            partial(self._warn_of_jump_back, 'images'),
            size_of=lambda image: image.data.nbytes,
        )
        self._plans = JoinerSide[PlannedFrame, AnyImage](
            self._on_plan_dropped,
            partial(self._warn_of_jump_back, 'crop_plans'),
            self._warn_of_late_plan,
        )
        self._images.pair_with(self._plans)
        # Its inputs come first, so that camera infos and sources are there before images and plans.
        self._companions = ImageCompanions(self, self._catch_up)
        self._spool = ChipSpool(self)
        self._cutting = FrameCutting(self, self._companions, self._spool, self._catch_up)
        self._paired = FrameQueue[PairedFrame](self._companions.is_coming)
        self._images_in = image_input(self.topics, self._on_image, reliable(IMAGES_KEPT))
        self._plans_in = self.topics.input(
            Detection2DArray,
            'crop_regions',
            self._on_regions,
            'crop_plans_received',
            reliable(PLANS_KEPT),
        )
        self.parameters.on_change = self._on_parameters
        self.reporter.add_facts(self._facts)

    def deactivate(self) -> None:
        """Drop what waits."""
        for waiting in (self._images, self._plans):
            waiting.clear()
        while self._paired:
            self._drop_pair(Unpaired.CLEARED)

    def _on_parameters(self) -> None:
        """Tell the link and the spool of other settings."""
        self._cutting.set_budget()
        self._spool.set_fade()

    def _facts(self) -> dict[str, str]:
        """Report what is waiting, the budget left, and the books of the spool."""
        self._catch_up()
        chips = (
            sum(map(len, self._plans.waiting))
            + sum(len(frame.planned) for frame in self._paired)
            + self._cutting.chips_waiting
        )
        return {
            'chips_waiting': str(chips),
            'images_waiting': str(len(self._images.waiting) + len(self._paired)),
            'budget_available': f'{self._cutting.budget_available:.0f}',
            **self._spool.facts(),
        }

    def _on_image(self, image: AnyImage) -> None:
        """Keep an image for its plan, or cut it if the plan is there."""
        now, limits = self._catch_up()
        planned = self._images.add(image.stamp, image, now, limits.images, limits.max_bytes)
        if planned is not None:
            self._pair(image, planned, now)
        self._cut_what_is_ready(now, limits)

    def _on_regions(self, data: bytes) -> None:
        """Keep a plan for its image, or cut the image if it is there."""
        plan = WirePlan(data)
        self.monitor.add('chips_planned', len(plan))
        planned = PlannedFrame(plan, self._spool.plan(len(plan)))
        now, limits = self._catch_up()
        self._companions.renew(plan, now)
        image = self._plans.add(plan.stamp, planned, now, limits.regions)
        if image is not None:
            self._pair(image, planned, now)
        self._cut_what_is_ready(now, limits)

    def _pair(self, image: AnyImage, planned: PlannedFrame, now: float) -> None:
        """Let an image with its plan wait for its camera, if that is on its way."""
        self._companions.renew(planned.plan, now)
        self._paired.add(image.stamp, PairedFrame(image, planned, now), image.data.nbytes, now)

    def _cut_what_is_ready(self, now: float, limits: PairLimits) -> None:
        """Cut the images that no longer wait for anything, or have waited long enough."""
        for image, planned in self._images.near_pairs(now, limits.slop, limits.max_age):
            self.monitor.add('frames_paired_by_slop')
            self._pair(image, planned, now)
        while self._cutting.is_busy and self._paired.is_over(limits.max_bytes):
            self._drop_pair(Unpaired.OVERLOADED)
        if self._cutting.is_busy:
            return
        for frame in self._paired.ready(now, limits.max_age, limits.max_bytes):
            self._cutting.cut(frame)
            if self._cutting.is_busy:
                return

    def _catch_up(self) -> tuple[float, PairLimits]:
        """Deal with what has waited long enough; return the time and the limits of what waits."""
        now, limits = time.monotonic(), self.parameters.settings.pairing
        self._cut_what_is_ready(now, limits)
        for waiting in (self._images, self._plans, self._companions):
            waiting.expire(now, limits.max_age)
        return now, limits

    def _drop_pair(self, reason: Unpaired) -> None:
        """Drop the pair that has waited longest."""
        frame = self._paired.pop()
        self._on_image_dropped(reason, frame.image)
        self._on_plan_dropped(reason, frame.planned)

    def _on_image_dropped(self, reason: Unpaired, _: AnyImage) -> None:
        """Count an image without a plan; that is no loss: detectors may skip images."""
        self.monitor.add(f'images_dropped.{reason.value}')
        if reason in _MISTAKES:
            self._warn_of_unpaired('images', reason)

    def _on_plan_dropped(self, reason: Unpaired, planned: PlannedFrame) -> None:
        """Count a plan without an image, and its chips."""
        self.monitor.add(f'crop_plans_dropped.{reason.value}')
        self._cutting.drop(planned, f'crop_plan_{reason.value}')
        if reason in _MISTAKES or (len(planned) and reason in _EXPLANATIONS):
            self._warn_of_unpaired('crop_plans', reason)

    def _warn_of_late_plan(self, planned: PlannedFrame, lateness: Lateness) -> None:
        """Report chips that are lost because their image did not wait for its plan."""
        if len(planned):
            self.reporter.warn(
                'late plan',
                f'dropped a message on {self._plans_in.topic_name}: it came {lateness.age:.1f} s '
                'after its image, which had been dropped: '
                + self.parameters.settings.pairing.shortage(lateness),
            )

    def _warn_of_unpaired(self, kind: str, reason: Unpaired) -> None:
        """Report a message that met no partner."""
        self.reporter.warn(
            f'{kind} {reason.value}',
            f'dropped a message on {self._topic(kind)}: {_EXPLANATIONS[reason]}',
        )

    def _warn_of_jump_back(self, kind: str, latest: Stamp, stamp: Stamp) -> None:
        """Count and report that stamps start again."""
        self.monitor.add('stamps_ran_back')
        self.reporter.warn(
            f'{kind} ran back',
            f'stamps on {self._topic(kind)} went backwards from {stamp_text(latest)} to '
            f'{stamp_text(stamp)}: a bag that loops, a clock that was set back, or two publishers',
        )

    def _topic(self, kind: str) -> str:
        """Name the topic of images or crop plans."""
        return (self._images_in if kind == 'images' else self._plans_in).topic_name
