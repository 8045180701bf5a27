# SPDX-License-Identifier: Apache-2.0
"""The overlay node: draws detections, boxes and crop regions over their image."""

from __future__ import annotations

import time
from array import array
from collections.abc import Callable
from functools import partial
from typing import Any
from typing import TypeVar

from builtin_interfaces.msg import Time
from rclpy.qos import QoSProfile
from sensor_msgs.msg import CompressedImage
from std_msgs.msg import Header
from visualization_msgs.msg import ImageMarker

from obbhbb_ros.colors import LAYER_COLORS
from obbhbb_ros.downlink.decoding import AnyImage
from obbhbb_ros.downlink.decoding import decoded
from obbhbb_ros.downlink.joiner import IMAGES_KEPT
from obbhbb_ros.downlink.joiner import PLANS_KEPT
from obbhbb_ros.nodes.annotations_output import AnnotationsOutput
from obbhbb_ros.nodes.image_input import image_input
from obbhbb_ros.nodes.lifecycle.managed import ManagedNode
from obbhbb_ros.nodes.lifecycle.node_topics import TopicInput
from obbhbb_ros.nodes.lifecycle.node_topics import message_type
from obbhbb_ros.nodes.lifecycle.node_topics import reliable
from obbhbb_ros.nodes.lifecycle.parts import steady_timer
from obbhbb_ros.nodes.lifecycle.reporter import plain_yaml
from obbhbb_ros.overlay.collector import LayerCollector
from obbhbb_ros.overlay.collector import NotDrawn
from obbhbb_ros.overlay.drawing import OverlayError
from obbhbb_ros.overlay.overlay_frame import OverlayFrame
from obbhbb_ros.pipeline.plausibility import frames_text
from obbhbb_ros.settings.overlay import ANNOTATIONS
from obbhbb_ros.settings.overlay import OVERLAY
from obbhbb_ros.settings.overlay import OverlaySettings
from obbhbb_ros.wire.buffer import WireError
from obbhbb_ros.wire.detections import Detections
from obbhbb_ros.wire.layouts import INPUT_TYPES
from obbhbb_ros.wire.layouts import InputType
from obbhbb_ros.wire.stamp import ZERO_STAMP
from obbhbb_ros.wire.stamp import Stamp
from obbhbb_ros.wire.stamp import stamp_text

Item = TypeVar('Item', AnyImage, Detections)

# Seconds by which an image that misses a layer may be drawn late.
_DRAWING_PERIOD = 0.1
# Seconds after which the first viewer is noticed. Not by `matched` events: see `doc/executor.md`.
_VIEWER_PERIOD = 0.5
# As `image_transport` writes it.
_FORMAT = 'rgb8; jpeg compressed bgr8'


class Overlay(ManagedNode[OverlaySettings]):
    """
    Managed node `overlay`.

    It subscribes to `image`, `detections`, `boxes` and `crop_regions` while it has subscribers, and
    publishes `overlay/compressed`, `overlay/markers`, `overlay/annotations` and `/diagnostics`.
    Topics and parameters: `doc/overlay.md`.

    Parameters
    ----------
    **kwargs
        Passed to `rclpy.lifecycle.LifecycleNode`.

    Raises
    ------
    ValueError, rclpy.exceptions.ParameterException
        If the parameters given at start cannot be used.
    ModuleNotFoundError
        If annotations are asked for and foxglove_msgs is not installed.
    """

    def __init__(self, **kwargs: Any) -> None:
        super().__init__(
            'overlay', OVERLAY, ('images_received', 'pictures_sent', 'bytes_sent'), **kwargs
        )
        self._collector = LayerCollector[AnyImage, Detections](
            self._count_not_drawn, size_of=lambda image: image.data.nbytes
        )
        self._input_type = INPUT_TYPES[self.get_parameter('input_type').value]
        self._pictures = self.topics.output(CompressedImage, 'overlay/compressed')
        self._markers = self.topics.output(ImageMarker, 'overlay/markers')
        # Viewers that keep the last marker of a topic would show one layer of all.
        self._markers_of = {
            layer: self.topics.output(ImageMarker, f'overlay/markers/{layer}')
            for layer in LAYER_COLORS
        }
        asked = self.get_parameter(ANNOTATIONS.name).value
        self._annotations = AnnotationsOutput(self.topics, self.monitor) if asked else None
        self._outputs = [self._pictures, self._markers, *self._markers_of.values()]
        if self._annotations is not None:
            self._outputs.append(self._annotations.output)
        images, plans = reliable(IMAGES_KEPT), reliable(PLANS_KEPT)
        self._image_in = image_input(self.topics, self._on_image, images, on_demand=True)
        plain = INPUT_TYPES['Detection2DArray']
        self._layers_in = {
            'detections': self._layer_input(
                'detections', self._input_type, self._input_type.topic, plans
            ),
            'boxes': self._layer_input('boxes', plain, 'boxes', plans),
            'crop_regions': self._layer_input('crop_regions', plain, 'crop_regions', plans),
        }
        self._viewer_timer: Any = None
        self._drawing_timer: Any = None
        self.reporter.add_facts(self._facts)

    def _layer_input(
        self, layer: str, input_type: InputType, topic: str, qos: QoSProfile
    ) -> TopicInput:
        """Add the topic of a layer."""
        callback = partial(self._on_layer, layer, input_type)
        counter = f'layers_received.{layer}'
        return self.topics.input(input_type, topic, callback, counter, qos, True, optional=True)

    def configure(self) -> None:
        """Start to look for viewers; the inputs are opened for the first one."""
        # If Pillow or the detector's messages are missing, fail here and not at the first picture.
        import PIL.ImageDraw  # noqa: F401

        message_type(self._input_type)
        self._viewer_timer = steady_timer(self, _VIEWER_PERIOD, self._follow_viewers)

    def deactivate(self) -> None:
        """Drop the images and layers that wait for each other."""
        self._collector.clear()

    def cleanup(self) -> None:
        """Stop looking for viewers."""
        self.destroy_timer(self._viewer_timer)
        self._close_inputs()

    def _facts(self) -> dict[str, str]:
        """Report what is waiting, and whether the node has viewers."""
        if not self._image_in.is_open:
            self.monitor.expect_input()
        return {
            'frames_waiting': str(len(self._collector)),
            'watched': plain_yaml(self._image_in.is_open),
        }

    def _follow_viewers(self) -> None:
        """Keep the inputs open only while there are viewers."""
        is_watched = any(output.wanted() for output in self._outputs)
        if is_watched and not self._image_in.is_open:
            for topic in (self._image_in, *self._layers_in.values()):
                topic.open()
            self._drawing_timer = steady_timer(self, _DRAWING_PERIOD, self._draw_what_is_ready)
        elif self._image_in.is_open and not is_watched:
            self._close_inputs()
            self._collector.clear()

    def _close_inputs(self) -> None:
        """Unsubscribe from everything."""
        for topic in (self._image_in, *self._layers_in.values()):
            topic.close()
        self.destroy_timer(self._drawing_timer)

    def _on_image(self, image: AnyImage) -> None:
        """Keep an image for its layers."""
        self._collect(self._image_in, image, self._collector.add_image)

    def _on_layer(self, layer: str, input_type: InputType, data: bytes) -> None:
        """Keep a layer for its image, if it is drawn."""
        if layer not in self.parameters.settings.frame.colors:
            return
        detections = Detections(data, input_type)
        self._warn_if_late(layer, detections.stamp)
        add = partial(self._collector.add_layer, layer)
        self._collect(self._layers_in[layer], detections, add)

    def _warn_if_late(self, layer: str, stamp: Stamp) -> None:
        """Report a layer whose image did not wait for it, and what would have kept the image."""
        if lateness := self._collector.lateness(stamp, time.monotonic()):
            self.monitor.add(f'layers_late.{layer}')
            self.reporter.warn(
                f'late {layer}',
                f'{layer} came {lateness.age:.1f} s '
                'after their image, which had been drawn without them or dropped: '
                + self.parameters.settings.limits.shortage(lateness),
            )

    def _collect(
        self, topic: TopicInput, item: Item, add: Callable[[Stamp, Item, float], bool]
    ) -> None:
        """Add a message to the collector, and draw what it makes ready."""
        if item.stamp == ZERO_STAMP:
            self.monitor.add('messages_without_stamp')
            self.reporter.warn(
                f'no stamp on {topic.topic_name}',
                f'dropped a message on {topic.topic_name}: its stamp is zero',
            )
            return
        if not add(item.stamp, item, time.monotonic()):
            self.monitor.add('messages_repeated')
        self._draw_what_is_ready()

    def _draw_what_is_ready(self) -> None:
        """Draw the images that are complete, or have waited long enough."""
        settings = self.parameters.settings
        awaited = {
            layer for layer in settings.frame.colors if self._layers_in[layer].has_publisher()
        }
        for image, layers in self._collector.ready(awaited, time.monotonic(), settings.limits):
            started = time.perf_counter()
            try:
                frame = OverlayFrame(decoded(image), layers, settings.frame)
            except WireError as error:
                self.monitor.add('messages_unreadable')
                self._refuse(image, error)
                continue
            self._draw(frame, settings, awaited)
            self.monitor.took(time.perf_counter() - started)

    def _draw(self, frame: OverlayFrame, settings: OverlaySettings, awaited: set[str]) -> None:
        """Publish the markers, annotations and picture of an image that have a subscriber."""
        self.monitor.add('frames_drawn')
        self.monitor.add('boxes_not_drawn', frame.boxes_not_drawn)
        self._report_missing(frame, awaited)
        for layer, frame_id in frame.frame_ids().items():
            if text := frames_text(('image', frame.image.frame_id), (layer, frame_id)):
                self.monitor.add(f'frame_ids_differ.{layer}')
                self.reporter.warn_once(text)
        for layer in settings.frame.colors:
            publishers = [p for p in (self._markers, self._markers_of[layer]) if p.wanted()]
            marker = frame.marker(layer) if publishers else b''
            for publisher in publishers:
                publisher.publish(marker)
                self.monitor.add('markers_sent')
        if self._annotations is not None and self._annotations.output.wanted():
            self._annotations.send(frame)
        if self._pictures.wanted():
            self._send_picture(frame)

    def _send_picture(self, frame: OverlayFrame) -> None:
        """Publish the picture of a frame."""
        image = frame.image
        try:
            picture = frame.picture()
        except (OverlayError, MemoryError) as error:
            self.monitor.add('images_refused')
            self._refuse(image, error)
            return
        seconds, nanoseconds = image.stamp
        header = Header(stamp=Time(sec=seconds, nanosec=nanoseconds), frame_id=image.frame_id)
        self._pictures.publish(
            CompressedImage(header=header, format=_FORMAT, data=array('B', picture.data))
        )
        self.monitor.add('pictures_sent')
        self.monitor.add('bytes_sent', len(picture.data))
        self.monitor.add('labels_left_out', picture.labels_left_out)

    def _refuse(self, image: AnyImage, error: Exception) -> None:
        """Report an image that cannot be shown."""
        self.reporter.warn(
            'image refused',
            f'no picture of the image on {self._image_in.topic_name} at '
            f'stamp {stamp_text(image.stamp)}: {error}',
        )

    def _report_missing(self, frame: OverlayFrame, awaited: set[str]) -> None:
        """Count the layers that did not come although they have a publisher."""
        missing = [layer for layer in frame.missing if layer in awaited]
        for layer in missing:
            self.monitor.add(f'layers_missing.{layer}')
        if missing:
            self.reporter.warn(
                'layers missing',
                f'drew the image at stamp {stamp_text(frame.image.stamp)} without '
                f'{", ".join(missing)}: none with its stamp arrived within max_wait',
            )

    def _count_not_drawn(self, reason: NotDrawn) -> None:
        """Count an image that is not drawn."""
        self.monitor.add(f'frames_dropped.{reason.value}')
