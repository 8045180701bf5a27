# SPDX-License-Identifier: Apache-2.0
"""The cutting of frames: one at a time, in slices between which the node answers."""

from __future__ import annotations

import time
from collections.abc import Callable
from collections.abc import Iterator
from collections.abc import Mapping
from collections.abc import Sequence
from dataclasses import dataclass
from dataclasses import field
from functools import partial
from typing import NamedTuple

from sensor_msgs.msg import CameraInfo

from obbhbb_ros.downlink.budget import FrameBudget
from obbhbb_ros.downlink.budget import TokenBucket
from obbhbb_ros.downlink.chips import ChipCutter
from obbhbb_ros.downlink.chips import ChipError
from obbhbb_ros.downlink.chips import Dropped
from obbhbb_ros.downlink.chips import EncodedChip
from obbhbb_ros.downlink.chips import Region
from obbhbb_ros.downlink.chips import pixel_format
from obbhbb_ros.downlink.chips import view_of
from obbhbb_ros.downlink.decoding import AnyImage
from obbhbb_ros.downlink.decoding import decoded
from obbhbb_ros.downlink.frame import FrameCut
from obbhbb_ros.downlink.frame import FrameLink
from obbhbb_ros.downlink.stamps import ChipStamps
from obbhbb_ros.nodes.camera_info import Camera
from obbhbb_ros.nodes.camera_info import sized
from obbhbb_ros.nodes.chip_spool import ChipSpool
from obbhbb_ros.nodes.chip_topics import ChipTopics
from obbhbb_ros.nodes.chip_topics import FrameTopics
from obbhbb_ros.nodes.companions import ImageCompanions
from obbhbb_ros.nodes.lifecycle.managed import ManagedNode
from obbhbb_ros.nodes.lifecycle.parts import Part
from obbhbb_ros.nodes.lifecycle.parts import steady_timer
from obbhbb_ros.settings.chip_extractor import ChipSettings
from obbhbb_ros.spool.chip_rows import NewChip
from obbhbb_ros.spool.records import recorder_of
from obbhbb_ros.spool.writer import FrameTicket
from obbhbb_ros.tracking.object_ids import ObjectIds
from obbhbb_ros.tracking.track_ids import IdWatch
from obbhbb_ros.wire.buffer import WireError
from obbhbb_ros.wire.image import WireImage
from obbhbb_ros.wire.plans import WirePlan
from obbhbb_ros.wire.stamp import stamp_text

_LOST_FOR_GOOD = {
    Dropped.OUTSIDE.value: 'they lie outside the image; were they planned for another?',
    Dropped.LARGER_THAN_BURST.value: 'they exceed budget.burst, so no pause is long enough',
}
# Maximum size of the frame_id and of the camera of an image, which each chip repeats, bytes.
_MAX_REPEATED = 10_000
# How long the node cuts a frame before it answers requests, seconds.
_SLICE = 0.1


@dataclass(frozen=True)
class PlannedFrame:
    """A crop plan, and the ticket of its chips if there is a spool."""

    plan: WirePlan
    ticket: FrameTicket | None

    def __len__(self) -> int:
        """Count the regions."""
        return len(self.plan)


class PairedFrame(NamedTuple):
    """An image with its plan, and when they met."""

    image: AnyImage
    planned: PlannedFrame
    since: float


@dataclass
class FrameInWork:
    """A frame that is being cut: what is left of it, and what was not sent so far."""

    paired: PairedFrame
    cut: FrameCut[NewChip]
    steps: Iterator[None] = field(default_factory=lambda: iter(()))

    def go_on(self, seconds: float) -> bool:
        """Cut for some time, one region at least; return whether all of them are cut."""
        end = time.monotonic() + seconds
        return all(time.monotonic() < end for _ in self.steps)


class FrameCutting(Part):
    """
    Cuts frames: publishes the chips that the budget allows, and stores all of them in the spool.

    Parameters
    ----------
    node : ManagedNode
        The node.
    companions : ImageCompanions
        Knows camera, sources and places of an image.
    spool : ChipSpool
        The spool.
    on_free : callable
        Called when a frame is through that took more than a slice.
    """

    def __init__(
        self,
        node: ManagedNode[ChipSettings],
        companions: ImageCompanions,
        spool: ChipSpool,
        on_free: Callable[[], object],
    ) -> None:
        self._node, self._companions, self._spool = node, companions, spool
        self._on_free = on_free
        self._work: FrameInWork | None = None
        # It runs while a frame is in work.
        self._slices = steady_timer(node, 0.0, self._on_slice)
        self._slices.cancel()
        # The link remembers what was sent while the node is inactive.
        self._bucket = TokenBucket(node.parameters.settings.budget, time.monotonic())
        self._topics = ChipTopics(node.topics.output, ChipStamps())
        self._objects, self._id_watch = ObjectIds(), IdWatch()
        node.parts.append(self)

    @property
    def is_busy(self) -> bool:
        """Whether a frame is in work."""
        return self._work is not None

    @property
    def chips_waiting(self) -> int:
        """The chips of the frame in work."""
        return 0 if self._work is None else len(self._work.paired.planned)

    @property
    def budget_available(self) -> float:
        """The bytes that the link would take now."""
        return self._bucket.available(time.monotonic())

    def configure(self) -> None:
        """Forget the ids of earlier runs."""
        # If Pillow is missing, fail here and not at the first chip.
        import PIL.Image  # noqa: F401

        self._objects, self._id_watch = ObjectIds(), IdWatch()

    def deactivate(self) -> None:
        """Drop the rest of the frame in work."""
        if self._work is not None:
            self._work.cut.refuse(Dropped.DEACTIVATED)
            self._finish(self._work)

    def set_budget(self) -> None:
        """Change rate and burst of the link."""
        self._bucket.change(self._node.parameters.settings.budget, time.monotonic())

    def cut(self, paired: PairedFrame) -> None:
        """Cut a frame, or begin to, if it takes more than a slice."""
        self._node.monitor.add('frames_paired')
        plan = paired.planned.plan
        self._companions.compare_frames(paired.image, 'crop_regions', plan.frame_id)
        work = FrameInWork(paired, FrameCut[NewChip](plan.regions))
        work.steps = self._steps(work.cut, paired.image, paired.planned)
        self._work = work
        self._go_on(work)
        if self._work is not None:
            self._slices.reset()

    def drop(self, planned: PlannedFrame, reason: str) -> None:
        """Account for the chips of a frame that is not cut."""
        self._count_dropped(reason, len(planned))
        self._spool.store(planned.ticket, [], {reason: len(planned)})

    def _on_slice(self) -> None:
        """Go on with the frame in work, and after it with those that wait."""
        if self._work is not None:
            self._go_on(self._work)
        if self._work is None:
            self._slices.cancel()
            self._on_free()

    def _go_on(self, work: FrameInWork) -> None:
        """Cut a slice of the frame in work, and store its chips."""
        is_over = True
        try:
            is_over = work.go_on(_SLICE)
        except (ChipError, WireError) as error:
            self._refuse(work, error)
        finally:
            # After an error as well, every chip is accounted for.
            if is_over:
                self._finish(work)
            else:
                self._spool.store(work.paired.planned.ticket, *work.cut.take())
        if is_over:
            self._node.monitor.took(time.monotonic() - work.paired.since)

    def _refuse(self, work: FrameInWork, error: Exception) -> None:
        """Report an image that cannot be cut."""
        if isinstance(error, WireError):
            self._node.monitor.add('messages_unreadable')
        work.cut.refuse(Dropped.IMAGE_REFUSED)
        self._node.reporter.warn(
            'image refused',
            f'no chips of the image at stamp {stamp_text(work.paired.image.stamp)}: {error}',
        )

    def _finish(self, work: FrameInWork) -> None:
        """Account for every chip of the frame in work, and store what is not stored yet."""
        self._work = None
        (image, planned, _), frame = work.paired, work.cut
        self._node.monitor.add('chips_sent', frame.sent)
        for reason, number in frame.not_sent.items():
            self._count_dropped(reason, number)
        self._spool.store(planned.ticket, *frame.take(rest=True))
        self._warn_of_losses(frame.not_sent, image, len(planned))

    def _steps(
        self, frame: FrameCut[NewChip], arrived: AnyImage, planned: PlannedFrame
    ) -> Iterator[None]:
        """Cut the regions of a frame one by one; ChipError if the image cannot be cut."""
        settings, plan = self._node.parameters.settings, planned.plan
        sources = self._companions.take_sources(plan)
        is_wanted = self._topics.wanted()
        if not is_wanted:
            frame.close_link(Dropped.NO_SUBSCRIBER)
            if planned.ticket is None:
                return
        if not len(plan) and not isinstance(arrived, WireImage):
            # Nobody wants its pixels.
            return
        image = decoded(arrived)
        _require_little_to_repeat('frame_id', len(image.frame_id.encode()))
        cutter = self._cutter(image, settings)
        camera = self._camera_of(image)
        message = sized(image) if camera is None else camera.message
        link = self._link(image, plan, message, settings) if is_wanted else None
        record = None
        if planned.ticket is not None:
            record = recorder_of(
                image,
                plan,
                sources,
                settings.codec.codec,
                camera and camera.facts,
                self._name_objects,
                self._companions.places(image),
            )
        yield from frame.steps(cutter.cut, link, record)

    def _cutter(self, image: WireImage, settings: ChipSettings) -> ChipCutter:
        """Return what cuts the chips of an image; ChipError if its encoding is none for chips."""
        codec, develop = settings.codec.codec, settings.codec.develop
        layout = pixel_format(image.encoding, codec, develop)
        warn = partial(self._warn_of_failure, image, codec)
        return ChipCutter(view_of(image, develop), layout, settings.codec, warn)

    def _camera_of(self, image: WireImage) -> Camera | None:
        """Return the camera of an image, if it is known; ChipError if it is too large to repeat."""
        camera = self._companions.camera(image)
        if camera is not None:
            facts = camera.facts
            size = 8 * len(facts.d) + len((facts.model + facts.frame_id).encode())
            _require_little_to_repeat('camera_info', size)
        return camera

    def _link(
        self, image: WireImage, plan: WirePlan, camera: CameraInfo, settings: ChipSettings
    ) -> FrameLink:
        """Return the link for the chips of an image."""
        budget = FrameBudget(settings.budget, self._bucket, settings.codec, time.monotonic)
        topics = FrameTopics(self._topics, image, plan, camera, settings.codec)

        def send(chip: EncodedChip, data: bytes) -> None:
            topics.publish(chip, data)
            self._node.monitor.add('bytes_sent', len(data) + settings.budget.overhead)

        return FrameLink(budget, send)

    def _name_objects(self, ids: Sequence[str]) -> list[str]:
        """Name the objects of a frame by the ids of its detections, and report doubtful ids."""
        for doubt in self._id_watch.note(ids):
            self._node.monitor.add(doubt.key, doubt.detections)
            self._node.reporter.warn(doubt.key, doubt.text)
        return self._objects.name(ids, time.monotonic())

    def _count_dropped(self, reason: str, count: int) -> None:
        """Count planned chips that are not sent."""
        if count:
            self._node.monitor.add(f'chips_dropped.{reason}', count)

    def _warn_of_losses(self, dropped: Mapping[str, int], image: AnyImage, count: int) -> None:
        """Warn of chips that are not sent, where an operator can do something."""
        for reason, explanation in _LOST_FOR_GOOD.items():
            if number := dropped.get(reason, 0):
                self._node.reporter.warn(
                    reason,
                    f'dropped {number} of {count} chips at stamp {stamp_text(image.stamp)}: '
                    f'{explanation}',
                )

    def _warn_of_failure(
        self, image: WireImage, codec: str, region: Region, error: Exception
    ) -> None:
        """Report a chip that its format cannot hold."""
        x0, y0, x1, y1 = region
        self._node.reporter.warn(
            'encoder failure',
            f'{codec} cannot hold the chip of {x1 - x0} x {y1 - y0} pixels at ({x0}, {y0}), '
            f'stamp {stamp_text(image.stamp)}: {error}; see crop.max_size',
        )


def _require_little_to_repeat(what: str, size: int) -> None:
    """Raise ChipError if something that each chip of an image repeats takes too many bytes."""
    if size > _MAX_REPEATED:
        raise ChipError(
            f'{what} has {size} bytes, which each chip would repeat; at most {_MAX_REPEATED} can be'
        )
