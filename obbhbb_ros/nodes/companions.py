# SPDX-License-Identifier: Apache-2.0
"""What belongs to an image besides its plan: its camera, and what the spool stores of its ships."""

from __future__ import annotations

import time
from collections.abc import Callable

from sensor_msgs.msg import CameraInfo
from vision_msgs.msg import Detection2DArray

from obbhbb_ros.downlink.cameras import CameraMemory
from obbhbb_ros.downlink.decoding import AnyImage
from obbhbb_ros.downlink.joiner import CAMERAS_KEPT
from obbhbb_ros.downlink.joiner import PLANS_KEPT
from obbhbb_ros.downlink.joiner import StampCache
from obbhbb_ros.downlink.joiner import Unpaired
from obbhbb_ros.earth.reported import ShipPlaces
from obbhbb_ros.nodes.camera_info import Camera
from obbhbb_ros.nodes.camera_info import camera_of
from obbhbb_ros.nodes.lifecycle.managed import ManagedNode
from obbhbb_ros.nodes.lifecycle.node_topics import TopicInput
from obbhbb_ros.nodes.lifecycle.node_topics import reliable
from obbhbb_ros.nodes.lifecycle.parts import Part
from obbhbb_ros.nodes.positions_input import PositionsInput
from obbhbb_ros.pipeline.plausibility import frames_text
from obbhbb_ros.settings.chip_extractor import ChipSettings
from obbhbb_ros.wire.image import WireImage
from obbhbb_ros.wire.plans import Source
from obbhbb_ros.wire.plans import WirePlan
from obbhbb_ros.wire.plans import read_sources
from obbhbb_ros.wire.stamp import Stamp
from obbhbb_ros.wire.stamp import stamp_text


class ImageCompanions(Part):
    """
    Keeps cameras, sources of plans and places of ships for the images of their stamps.

    Reads `camera_info`, and with a spool `crop_sources`, `positions` and `image_pose`.

    Parameters
    ----------
    node : ManagedNode
        The node.
    on_arrival : callable
        Called when one of them has come.
    """

    def __init__(self, node: ManagedNode[ChipSettings], on_arrival: Callable[[], object]) -> None:
        self._node, self._on_arrival = node, on_arrival
        self._cameras = CameraMemory[Camera]()
        self._sources = StampCache[list[Source]](self._on_sources_dropped)
        self._sources_in: TopicInput | None = None
        self._positions: PositionsInput | None = None
        # After a stall there has to be a camera info for every image.
        self._cameras_in = node.topics.input(
            CameraInfo, 'camera_info', self._on_camera_info, qos=reliable(CAMERAS_KEPT)
        )
        if node.parameters.settings.spool_path:
            self._positions = PositionsInput(node, on_arrival)
            self._sources_in = node.topics.input(
                Detection2DArray, 'crop_sources', self._on_sources, qos=reliable(PLANS_KEPT)
            )
        node.parts.append(self)

    def configure(self) -> None:
        """Forget the cameras of earlier runs."""
        self._cameras.clear()

    def deactivate(self) -> None:
        """Drop the sources that wait."""
        self._sources.clear()

    def is_coming(self, stamp: Stamp) -> bool:
        """Return whether the camera of an image, or where its ships are, is on its way."""
        return self._cameras.is_coming(stamp) or (
            self._positions is not None and self._positions.is_coming(stamp)
        )

    def renew(self, plan: WirePlan, now: float) -> None:
        """Let the sources of a plan wait as long as their plan."""
        self._sources.renew(plan.stamp, now)

    def expire(self, now: float, max_age: float) -> None:
        """Drop the sources that came more than `max_age` seconds ago."""
        self._sources.expire(now, max_age)

    def camera(self, image: WireImage) -> Camera | None:
        """Return the camera of an image, by its stamp or else the latest; None if none fits."""
        choice = self._cameras.choice(image.stamp)
        if choice is None or not all(choice.camera.facts.image_size):
            return None
        self.compare_frames(image, 'camera_info', choice.camera.facts.frame_id)
        if not choice.camera.facts.fits((image.width, image.height)):
            self._warn_of_size(image, choice.camera.facts.image_size)
            return None
        self._node.monitor.add(choice.key)
        return choice.camera

    def take_sources(self, plan: WirePlan) -> list[Source]:
        """Remove and return the sources of a plan; none if they do not match its regions."""
        sources = self._sources.pop(plan.stamp) or []
        if self._sources_in is None or not len(plan) or plan.has_sources(sources):
            return sources
        self._node.monitor.add('plans_without_sources')
        if self._sources_in.has_publisher():
            self._node.reporter.warn(
                'no sources',
                f'no sources on {self._sources_in.topic_name} for the plan at stamp '
                f'{stamp_text(plan.stamp)}: scores are used as values',
            )
        return []

    def places(self, image: WireImage) -> ShipPlaces | None:
        """Return where the ships of an image are on Earth; None if that is not known."""
        return None if self._positions is None else self._positions.places(image.stamp)

    def compare_frames(self, image: AnyImage, what: str, frame_id: str) -> None:
        """Report that an image and what belongs to it are of different frames."""
        if text := frames_text(('image', image.frame_id), (what, frame_id)):
            self._node.monitor.add(f'frame_ids_differ.{what}')
            self._node.reporter.warn_once(text)

    def _on_camera_info(self, data: bytes) -> None:
        """Keep the camera for the image of its stamp."""
        camera = camera_of(data)
        self._cameras.add(camera.facts.stamp, camera, time.monotonic())
        self._on_arrival()

    def _on_sources(self, data: bytes) -> None:
        """Keep the sources of a plan until its image is cut."""
        stamp, sources = read_sources(data)
        self._on_arrival()
        # Their plans wait in the node, or still in the middleware.
        max_count = self._node.parameters.settings.pairing.regions + PLANS_KEPT
        self._sources.put(stamp, sources, time.monotonic(), max_count)

    def _on_sources_dropped(self, reason: Unpaired, _: list[Source]) -> None:
        """Count sources that were not used."""
        self._node.monitor.add(f'crop_sources_dropped.{reason.value}')

    def _warn_of_size(self, image: WireImage, size: tuple[int, int]) -> None:
        """Report a camera info of another size."""
        self._node.monitor.add('camera_info_of_another_size')
        width, height = size
        self._node.reporter.warn(
            'camera size',
            f'the image at stamp {stamp_text(image.stamp)} has {image.width} x {image.height} '
            f'pixels, its camera_info says {width} x {height} on {self._cameras_in.topic_name}: '
            'its chips have no camera, and crop regions may be misplaced',
        )
