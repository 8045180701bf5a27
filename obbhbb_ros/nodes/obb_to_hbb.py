"""The conversion node: oriented detections in, axis-aligned boxes and crop regions out."""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from lifecycle_msgs.srv import ChangeState
from numpy.typing import NDArray
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.lifecycle import LifecycleNode
from rclpy.lifecycle import LifecycleState
from rclpy.lifecycle import TransitionCallbackReturn
from rclpy.qos import QoSProfile
from rclpy.qos import ReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions
from sensor_msgs.msg import CameraInfo
from vision_msgs.msg import Detection2DArray

from obbhbb_ros.boxes import Defect
from obbhbb_ros.boxes import FloatArray
from obbhbb_ros.boxes import OrientedBoxes
from obbhbb_ros.converter import half_extents
from obbhbb_ros.converter import to_xyxy
from obbhbb_ros.crops import plan_crops
from obbhbb_ros.nodes import messages
from obbhbb_ros.nodes.frames import Frame
from obbhbb_ros.nodes.frames import TypedFrame
from obbhbb_ros.nodes.frames import WireFrame
from obbhbb_ros.nodes.monitor import PERIOD
from obbhbb_ros.nodes.monitor import Monitor
from obbhbb_ros.nodes.parameters import LiveParameters
from obbhbb_ros.nodes.process import StartError
from obbhbb_ros.nodes.process import run
from obbhbb_ros.nodes.settings import CLASS_TABLE
from obbhbb_ros.nodes.settings import DETECTIONS
from obbhbb_ros.nodes.settings import TABLE
from obbhbb_ros.nodes.settings import Settings
from obbhbb_ros.nodes.settings import build_settings
from obbhbb_ros.wire import Forms
from obbhbb_ros.wire import NotPlainCdrError

_DEPTH = 10
_WARN_PERIOD = 5.0


class ObbToHbb(LifecycleNode):
    """
    Managed node `obb_to_hbb`.

    Subscribes to `detections` or `polygons` and to `camera_info`, publishes `boxes`,
    `crop_regions` and `/diagnostics`. The README documents topics and parameters.

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
        super().__init__('obb_to_hbb', **kwargs)
        self._parameters_in_force = LiveParameters[Settings](
            self, TABLE, build_settings, self._parameter_overrides, CLASS_TABLE
        )
        self._warn_of_unknown_parameters()
        self._monitor = Monitor(self, ('messages_received', 'detections_received'))
        self._active = False
        self._silent_until: dict[str, float] = {}
        self._forms = Forms()
        self._forget_topics()
        self._service_change_state.callback = self._answering_impossible_transitions(
            self._service_change_state.callback
        )
        if self.get_parameter('autostart').value:
            self._autostart()

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Create the topics; messages are not looked at before activation."""
        try:
            self._create_topics()
        except Exception as error:
            self.get_logger().fatal(f'cannot configure: {type(error).__name__}: {error}')
            self._release()
            return TransitionCallbackReturn.FAILURE
        return super().on_configure(state)

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Begin to convert."""
        self._active = True
        return super().on_activate(state)

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Stop converting; what arrives is counted and dropped."""
        self._active = False
        return super().on_deactivate(state)

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Give every topic back."""
        self._release()
        return super().on_cleanup(state)

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Give every topic back, from whatever state."""
        self._active = False
        self._release()
        return super().on_shutdown(state)

    def on_error(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Start over: give every topic back and be unconfigured."""
        self.get_logger().error(f'error in state {state.label}, going back to unconfigured')
        self._active = False
        self._release()
        return super().on_error(state)

    def _create_topics(self) -> None:
        """Create publishers, subscriptions and timer; `_release` destroys them."""
        self._input_type = self.get_parameter('input_type').value
        self._message_type = messages.message_type(self._input_type)
        self._boxes_publisher = self._output('boxes')
        self._crops_publisher = self._output('crop_regions')
        self._diagnostics_publisher = self.create_publisher(DiagnosticArray, '/diagnostics', 1)
        topic = 'detections' if self._input_type == DETECTIONS else 'polygons'
        self._subscriptions_in.append(
            self._input(self._message_type, topic, self._on_message, raw=True)
        )
        self._subscriptions_in.append(
            self._input(CameraInfo, 'camera_info', self._on_camera_info)
        )
        self._timer = self.create_timer(PERIOD, self._publish_diagnostics)

    def _release(self) -> None:
        """Destroy what there is of topics and timer."""
        if self._timer is not None:
            self.destroy_timer(self._timer)
        for subscription in self._subscriptions_in:
            self.destroy_subscription(subscription)
        if self._diagnostics_publisher is not None:
            self.destroy_publisher(self._diagnostics_publisher)
        for publisher in (self._boxes_publisher, self._crops_publisher):
            if publisher is not None:
                self.destroy_lifecycle_publisher(publisher)
        self._forget_topics()

    def _forget_topics(self) -> None:
        """Have nothing created yet."""
        self._boxes_publisher: Any = None
        self._crops_publisher: Any = None
        self._diagnostics_publisher: Any = None
        self._subscriptions_in: list[Any] = []
        self._timer: Any = None
        self._camera_size = (0, 0)

    def _autostart(self) -> None:
        """Go to the active state without a lifecycle manager."""
        for name, transition in (
            ('configure', self.trigger_configure), ('activate', self.trigger_activate)
        ):
            if transition() != TransitionCallbackReturn.SUCCESS:
                raise StartError(f'{self.get_name()} failed to {name}; the log says why')

    def _output(self, topic: str) -> Any:
        """Create a publisher that is silent while the node is not active."""
        return self.create_lifecycle_publisher(
            Detection2DArray,
            topic,
            QoSProfile(depth=_DEPTH, reliability=ReliabilityPolicy.RELIABLE),
            qos_overriding_options=QoSOverridingOptions.with_default_policies(),
        )

    def _input(self, message_type: Any, topic: str, callback: Any, raw: bool = False) -> Any:
        """Create a subscription that any publisher's reliability fits."""
        return self.create_subscription(
            message_type,
            topic,
            callback,
            QoSProfile(depth=_DEPTH, reliability=ReliabilityPolicy.BEST_EFFORT),
            raw=raw,
            event_callbacks=SubscriptionEventCallbacks(message_lost=self._on_message_lost),
            qos_overriding_options=QoSOverridingOptions.with_default_policies(),
        )

    @property
    def express_subscription(self) -> Any:
        """The subscription whose messages the executor hands over by the shortest way."""
        return self._subscriptions_in[0] if self._subscriptions_in else None

    def _on_camera_info(self, info: CameraInfo) -> None:
        """Learn the size of the image."""
        self._camera_size = messages.image_size(info)

    def _take_camera_info(self) -> None:
        """
        Learn the size that was published before the message at hand.

        The executor may hand over the message first, though it has both.
        """
        subscription = self._subscriptions_in[1]
        try:
            while taken := subscription.handle.take_message(subscription.msg_type, False):
                self._on_camera_info(taken[0])
        except Exception as error:
            self._monitor.add('messages_unreadable')
            self._warn(
                'unreadable camera_info',
                f'dropped a message on {subscription.topic_name}, '
                f'it cannot be read as CameraInfo: {error}',
            )

    def _on_message_lost(self, status: Any) -> None:
        """Count what the middleware could not deliver."""
        self._monitor.add('messages_lost', status.total_count_change)

    def _on_message(self, data: bytes) -> None:
        """Convert one message under one snapshot of the parameters."""
        started = time.perf_counter()
        self._monitor.add('messages_received')
        wants_boxes = self._boxes_publisher.get_subscription_count() > 0
        wants_crops = self._crops_publisher.get_subscription_count() > 0
        if not self._active:
            self._monitor.add('messages_while_inactive')
        elif not (wants_boxes or wants_crops):
            self._monitor.add('messages_without_subscriber')
        else:
            frame = self._read(data)
            if frame is not None:
                settings = self._parameters_in_force.settings
                self._convert(frame, settings, wants_boxes, wants_crops)
            self._monitor.took(time.perf_counter() - started)

    def _read(self, data: bytes) -> Frame | None:
        """Read a message the fast way, or else by message objects; None if it is none."""
        try:
            if self._input_type != DETECTIONS:
                self._monitor.add('typed_path.input_type')
            else:
                try:
                    frame = WireFrame(data, self._forms)
                    self._monitor.add('fast_path')
                    return frame
                except NotPlainCdrError:
                    self._monitor.add('typed_path.not_plain_cdr')
            return TypedFrame(data, self._message_type)
        except Exception as error:
            self._drop_unreadable(data, error)
            return None

    def _convert(
        self, frame: Frame, settings: Settings, wants_boxes: bool, wants_crops: bool
    ) -> None:
        """Convert one message and publish what is wanted of it."""
        boxes = frame.boxes(settings.theta_scale)
        rule_of = None
        if settings.rule_of_class:
            rule_of = messages.rules_of(frame.class_ids(), settings.rule_of_class)
        extents = half_extents(boxes, settings.rules, rule_of, settings.caps)
        self._count(frame, boxes, extents, settings)
        if wants_crops:
            self._publish_crops(frame, boxes, extents, settings)
        if wants_boxes:
            self._boxes_publisher.publish(
                frame.boxes_message(boxes.center, extents, settings.keep_invalid)
            )

    def _publish_crops(
        self,
        frame: Frame,
        boxes: OrientedBoxes,
        extents: FloatArray,
        settings: Settings,
    ) -> None:
        """Plan and publish the crop regions of one message."""
        self._take_camera_info()
        image_size = tuple(
            given or seen
            for given, seen in zip(settings.image_size, self._camera_size, strict=True)
        )
        if not all(image_size):
            self._monitor.add('messages_without_image_size')
            self._warn(
                'no image size',
                'no crop regions without the size of the image: set image_width and '
                'image_height, or publish camera_info'
            )
            return
        xyxy = to_xyxy(boxes.center, extents)
        plan = plan_crops(xyxy, frame.scores(), image_size, settings.crop)
        self._monitor.add('crops_planned', len(plan.sources))
        for reason, count in plan.left_out.items():
            self._monitor.add(f'crops_left_out.{reason.value}', count)
        self._crops_publisher.publish(frame.crops_message(plan))

    def _count(
        self,
        frame: Frame,
        boxes: OrientedBoxes,
        extents: FloatArray,
        settings: Settings,
    ) -> None:
        """Count a message's detections, and tell of those that cannot be converted."""
        self._monitor.add('messages_converted')
        self._monitor.add('detections_received', len(boxes))
        invalid = np.flatnonzero(np.isnan(extents[0]))
        if not invalid.size:
            return
        # A box without a defect that has no extents overflowed.
        defects = np.maximum(boxes.defects[invalid], np.uint8(Defect.NOT_FINITE))
        self._report_invalid(frame, len(boxes), invalid, defects, settings)

    def _report_invalid(
        self,
        frame: Frame,
        total: int,
        rows: NDArray[np.intp],
        defects: NDArray[np.uint8],
        settings: Settings,
    ) -> None:
        """Count invalid detections by reason and warn of the first."""
        action = 'kept' if settings.keep_invalid else 'dropped'
        for defect, count in zip(*np.unique(defects, return_counts=True), strict=True):
            self._monitor.add(f'detections_{action}.{Defect(defect).name.lower()}', int(count))
        seconds, nanoseconds = frame.stamp
        self._warn(
            'invalid detections',
            f'{action} {len(rows)} of {total} detections on '
            f'{self._subscriptions_in[0].topic_name} at stamp {seconds}.{nanoseconds:09d}: '
            f'index {rows[0]} is {Defect(defects[0]).name.lower()}'
        )

    def _drop_unreadable(self, data: bytes, error: Exception) -> None:
        """Count a message that is none."""
        self._monitor.add('messages_unreadable')
        self._warn(
            'unreadable message',
            f'dropped a message of {len(data)} bytes on {self._subscriptions_in[0].topic_name}, '
            f'it cannot be read as {self._input_type}: {error}'
        )

    def _warn(self, kind: str, text: str) -> None:
        """Warn in the next diagnostics and, each kind at a rate that can be read, in the log."""
        self._monitor.trouble(text)
        now = time.monotonic()
        if now >= self._silent_until.get(kind, now):
            self._silent_until[kind] = now + _WARN_PERIOD
            self.get_logger().warning(text)

    def _warn_of_unknown_parameters(self) -> None:
        """Tell what a parameter file sets in vain."""
        unknown = self._parameters_in_force.unknown
        unknown = [name for name in unknown if not name.startswith('qos_overrides.')]
        if unknown:
            self.get_logger().warning('unknown parameters, ignored: ' + ', '.join(unknown))

    def _publish_diagnostics(self) -> None:
        """Tell how things are."""
        state = self._state_machine.current_state[1]
        values = self._parameters_in_force.values()
        self._diagnostics_publisher.publish(self._monitor.report(state, values))

    def _answering_impossible_transitions(self, answer: Any) -> Any:
        """Have the service say no to a transition that the state does not have."""

        def change_state(
            request: ChangeState.Request, response: ChangeState.Response
        ) -> ChangeState.Response:
            # rclpy raises, which leaves the caller without a response.
            try:
                return answer(request, response)
            except rclpy_implementation.RCLError as error:
                self.get_logger().error(f'transition refused: {error}')
                response.success = False
                return response

        return change_state


def main(args: Sequence[str] | None = None) -> None:
    """Run the node."""
    sys.exit(run(ObbToHbb, args))


if __name__ == '__main__':
    main()
