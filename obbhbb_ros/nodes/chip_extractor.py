# SPDX-License-Identifier: Apache-2.0
"""The chip node: cuts crop regions out of images, publishes the chips, and spools them."""

from __future__ import annotations

import time
from collections.abc import Iterator
from collections.abc import Mapping
from collections.abc import Sequence
from dataclasses import dataclass
from dataclasses import field
from functools import partial
from pathlib import Path
from typing import Any
from typing import NamedTuple

from sensor_msgs.msg import CameraInfo
from vision_msgs.msg import Detection2DArray

from obbhbb_ros.downlink.budget import FrameBudget
from obbhbb_ros.downlink.budget import TokenBucket
from obbhbb_ros.downlink.cameras import CameraMemory
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
from obbhbb_ros.downlink.frame_queue import FrameQueue
from obbhbb_ros.downlink.joiner import CAMERAS_KEPT
from obbhbb_ros.downlink.joiner import IMAGES_KEPT
from obbhbb_ros.downlink.joiner import PLANS_KEPT
from obbhbb_ros.downlink.joiner import JoinerSide
from obbhbb_ros.downlink.joiner import Lateness
from obbhbb_ros.downlink.joiner import PairLimits
from obbhbb_ros.downlink.joiner import StampCache
from obbhbb_ros.downlink.joiner import Unpaired
from obbhbb_ros.downlink.stamps import ChipStamps
from obbhbb_ros.nodes.camera_info import Camera
from obbhbb_ros.nodes.camera_info import camera_of
from obbhbb_ros.nodes.camera_info import sized
from obbhbb_ros.nodes.chip_topics import ChipTopics
from obbhbb_ros.nodes.chip_topics import FrameTopics
from obbhbb_ros.nodes.image_input import image_input
from obbhbb_ros.nodes.managed import ManagedNode
from obbhbb_ros.nodes.node_topics import TopicInput
from obbhbb_ros.nodes.node_topics import reliable
from obbhbb_ros.nodes.parts import steady_timer
from obbhbb_ros.nodes.positions_input import PositionsInput
from obbhbb_ros.nodes.spool_report import SpoolReport
from obbhbb_ros.nodes.spool_report import kind_of
from obbhbb_ros.plausibility import frames_text
from obbhbb_ros.settings.chip_extractor import CHIP_EXTRACTOR
from obbhbb_ros.settings.chip_extractor import ChipSettings
from obbhbb_ros.spool.catalogue import SpoolError
from obbhbb_ros.spool.chip_rows import NewChip
from obbhbb_ros.spool.objects import ObjectIds
from obbhbb_ros.spool.records import recorder_of
from obbhbb_ros.spool.writer import FrameTicket
from obbhbb_ros.spool.writer import SpoolWriter
from obbhbb_ros.tracking.track_ids import IdWatch
from obbhbb_ros.wire.buffer import WireError
from obbhbb_ros.wire.image import WireImage
from obbhbb_ros.wire.plans import Source
from obbhbb_ros.wire.plans import WirePlan
from obbhbb_ros.wire.plans import read_sources
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
_LOST_FOR_GOOD = {
    Dropped.OUTSIDE.value: 'they lie outside the image; were they planned for another?',
    Dropped.LARGER_THAN_BURST.value: 'they exceed budget.burst, so no pause is long enough',
}
_MISTAKES = (Unpaired.DUPLICATE, Unpaired.ZERO_STAMP)
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


class ChipExtractor(ManagedNode[ChipSettings]):
    """
    Managed node `chip_extractor`.

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
        self._sources = StampCache[list[Source]](self._on_sources_dropped)
        self._cameras = CameraMemory[Camera]()
        self._paired = FrameQueue[PairedFrame](self._is_coming)
        self._work: FrameInWork | None = None
        # It runs while a frame is in work.
        self._slices = steady_timer(self, 0.0, self._on_slice)
        self._slices.cancel()
        self._budget = self.parameters.settings.budget
        # The link remembers what was sent while the node is inactive.
        self._bucket = TokenBucket(self._budget, time.monotonic())
        self._chip_topics = ChipTopics(self.topics.output, ChipStamps())
        self._spool: SpoolWriter | None = None
        self._objects, self._id_watch = ObjectIds(), IdWatch()
        self.parameters.on_change = self._set_fade
        self._spool_report: SpoolReport | None = None
        images, plans = reliable(IMAGES_KEPT), reliable(PLANS_KEPT)
        # Camera infos and sources come first, so that they are there before images and plans. After
        # a stall there has to be a camera info for every image.
        cameras = reliable(CAMERAS_KEPT)
        self.topics.input(CameraInfo, 'camera_info', self._on_camera_info, qos=cameras)
        self._sources_in: TopicInput | None = None
        self._positions: PositionsInput | None = None
        if self.parameters.settings.spool_path:
            self._positions = PositionsInput(self, self._catch_up)
            self._sources_in = self.topics.input(
                Detection2DArray, 'crop_sources', self._on_sources, qos=plans
            )
        self._images_in = image_input(self.topics, self._on_image, images)
        self._plans_in = self.topics.input(
            Detection2DArray, 'crop_regions', self._on_regions, 'crop_plans_received', plans
        )
        self.reporter.add_facts(self._facts)

    def configure(self) -> None:
        """Open the spool, and forget the cameras and ids of earlier runs."""
        # If Pillow is missing, fail here and not at the first chip.
        import PIL.Image  # noqa: F401

        self._cameras.clear()
        self._objects, self._id_watch = ObjectIds(), IdWatch()
        path = self.parameters.settings.spool_path
        if path:
            self._spool = SpoolWriter(Path(path), self._warn_of_spool)
            self._spool_report = SpoolReport(self.reporter, self._spool)
            self._set_fade()

    def deactivate(self) -> None:
        """Drop the rest of the frame in work, and what waits."""
        if self._work is not None:
            self._work.cut.refuse(Dropped.DEACTIVATED)
            self._finish(self._work)
        for waiting in (self._images, self._plans, self._sources):
            waiting.clear()
        while self._paired:
            frame = self._paired.pop()
            self._on_image_dropped(Unpaired.CLEARED, frame.image)
            self._on_plan_dropped(Unpaired.CLEARED, frame.planned)

    def cleanup(self) -> None:
        """Close the spool."""
        if self._spool is not None:
            self._spool.close()
            self._spool = self._spool_report = None

    def _facts(self) -> dict[str, str]:
        """Report what is waiting, the budget left, and the books of the spool."""
        now, _ = self._catch_up()
        facts = {
            'chips_waiting': str(
                sum(map(len, self._plans.waiting))
                + sum(len(frame.planned) for frame in self._paired)
                + (0 if self._work is None else len(self._work.paired.planned))
            ),
            'images_waiting': str(len(self._images.waiting) + len(self._paired)),
            'budget_available': f'{self._bucket.available(now):.0f}',
        }
        if self._spool is not None and self._spool_report is not None:
            self._spool.catch_up()
            try:
                facts.update(self._spool_report.facts())
            except SpoolError as error:
                self._warn_of_spool(str(error))
        return facts

    def _settings(self) -> ChipSettings:
        """Return the settings in force, and update the budget of the link."""
        settings = self.parameters.settings
        if settings.budget != self._budget:
            self._bucket.change(settings.budget, time.monotonic())
            self._budget = settings.budget
        return settings

    def _set_fade(self) -> None:
        """Write down in the spool how much less repeated views of a ship count."""
        if self._spool is not None:
            self._spool.set_fade(self.parameters.settings.spool_fade, self._on_fade_changed)

    def _on_fade_changed(self, before: float) -> None:
        """Log that the ranks of waiting chips have changed."""
        fade = self.parameters.settings.spool_fade
        self.get_logger().info(f'spool.fade of the spool is now {fade:g}; it was {before:g}')

    def _is_coming(self, stamp: Stamp) -> bool:
        """Return whether the camera of an image, or where its ships are, is on its way."""
        return self._cameras.is_coming(stamp) or (
            self._positions is not None and self._positions.is_coming(stamp)
        )

    def _on_camera_info(self, data: bytes) -> None:
        """Keep the camera for the image of its stamp."""
        camera = camera_of(data)
        self._cameras.add(camera.facts.stamp, camera, time.monotonic())
        self._catch_up()

    def _on_sources(self, data: bytes) -> None:
        """Keep the sources of a plan until its image is cut."""
        stamp, sources = read_sources(data)
        now, limits = self._catch_up()
        # Their plans wait in the node, or still in the middleware.
        self._sources.put(stamp, sources, now, limits.regions + PLANS_KEPT)

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
        ticket = self._spool.plan(len(plan)) if self._spool is not None and len(plan) else None
        planned = PlannedFrame(plan, ticket)
        now, limits = self._catch_up()
        # Sources wait for their plan, and then as long as their plan.
        self._sources.renew(plan.stamp, now)
        image = self._plans.add(plan.stamp, planned, now, limits.regions)
        if image is not None:
            self._pair(image, planned, now)
        self._cut_what_is_ready(now, limits)

    def _pair(self, image: AnyImage, planned: PlannedFrame, now: float) -> None:
        """Let an image with its plan wait for its camera, if that is on its way."""
        self._sources.renew(planned.plan.stamp, now)
        frame = PairedFrame(image, planned, now)
        self._paired.add(image.stamp, frame, image.data.nbytes, now)

    def _cut_what_is_ready(self, now: float, limits: PairLimits) -> None:
        """Cut the images that no longer wait for anything, or have waited long enough."""
        for image, planned in self._images.near_pairs(now, limits.slop, limits.max_age):
            self.monitor.add('frames_paired_by_slop')
            self._pair(image, planned, now)
        while self._work is not None and self._paired.is_over(limits.max_bytes):
            frame = self._paired.pop()
            self._on_image_dropped(Unpaired.OVERLOADED, frame.image)
            self._on_plan_dropped(Unpaired.OVERLOADED, frame.planned)
        if self._work is None:
            for frame in self._paired.ready(now, limits.max_age, limits.max_bytes):
                self._cut(frame)
                if self._work is not None:
                    return

    def _catch_up(self) -> tuple[float, PairLimits]:
        """Deal with what has waited long enough; return the time and the limits of what waits."""
        now, limits = time.monotonic(), self._settings().pairing
        self._cut_what_is_ready(now, limits)
        for waiting in (self._images, self._plans, self._sources):
            waiting.expire(now, limits.max_age)
        return now, limits

    def _on_image_dropped(self, reason: Unpaired, _: AnyImage) -> None:
        """Count an image without a plan; that is no loss: detectors may skip images."""
        self.monitor.add(f'images_dropped.{reason.value}')
        if reason in _MISTAKES:
            self._warn_of_unpaired('images', reason)

    def _on_plan_dropped(self, reason: Unpaired, planned: PlannedFrame) -> None:
        """Count a plan without an image, and its chips."""
        self.monitor.add(f'crop_plans_dropped.{reason.value}')
        self._drop(f'crop_plan_{reason.value}', len(planned))
        self._store(planned, [], {f'crop_plan_{reason.value}': len(planned)})
        if reason in _MISTAKES or (len(planned) and reason in _EXPLANATIONS):
            self._warn_of_unpaired('crop_plans', reason)

    def _warn_of_late_plan(self, planned: PlannedFrame, lateness: Lateness) -> None:
        """Report chips that are lost because their image did not wait for its plan."""
        if len(planned):
            self.reporter.warn(
                'late plan',
                f'dropped a message on {self._plans_in.topic_name}: it came {lateness.age:.1f} s '
                'after its image, which had been dropped: '
                + self._settings().pairing.shortage(lateness),
            )

    def _on_sources_dropped(self, reason: Unpaired, _: list[Source]) -> None:
        """Count sources that were not used."""
        self.monitor.add(f'crop_sources_dropped.{reason.value}')

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

    def _drop(self, reason: str, count: int) -> None:
        """Count planned chips that are not sent."""
        if count:
            self.monitor.add(f'chips_dropped.{reason}', count)

    def _cut(self, paired: PairedFrame) -> None:
        """Cut one frame; publish what the budget allows, and store all of it in the spool."""
        self.monitor.add('frames_paired')
        self._compare_frames(paired.image, 'crop_regions', paired.planned.plan.frame_id)
        work = FrameInWork(paired, FrameCut[NewChip](paired.planned.plan.regions))
        work.steps = self._steps(work.cut, paired.image, paired.planned)
        self._work = work
        self._go_on(work)
        if self._work is not None:
            self._slices.reset()

    def _on_slice(self) -> None:
        """Go on with the frame in work, and after it with those that wait."""
        if self._work is not None:
            self._go_on(self._work)
        if self._work is None:
            self._slices.cancel()
            self._catch_up()

    def _go_on(self, work: FrameInWork) -> None:
        """Cut a slice of the frame in work, and store its chips."""
        is_over = True
        try:
            is_over = work.go_on(_SLICE)
        except (ChipError, WireError) as error:
            if isinstance(error, WireError):
                self.monitor.add('messages_unreadable')
            work.cut.refuse(Dropped.IMAGE_REFUSED)
            self.reporter.warn(
                'image refused',
                f'no chips of the image on {self._images_in.topic_name} at stamp '
                f'{stamp_text(work.paired.image.stamp)}: {error}',
            )
        finally:
            # After an error as well, every chip is accounted for.
            if is_over:
                self._finish(work)
            else:
                self._store(work.paired.planned, *work.cut.take())
        if is_over:
            self.monitor.took(time.monotonic() - work.paired.since)

    def _finish(self, work: FrameInWork) -> None:
        """Account for every chip of the frame in work, and store what is not stored yet."""
        self._work = None
        (image, planned, _), frame = work.paired, work.cut
        self.monitor.add('chips_sent', frame.sent)
        for reason, number in frame.not_sent.items():
            self._drop(reason, number)
        self._store(planned, *frame.take(rest=True))
        self._warn_of_losses(frame.not_sent, image, len(planned))

    def _steps(
        self, frame: FrameCut[NewChip], arrived: AnyImage, planned: PlannedFrame
    ) -> Iterator[None]:
        """Cut the regions of a frame one by one; ValueError if the image cannot be cut."""
        settings, plan = self._settings(), planned.plan
        sources = self._sources.pop(plan.stamp) or []
        is_wanted = self._chip_topics.wanted()
        if not is_wanted:
            frame.close_link(Dropped.NO_SUBSCRIBER)
            if planned.ticket is None:
                return
        if not len(plan) and not isinstance(arrived, WireImage):
            # Nobody wants its pixels.
            return
        image = decoded(arrived)
        _require_little_to_repeat('frame_id', len(image.frame_id.encode()))
        codec, develop = settings.codec.codec, settings.codec.develop
        layout = pixel_format(image.encoding, codec, develop)
        warn = partial(self._warn_of_failure, image, codec)
        cutter = ChipCutter(view_of(image, develop), layout, settings.codec, warn)
        camera = self._camera_of(image)
        if camera is not None:
            facts = camera.facts
            size = 8 * len(facts.d) + len((facts.model + facts.frame_id).encode())
            _require_little_to_repeat('camera_info', size)
        message = sized(image) if camera is None else camera.message
        link = self._link(image, plan, message, settings) if is_wanted else None
        record = None
        if planned.ticket is not None:
            matching = self._matching(plan, sources)
            record = recorder_of(
                image,
                plan,
                matching,
                codec,
                camera and camera.facts,
                self._name_objects,
                None if self._positions is None else self._positions.places(image.stamp),
            )
        yield from frame.steps(cutter.cut, link, record)

    def _name_objects(self, ids: Sequence[str]) -> list[str]:
        """Name the objects of a frame by the ids of its detections, and report doubtful ids."""
        for doubt in self._id_watch.note(ids):
            self.monitor.add(doubt.key, doubt.detections)
            self.reporter.warn(doubt.key, doubt.text)
        return self._objects.name(ids, time.monotonic())

    def _camera_of(self, image: WireImage) -> Camera | None:
        """Return the camera of an image, by its stamp or else the latest; None if none fits."""
        choice = self._cameras.choice(image.stamp)
        if choice is None or not all(choice.camera.facts.image_size):
            return None
        self._compare_frames(image, 'camera_info', choice.camera.facts.frame_id)
        if not choice.camera.facts.fits((image.width, image.height)):
            self._warn_of_size(image, choice.camera.facts.image_size)
            return None
        self.monitor.add(choice.key)
        return choice.camera

    def _compare_frames(self, image: AnyImage, what: str, frame_id: str) -> None:
        """Report that an image and what belongs to it are of different frames."""
        if text := frames_text(('image', image.frame_id), (what, frame_id)):
            self.monitor.add(f'frame_ids_differ.{what}')
            self.reporter.warn_once(text)

    def _warn_of_size(self, image: WireImage, size: tuple[int, int]) -> None:
        """Report a camera info of another size."""
        self.monitor.add('camera_info_of_another_size')
        width, height = size
        self.reporter.warn(
            'camera size',
            f'the image on {self._images_in.topic_name} at stamp {stamp_text(image.stamp)} has '
            f'{image.width} x {image.height} pixels, its camera_info says {width} x {height}: '
            'its chips have no camera, and crop regions may be misplaced',
        )

    def _link(
        self, image: WireImage, plan: WirePlan, camera: CameraInfo, settings: ChipSettings
    ) -> FrameLink:
        """Return the link for the chips of an image."""
        budget = FrameBudget(settings.budget, self._bucket, settings.codec, time.monotonic)
        topics = FrameTopics(self._chip_topics, image, plan, camera, settings.codec)

        def send(chip: EncodedChip, data: bytes) -> None:
            topics.publish(chip, data)
            self.monitor.add('bytes_sent', len(data) + settings.budget.overhead)

        return FrameLink(budget, send)

    def _matching(self, plan: WirePlan, sources: list[Source]) -> list[Source]:
        """Return the sources of a plan; none if they do not match its regions."""
        if plan.has_sources(sources):
            return sources
        self.monitor.add('plans_without_sources')
        if self._sources_in is not None and self._sources_in.has_publisher():
            self.reporter.warn(
                'no sources',
                f'no sources on {self._sources_in.topic_name} for the plan at stamp '
                f'{stamp_text(plan.stamp)}: scores are used as values',
            )
        return []

    def _warn_of_losses(self, dropped: Mapping[str, int], image: AnyImage, count: int) -> None:
        """Warn of chips that are not sent, where an operator can do something."""
        for reason, explanation in _LOST_FOR_GOOD.items():
            if number := dropped.get(reason, 0):
                self.reporter.warn(
                    reason,
                    f'dropped {number} of {count} chips at stamp {stamp_text(image.stamp)}: '
                    f'{explanation}',
                )

    def _store(
        self, planned: PlannedFrame, records: Sequence[NewChip], refused: Mapping[str, int]
    ) -> None:
        """Store the chips of a frame, or of a part of it, if there is a spool."""
        if self._spool is None or planned.ticket is None:
            return
        max_bytes = self.parameters.settings.spool_max_bytes
        part = planned.ticket.part(len(records) + sum(refused.values()))
        if not part.chips:
            return
        is_stored = self._spool.store(part, records, refused, max_bytes)
        self.monitor.add('chips_stored' if is_stored else 'chips_not_stored', len(records))

    def _warn_of_failure(
        self, image: WireImage, codec: str, region: Region, error: Exception
    ) -> None:
        """Report a chip that its format cannot hold."""
        x0, y0, x1, y1 = region
        self.reporter.warn(
            'encoder failure',
            f'{codec} cannot hold the chip of {x1 - x0} x {y1 - y0} pixels at ({x0}, {y0}), '
            f'stamp {stamp_text(image.stamp)}: {error}; see crop.max_size',
        )

    def _warn_of_spool(self, text: str) -> None:
        """Report trouble with the spool."""
        self.monitor.add('spool_troubles')
        self.reporter.warn(kind_of(text), f'spool: {text}')


def _require_little_to_repeat(what: str, size: int) -> None:
    """Raise ChipError if something that each chip of an image repeats takes too many bytes."""
    if size > _MAX_REPEATED:
        raise ChipError(
            f'{what} has {size} bytes, which each chip would repeat; at most {_MAX_REPEATED} can be'
        )
