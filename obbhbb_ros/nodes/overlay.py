# SPDX-License-Identifier: Apache-2.0
"""The overlay node: draws detections, boxes and crop regions over their image."""

from __future__ import annotations

import time
from array import array
from collections.abc import Callable
from collections.abc import Mapping
from collections.abc import Sequence
from functools import partial
from typing import Any
from typing import TypeVar

from builtin_interfaces.msg import Time
from rclpy.qos import ReliabilityPolicy
from sensor_msgs.msg import CompressedImage
from sensor_msgs.msg import Image
from std_msgs.msg import Header
from vision_msgs.msg import Detection2DArray
from visualization_msgs.msg import ImageMarker

from obbhbb_ros.colors import LAYER_COLORS
from obbhbb_ros.downlink.joiner import ZERO_STAMP
from obbhbb_ros.nodes.managed import ManagedNode
from obbhbb_ros.nodes.managed import message_type
from obbhbb_ros.overlay.collector import LayerCollector
from obbhbb_ros.overlay.collector import NotDrawn
from obbhbb_ros.overlay.drawing import OverlayError
from obbhbb_ros.overlay.frame import OverlayFrame
from obbhbb_ros.settings.common import IMAGES_KEPT
from obbhbb_ros.settings.common import PLANS_KEPT
from obbhbb_ros.settings.overlay import OVERLAY
from obbhbb_ros.settings.overlay import OverlaySettings
from obbhbb_ros.wire.buffer import WireError
from obbhbb_ros.wire.detections import Detections
from obbhbb_ros.wire.image import WireImage
from obbhbb_ros.wire.image import read_image
from obbhbb_ros.wire.layouts import INPUT_TYPES
from obbhbb_ros.wire.stamp import Stamp
from obbhbb_ros.wire.stamp import stamp_text

Item = TypeVar('Item', WireImage, Detections)

_IMAGE = 'image'
# Seconds by which an image that misses a layer may be drawn late.
_TICK = 0.1
# As `image_transport` writes it.
_FORMAT = 'rgb8; jpeg compressed bgr8'


class Overlay(ManagedNode[OverlaySettings]):
    """
    Managed node `overlay`.

    It subscribes to `image`, `detections`, `boxes` and `crop_regions` while it has subscribers, and
    publishes `overlay/compressed`, `overlay/markers` and `/diagnostics`.
    Topics and parameters: `doc/overlay.md`.

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
            'overlay', OVERLAY, ('images_received', 'pictures_sent', 'bytes_sent'), **kwargs
        )
        self._collector = LayerCollector[WireImage, Detections](self._count_not_drawn)
        self._subscriptions_by_kind: dict[str, Any] = {}
        self._ticks: Any = None
        self._autostart()

    def _create_topics(self) -> None:
        """Create the publishers; the first subscriber brings the subscriptions."""
        # If Pillow is missing, fail here and not at the first picture.
        import PIL.ImageDraw  # noqa: F401

        self._input_type = INPUT_TYPES[self.get_parameter('input_type').value]
        self._pictures = self._output(
            CompressedImage, 'overlay/compressed', on_matched=self._follow_viewers
        )
        self._markers = self._output(
            ImageMarker, 'overlay/markers', on_matched=self._follow_viewers
        )
        # Viewers that keep the last marker of a topic would show one layer of all.
        self._markers_of = {
            layer: self._output(
                ImageMarker, f'overlay/markers/{layer}', on_matched=self._follow_viewers
            )
            for layer in LAYER_COLORS
        }

    def _late_topics(self) -> Sequence[str]:
        """List the inputs, to which the node subscribes only while it has subscribers."""
        return [self.resolve_topic_name(topic) for _, _, topic, _, _ in self._layout_of_inputs()]

    def _layout_of_inputs(self) -> Sequence[tuple[str, Any, str, ReliabilityPolicy, int]]:
        """List kind, type, topic, reliability and depth of each input."""
        detections = message_type(self._input_type)
        reliable, any_reliability = ReliabilityPolicy.RELIABLE, ReliabilityPolicy.BEST_EFFORT
        # As in the other nodes: a detector may publish with any reliability; everything else is
        # reliable, because the many pieces of a large image push small messages out of buffers.
        return (
            (_IMAGE, Image, 'image', reliable, IMAGES_KEPT),
            ('detections', detections, self._input_type.topic, any_reliability, PLANS_KEPT),
            ('boxes', Detection2DArray, 'boxes', reliable, PLANS_KEPT),
            ('crop_regions', Detection2DArray, 'crop_regions', reliable, PLANS_KEPT),
        )

    def _forget(self) -> None:
        """Drop the images and layers that wait for each other."""
        self._collector.clear()

    def _release_inputs(self) -> None:
        """Unsubscribe from everything, and stop the timer of the waiting images."""
        super()._release_inputs()
        self._subscriptions_by_kind = {}
        if self._ticks is not None:
            self.destroy_timer(self._ticks)
            self._ticks = None

    def _facts(self) -> dict[str, str]:
        """Report what is waiting, and whether the node has subscribers."""
        return {
            'frames_waiting': str(len(self._collector)),
            'watched': str(bool(self._inputs)).lower(),
        }

    def _silent_for(self, values: Mapping[str, Any]) -> float:
        """Expect no input while the node has no subscribers."""
        if not self._inputs:
            self._monitor.expect_input()
        return super()._silent_for(values)

    def _follow_viewers(self, _: object) -> None:
        """Subscribe to the input only while the node has subscribers."""
        watched = any(map(_wanted, self._outputs))
        if watched and not self._inputs:
            self._subscribe()
        elif self._inputs and not watched:
            self._release_inputs()
            self._forget()

    def _subscribe(self) -> None:
        """Create the subscriptions."""
        self._subscriptions_by_kind = {
            kind: self._input(type_, topic, self._handler(kind), reliability, depth)
            for kind, type_, topic, reliability, depth in self._layout_of_inputs()
        }
        self._ticks = self._every(_TICK, self._draw_what_is_ready)

    def _handler(self, kind: str) -> Callable[[bytes], None]:
        """Return what is called with each message of a kind."""
        return self._on_image if kind == _IMAGE else partial(self._on_layer, kind)

    def _on_image(self, data: bytes) -> None:
        """Keep an image for its layers."""
        self._monitor.add('images_received')
        self._collect(_IMAGE, data, read_image, self._collector.add_image)

    def _on_layer(self, layer: str, data: bytes) -> None:
        """Keep a layer for its image, if it is drawn."""
        self._monitor.add(f'layers_received.{layer}')
        if self._active and layer not in self._parameters_in_force.settings.frame.colors:
            return
        read = (
            partial(Detections, input_type=self._input_type)
            if layer == 'detections'
            else Detections
        )
        self._collect(layer, data, read, partial(self._collector.add_layer, layer))

    def _collect(
        self,
        kind: str,
        data: bytes,
        read: Callable[[bytes], Item],
        add: Callable[[Stamp, Item, float], bool],
    ) -> None:
        """Read a message and add it to the collector, and draw what it makes ready."""
        if not self._active:
            self._monitor.add('messages_while_inactive')
            return
        subscription = self._subscriptions_by_kind[kind]
        try:
            item = read(data)
        except WireError as error:
            self._drop_unreadable(data, subscription, error)
            return
        if item.stamp == ZERO_STAMP:
            self._monitor.add('messages_without_stamp')
            self._warn(
                f'{kind} without stamp',
                f'dropped a message on {subscription.topic_name}: its stamp is zero',
            )
            return
        if not add(item.stamp, item, time.monotonic()):
            self._monitor.add('messages_repeated')
        self._draw_what_is_ready()

    def _draw_what_is_ready(self) -> None:
        """Draw the images that are complete, or have waited long enough."""
        settings = self._parameters_in_force.settings
        awaited = {
            layer
            for layer in settings.frame.colors
            if self._subscriptions_by_kind[layer].get_publisher_count()
        }
        for image, layers in self._collector.ready(awaited, time.monotonic(), settings.limits):
            started = time.perf_counter()
            self._draw(OverlayFrame(image, layers, settings.frame), settings, awaited)
            self._monitor.took(time.perf_counter() - started)

    def _draw(self, frame: OverlayFrame, settings: OverlaySettings, awaited: set[str]) -> None:
        """Publish the markers and the picture of an image that have a subscriber."""
        self._monitor.add('frames_drawn')
        self._monitor.add('boxes_not_drawn', frame.boxes_not_drawn)
        self._report_missing(frame, awaited)
        for layer in settings.frame.colors:
            publishers = [p for p in (self._markers, self._markers_of[layer]) if _wanted(p)]
            marker = frame.marker(layer) if publishers else b''
            for publisher in publishers:
                publisher.publish(marker)
                self._monitor.add('markers_sent')
        if _wanted(self._pictures):
            self._send_picture(frame)

    def _send_picture(self, frame: OverlayFrame) -> None:
        """Publish the picture of a frame."""
        image = frame.image
        try:
            picture = frame.picture()
        except (OverlayError, MemoryError) as error:
            self._monitor.add('images_refused')
            self._warn(
                'image refused',
                f'no picture of the image on {self._subscriptions_by_kind[_IMAGE].topic_name} at '
                f'stamp {stamp_text(image.stamp)}: {error}',
            )
            return
        seconds, nanoseconds = image.stamp
        header = Header(stamp=Time(sec=seconds, nanosec=nanoseconds), frame_id=image.frame_id)
        self._pictures.publish(
            CompressedImage(header=header, format=_FORMAT, data=array('B', picture.data))
        )
        self._monitor.add('pictures_sent')
        self._monitor.add('bytes_sent', len(picture.data))
        self._monitor.add('labels_left_out', picture.labels_left_out)

    def _report_missing(self, frame: OverlayFrame, awaited: set[str]) -> None:
        """Count the layers that did not come although they have a publisher."""
        missing = [layer for layer in frame.missing if layer in awaited]
        for layer in missing:
            self._monitor.add(f'layers_missing.{layer}')
        if missing:
            self._warn(
                'layers missing',
                f'drew the image at stamp {stamp_text(frame.image.stamp)} without '
                f'{", ".join(missing)}: none with its stamp arrived within max_wait',
            )

    def _count_not_drawn(self, reason: NotDrawn) -> None:
        """Count an image that is not drawn."""
        self._monitor.add(f'frames_dropped.{reason.value}')


def _wanted(publisher: Any) -> bool:
    """Return whether a topic has a subscriber."""
    return bool(publisher.get_subscription_count())
