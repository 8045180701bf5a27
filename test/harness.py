# SPDX-License-Identifier: Apache-2.0
"""Nodes in separate processes, and a peer that talks to them over DDS."""

from __future__ import annotations

import itertools
import operator
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from collections.abc import Iterable
from collections.abc import Iterator
from collections.abc import Mapping
from collections.abc import Sequence
from contextlib import contextmanager
from contextlib import nullcontext
from functools import cached_property
from pathlib import Path
from typing import Any
from typing import NamedTuple

import numpy as np
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from diagnostic_msgs.msg import DiagnosticStatus
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from lifecycle_msgs.srv import GetAvailableTransitions
from lifecycle_msgs.srv import GetState
from numpy.typing import NDArray
from rcl_interfaces.msg import ParameterDescriptor
from rcl_interfaces.msg import SetParametersResult
from rcl_interfaces.srv import DescribeParameters
from rcl_interfaces.srv import GetParameters
from rcl_interfaces.srv import SetParameters
from rcl_interfaces.srv import SetParametersAtomically
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.parameter import Parameter
from rclpy.parameter import parameter_value_to_python
from rclpy.qos import DurabilityPolicy
from rclpy.qos import QoSProfile
from rclpy.task import Future
from sensor_msgs.msg import CameraInfo
from sensor_msgs.msg import CompressedImage
from sensor_msgs.msg import Image
from ships import detections
from std_msgs.msg import Header
from vision_msgs.msg import Detection2DArray

from obbhbb_ros.nodes.lifecycle.node_topics import message_type
from obbhbb_ros.nodes.player_messages import image_message
from obbhbb_ros.settings.obb_to_hbb import OBB_TO_HBB
from obbhbb_ros.settings.parameter_file import yaml_value
from obbhbb_ros.wire.layouts import INPUT_TYPES

# The last one is called first.
SERVICES = {
    'set_parameters': SetParameters,
    'set_parameters_atomically': SetParametersAtomically,
    'get_parameters': GetParameters,
    'describe_parameters': DescribeParameters,
    'change_state': ChangeState,
    'get_available_transitions': GetAvailableTransitions,
    'get_state': GetState,
}

# Far more than anything takes, even on a busy machine.
TIMEOUT = 60.0
RELIABLE = QoSProfile(depth=1000)
# Includes what a node logged before it discovered the subscriber.
ROSOUT = QoSProfile(depth=1000, durability=DurabilityPolicy.TRANSIENT_LOCAL)

# Fast DDS logs this if a node of another test, in any domain, opens the same port at that moment.
_SHARED_MEMORY = re.compile(
    r'.*RTPS_TRANSPORT_SHM.*Failed init_port fastrtps_port\d+: open_and_lock_file failed.*\n'
)

DOC = Path(__file__).parents[1] / 'doc'

Region = tuple[int, int, int, int]

_numbers = itertools.count()


class Closing:
    """Base of whatever is closed at the end of a `with` block."""

    def __enter__(self):
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class NodeProcess(Closing):
    """
    An executable of the package, as users run it, or any other command line of a node.

    Its output goes to the file `log`, or to the terminal. `arguments` and `parameters` follow
    `--ros-args`.
    """

    def __init__(
        self,
        executable: str | Sequence[str],
        log: Path | None = None,
        arguments: Sequence[str] = (),
        parameters: Mapping[str, Any] | None = None,
        namespace: str = '',
    ) -> None:
        if isinstance(executable, str):
            executable = [sys.executable, '-m', 'obbhbb_ros.nodes', executable]
        command = [*executable, '--ros-args']
        for name, value in (parameters or {}).items():
            command += ['-p', f'{name}:={yaml_value(plain(value))}']
        if namespace:
            command += ['-r', f'__ns:={namespace}']
        self.path = log
        with log.open('wb') if log else nullcontext() as stream:
            self._process = subprocess.Popen(
                [*command, *arguments], stdout=stream, stderr=subprocess.STDOUT if log else None
            )

    @property
    def log(self) -> str:
        """Its output so far, if that goes to a file."""
        if self.path is None:
            return ''
        return _SHARED_MEMORY.sub('', self.path.read_text(encoding='utf-8', errors='replace'))

    @property
    def pid(self) -> int:
        return self._process.pid

    @property
    def running(self) -> bool:
        return self._process.poll() is None

    def send_signal(self, number: int) -> None:
        self._process.send_signal(number)

    @property
    def has_signals_in_hand(self) -> bool:
        """Whether the process blocks SIGINT yet, which it does first of all."""
        status = Path(f'/proc/{self.pid}/status').read_text(encoding='ascii')
        (mask,) = (line.split()[1] for line in status.splitlines() if line.startswith('SigBlk'))
        return bool(int(mask, 16) >> (signal.SIGINT - 1) & 1)

    def cpu_seconds(self) -> float:
        """Return the processor time of the process since its start."""
        stat = Path(f'/proc/{self.pid}/stat').read_text().rpartition(')')[2].split()
        return sum(map(int, stat[11:13])) / os.sysconf('SC_CLK_TCK')

    def resident_megabytes(self) -> float:
        """Return the memory of the process."""
        pages = int(Path(f'/proc/{self.pid}/statm').read_text().split()[1])
        return pages * os.sysconf('SC_PAGE_SIZE') / 2**20

    def wait(self, timeout: float = TIMEOUT) -> int:
        """Wait for the end, and return the exit code."""
        return self._process.wait(timeout)

    def close(self) -> int:
        """End the process, by SIGKILL if need be, and return the exit code."""
        self.send_signal(signal.SIGINT)
        try:
            return self.wait(10.0)
        except subprocess.TimeoutExpired:
            self._process.kill()
            return self.wait()


def payload_process(
    folder: Path,
    namespace: str,
    parameters: Mapping[str, Mapping[str, Any]],
    command: Sequence[str] = (sys.executable, '-m', 'obbhbb_ros.nodes', 'payload'),
    arguments: Sequence[str] = (),
) -> NodeProcess:
    """
    Start `payload` with nodes that have parameters, by executable.

    Parameter file and log are written to the folder.
    """
    folder.mkdir(exist_ok=True)
    file = folder / 'payload.yaml'
    with file.open('w', encoding='utf-8') as stream:
        # ROS refuses empty sections.
        for name, values in filter(operator.itemgetter(1), parameters.items()):
            print(f'{namespace}/{name}:\n  ros__parameters:', file=stream)
            for key, item in values.items():
                print(f'    {yaml_value(key)}: {yaml_value(plain(item))}', file=stream)
    return NodeProcess(
        [*command, '--nodes', *parameters],
        folder / 'payload.log',
        ['--params-file', str(file), *arguments],
        namespace=namespace,
    )


def plain(value: Any) -> Any:
    """Return a value that a parameter can have."""
    return str(value) if isinstance(value, Path) else value


class Site(NamedTuple):
    """
    Where nodes run: a folder for their logs, if they go to files, and a context for their peers.

    One context for all: with one for each peer, discovery now and then takes three seconds longer.
    """

    context: Context
    folder: Path | None = None

    def start(self, executable: str, **kwargs: Any) -> NodeProcess:
        """Start an executable of the package, with a log file of its own."""
        log = self.folder / f'{executable}_{next(_numbers)}.log' if self.folder else None
        return NodeProcess(executable, log, **kwargs)


@contextmanager
def site_at(folder: Path | None = None) -> Iterator[Site]:
    """Provide a site for the time of the `with` block."""
    context = Context()
    rclpy.init(context=context)
    try:
        yield Site(context, folder)
    finally:
        rclpy.try_shutdown(context=context)


class Peer(Closing):
    """Another participant on the network, with a node in a namespace."""

    def __init__(self, context: Context, namespace: str) -> None:
        self.node = rclpy.create_node('peer', namespace=namespace, context=context)
        self._executor = SingleThreadedExecutor(context=context)
        self._executor.add_node(self.node)

    def close(self) -> None:
        self._executor.shutdown()
        self.node.destroy_node()

    def spin(self, seconds: float = 0.0) -> None:
        """Handle what has arrived, or what arrives first within that time."""
        self._executor.spin_once(timeout_sec=seconds)

    def spin_to(self, moment: float) -> None:
        """Handle what arrives before a time of the monotonic clock."""
        while (left := moment - time.monotonic()) > 0.0:
            self.spin(left)

    def spin_until(self, condition: Callable[[], Any], what: str, timeout: float = TIMEOUT) -> None:
        deadline = time.monotonic() + timeout
        while not condition():
            if time.monotonic() > deadline:
                raise TimeoutError(f'waited {timeout:g} s for {what}')
            self.spin(0.02)

    def repeat(self, seconds: float, *jobs: tuple[float, Callable[[], Any]]) -> None:
        """Do each job once per period for some time, and handle what arrives in between."""
        started = time.monotonic()
        due = [started + period for period, _ in jobs]
        while (now := time.monotonic()) < started + seconds:
            for i, (period, job) in enumerate(jobs):
                if now >= due[i]:
                    job()
                    due[i] += period
            self.spin_to(min(due))

    def collect(
        self, kind: Any, topic: str, qos: QoSProfile = RELIABLE, raw: bool = False
    ) -> list[Any]:
        """Subscribe, and return the list that receives the messages."""
        messages: list[Any] = []
        self.node.create_subscription(kind, topic, messages.append, qos, raw=raw)
        return messages

    def publisher(self, kind: Any, topic: str, qos: QoSProfile = RELIABLE) -> Any:
        """Create a publisher, and wait until it has a subscriber."""
        publisher = self.node.create_publisher(kind, topic, qos)
        self.spin_until(publisher.get_subscription_count, f'a subscriber of {topic}')
        return publisher


class Node(Closing):
    """
    A node in a separate process and namespace, and a peer that talks to it.

    `start` starts the process, so that the peer can subscribe before that.
    """

    process: NodeProcess

    def __init__(self, site: Site, executable: str, namespace: str = '') -> None:
        self._site, self._executable = site, executable
        self.namespace = namespace or f'/test_{os.getpid()}_{next(_numbers)}'
        self.peer = Peer(site.context, self.namespace)
        self._stamps = itertools.count(1)
        self._heard = False
        self._diagnostics = self.peer.collect(DiagnosticArray, '/diagnostics')

    def start(
        self, arguments: Sequence[str] = (), parameters: Mapping[str, Any] | None = None
    ) -> None:
        self.process = self._site.start(
            self._executable, arguments=arguments, parameters=parameters, namespace=self.namespace
        )

    def close(self) -> None:
        self.process.close()
        self.peer.close()

    # Waiting

    def wait(self, condition: Callable[[], Any], what: str) -> None:
        """Spin until a condition holds; fail at once if the node has ended."""

        def holds() -> Any:
            if not self.process.running:
                raise ChildProcessError(f'the node ended before {what}: {self.process.log}')
            return condition()

        try:
            self.peer.spin_until(holds, what)
        except TimeoutError as error:
            raise TimeoutError(f'{error}; the log of the node:\n{self.process.log}') from None

    def wait_for(self, candidates: Callable[[], Iterable[Any]], what: str) -> Any:
        """Spin until there is a first candidate, and return it."""
        first: list[Any] = []

        def holds() -> bool:
            first.extend(itertools.islice(candidates(), 1))
            return bool(first)

        self.wait(holds, what)
        return first[0]

    def wait_for_log(self, *texts: str) -> str:
        """Wait for a line of the log that contains all texts, and return it."""
        return self.wait_for(
            lambda: (
                line
                for line in self.process.log.splitlines()
                if all(text in line for text in texts)
            ),
            f'{texts} in the log',
        )

    def send_until(self, send: Callable[[], Any], condition: Callable[[], Any], what: str) -> None:
        """
        Send repeatedly until a condition holds.

        The node may discover the peer a little later than the peer discovers the node.
        """
        again = 0.0

        def holds() -> Any:
            nonlocal again
            if time.monotonic() > again:
                send()
                again = time.monotonic() + 0.1
            return condition()

        self.wait(holds, what)

    def heard_publisher(self, kind: Any, topic: str) -> Any:
        """
        Create a publisher, and wait until the node receives its messages.

        Otherwise the first messages may be lost if the subscription is best effort.
        """
        publisher = self.peer.publisher(kind, topic)
        before = self.counts()
        self.send_until(
            lambda: publisher.publish(b'no message'),
            lambda: self.counts().since(before).get('messages_unreadable'),
            f'{topic} to be heard',
        )
        # By the next report, messages on their way are counted.
        self.counts()
        return publisher

    # Services

    @cached_property
    def _clients(self) -> dict[str, Any]:
        return {
            service: self.peer.node.create_client(kind, f'{self._executable}/{service}')
            for service, kind in SERVICES.items()
        }

    def call_async(self, service: str, request: Any) -> Future:
        """Call a service of the node as soon as it exists."""
        if not self._heard:
            self._make_heard()
        client = self._clients[service]
        self.wait(client.service_is_ready, f'the service {service}')
        return client.call_async(request)

    def call(self, service: str, request: Any) -> Any:
        """Call a service of the node, and return the response."""
        future = self.call_async(service, request)
        self.wait(future.done, f'a response of {service}')
        return future.result()

    def _make_heard(self) -> None:
        """
        Wait until the node has discovered all clients.

        A node drops responses to a client that it has not fully discovered. It discovers clients in
        the order of their creation, so a response to the last one is enough.
        """
        client = self._clients['get_state']
        self.wait(client.service_is_ready, 'the services')
        futures: list[Future] = []
        self.send_until(
            lambda: futures.append(client.call_async(GetState.Request())),
            lambda: any(future.done() for future in futures),
            'the first response',
        )
        self._heard = True

    def set_one_by_one(self, values: Mapping[str, Any]) -> list[SetParametersResult]:
        request = SetParameters.Request(parameters=parameters_of(values))
        return list(self.call('set_parameters', request).results)

    def set_atomically(self, values: Mapping[str, Any]) -> SetParametersResult:
        request = SetParametersAtomically.Request(parameters=parameters_of(values))
        return self.call('set_parameters_atomically', request).result

    def set(self, values: Mapping[str, Any]) -> None:
        """Set parameters; ValueError if they are refused."""
        result = self.set_atomically(values)
        if not result.successful:
            raise ValueError(result.reason)

    def get(self, *names: str) -> list[Any]:
        """Get parameters."""
        request = GetParameters.Request(names=names)
        response = self.call('get_parameters', request)
        return [parameter_value_to_python(value) for value in response.values]

    def describe(self, *names: str) -> list[ParameterDescriptor]:
        request = DescribeParameters.Request(names=names)
        response = self.call('describe_parameters', request)
        return list(response.descriptors)

    def state(self) -> str:
        """Ask for the lifecycle state."""
        return self.call('get_state', GetState.Request()).current_state.label

    def change_state(self, transition: int) -> bool:
        """Ask for a transition, and tell whether it succeeded."""
        request = ChangeState.Request(transition=Transition(id=transition))
        return self.call('change_state', request).success

    # Diagnostics

    def reports(self) -> list[DiagnosticArray]:
        """Return the diagnostics of this node that have arrived."""
        name = f'{self.namespace}/{self._executable}'.lstrip('/')
        return [array for array in self._diagnostics if array.status[0].name == name]

    def next_report(self) -> DiagnosticStatus:
        """Wait for diagnostics that are made after this moment, and forget those before."""
        # Made, not heard: some may still be on their way.
        moment = time.time()

        def made_since() -> list[DiagnosticArray]:
            return [report for report in self.reports() if time_of(report) > moment]

        self.wait(made_since, 'diagnostics')
        self._diagnostics[:] = made_since()
        return self._diagnostics[0].status[0]

    def warned(self, text: str) -> bool:
        """Return whether diagnostics have reported a text at level WARN."""
        return any(
            text in status.message and status.level == DiagnosticStatus.WARN
            for array in self.reports()
            for status in array.status
        )

    def counts(self) -> Counts:
        """Return the numbers in the next diagnostics."""
        return Counts(self.next_report())

    def stamped(self, message: Any) -> int:
        """Set a unique stamp on a message, and return its number."""
        number = next(self._stamps)
        message.header.stamp.sec, message.header.stamp.nanosec = number, 7 * number
        return number


class Converter(Node):
    """
    The node `obb_to_hbb`, or another that answers detections on `topic`, and a peer.

    `boxes` receives what the peer hears on that topic, unless `listen` is false.
    """

    def __init__(
        self,
        site: Site,
        arguments: Sequence[str] = (),
        parameters: Mapping[str, Any] | None = None,
        namespace: str = '',
        listen: bool = True,
        executable: str = 'obb_to_hbb',
        topic: str = 'boxes',
    ) -> None:
        super().__init__(site, executable, namespace)
        self._input_type = INPUT_TYPES[(parameters or {}).get('input_type', 'Detection2DArray')]
        self.boxes = self.peer.collect(Detection2DArray, topic) if listen else []
        self.start(arguments, parameters)

    @cached_property
    def publisher(self) -> Any:
        """The peer's publisher of the node's input."""
        return self.peer.publisher(message_type(self._input_type), self._input_type.topic)

    def connect(self, answers: list[Any] | None = None) -> None:
        """
        Send empty messages until the last one is answered, on `boxes` or in `answers`.

        When this returns, no message is on its way.
        """
        answers = self.boxes if answers is None else answers
        sent: list[int] = []
        self.send_until(
            lambda: sent.append(self.send(message_type(self._input_type)())),
            lambda: any(stamp_of(message) == sent[-1] for message in answers),
            'the first answer',
        )
        answers.clear()

    def send(self, message: Any) -> int:
        """Publish a message, and return the stamp that identifies its answer."""
        number = self.stamped(message)
        self.publisher.publish(message)
        return number

    def answer_to(self, stamp: int, answers: list[Any] | None = None) -> Any:
        """Wait for the answer to the message with that stamp."""
        answers = self.boxes if answers is None else answers
        return self.wait_for(
            lambda: (message for message in answers if stamp_of(message) == stamp),
            f'the answer to message {stamp}',
        )

    def convert(self, message: Any, answers: list[Any] | None = None) -> Any:
        """Publish a message and wait for its answer."""
        return self.answer_to(self.send(message), answers)

    def reset(self) -> None:
        """Restore the default parameters, and drop received boxes."""
        self.set({spec.name: spec.default for spec in OBB_TO_HBB.rows if not spec.read_only})
        self.boxes.clear()


class ChipNode(Node):
    """
    The node `chip_extractor` and a peer.

    `chips` and `infos` receive what the peer hears; `sent` has the time at which a chip was sent.
    """

    def __init__(
        self, site: Site, parameters: Mapping[str, Any] | None = None, namespace: str = ''
    ) -> None:
        super().__init__(site, 'chip_extractor', namespace)
        self.chips: list[CompressedImage] = []
        self.sent: list[float] = []
        self.peer.node.create_subscription(CompressedImage, 'chip/compressed', self._note, 1000)
        self.infos = self.peer.collect(CameraInfo, 'chip/camera_info')
        self.start(parameters=parameters)

    def _note(self, chip: CompressedImage, info: Mapping[str, int]) -> None:
        self.chips.append(chip)
        self.sent.append(info['source_timestamp'] / 1e9)

    def connect(self) -> None:
        """Wait until all topics are connected in both directions."""
        self.images = self.peer.publisher(Image, 'image')
        self.plans = self.peer.publisher(Detection2DArray, 'crop_regions')
        self.send_until(
            lambda: self.send(np.zeros((8, 8), np.uint8), 'mono8', [(0, 0, 4, 4)]),
            lambda: self.chips and self.infos,
            'a first chip',
        )
        self.counts()
        self.counts()
        self.forget()

    def forget(self) -> None:
        self.chips.clear()
        self.infos.clear()
        self.sent.clear()

    def stamp(self) -> Header:
        """Make a header with a unique stamp."""
        header = Header(frame_id='bow_camera')
        header.stamp.sec = next(self._stamps)
        return header

    def send_plan(self, regions: Sequence[Region], header: Header) -> None:
        """Publish regions as the conversion node does."""
        rows = [((x0 + x1) / 2, (y0 + y1) / 2, x1 - x0, y1 - y0, 0) for x0, y0, x1, y1 in regions]
        message = detections(rows)
        message.header = header
        self.plans.publish(message)

    def send(self, pixels: NDArray[Any], encoding: str, regions: Sequence[Region]) -> Header:
        """Publish an image and its plan."""
        header = self.stamp()
        self.images.publish(image_message(encoding, pixels, header))
        self.send_plan(regions, header)
        return header


class OverlayNode(Node):
    """
    The node `overlay`, and a peer that publishes to it.

    `pictures` receives the pictures, if `look` is true.
    """

    def __init__(
        self, site: Site, parameters: Mapping[str, Any] | None = None, look: bool = True
    ) -> None:
        super().__init__(site, 'overlay')
        topic = 'overlay/compressed'
        self.pictures = self.peer.collect(CompressedImage, topic) if look else []
        self.start(parameters=parameters)

    def connect(self, *layers: str) -> None:
        """Create publishers of images and layers, and wait until the node receives both."""
        self._publishers = {'image': self.peer.publisher(Image, 'image')}
        for layer in layers:
            self._publishers[layer] = self.peer.publisher(Detection2DArray, layer)
        pixels, sent = np.zeros((8, 8), np.uint8), []
        self.send_until(
            lambda: sent.append(self.send(pixels, **dict.fromkeys(layers, ())).stamp.sec),
            lambda: any(stamp_of(picture) == sent[-1] for picture in self.pictures),
            'a first picture',
        )
        self.pictures.clear()

    def publish(self, topic: str, message: Any) -> None:
        """Publish a message or its bytes."""
        self._publishers[topic].publish(message)

    def header(self) -> Header:
        """Make a header with a unique stamp."""
        message = Image(header=Header(frame_id='bow_camera'))
        self.stamped(message)
        return message.header

    def send_image(self, pixels: NDArray[Any], header: Header, encoding: str = 'mono8') -> None:
        self.publish('image', image_message(encoding, pixels, header))

    def send_layer(self, layer: str, rows: Any, header: Header) -> None:
        """Publish boxes: x, y, size x, size y, theta."""
        message = detections(rows)
        message.header = header
        self.publish(layer, message)

    def send(self, pixels: NDArray[Any], encoding: str = 'mono8', **layers: Any) -> Header:
        """Publish an image and the boxes of its layers."""
        header = self.header()
        self.send_image(pixels, header, encoding)
        for layer, rows in layers.items():
            self.send_layer(layer, rows, header)
        return header

    def picture_of(self, header: Header) -> CompressedImage:
        """Wait for the picture of a frame."""
        return self.wait_for(
            lambda: (picture for picture in self.pictures if picture.header == header),
            f'the picture of {header}',
        )


class Counts(dict[str, float]):
    """The numbers of a report by name; 0 for names that it does not have."""

    def __init__(self, report: DiagnosticStatus) -> None:
        super().__init__()
        for pair in report.values:
            try:
                self[pair.key] = float(pair.value)
            except ValueError:
                continue

    def __missing__(self, name: str) -> float:
        return 0.0

    def since(self, before: Counts, prefix: str = '') -> dict[str, float]:
        """Return the counters that have changed, and by how much."""
        return {
            name: value - before[name]
            for name, value in self.items()
            if name.startswith(prefix) and value != before[name]
        }


def time_of(report: DiagnosticArray) -> float:
    """Return the time at which diagnostics were made, seconds since 1970."""
    return report.header.stamp.sec + report.header.stamp.nanosec * 1e-9


def values_of(report: DiagnosticStatus) -> dict[str, str]:
    return {pair.key: pair.value for pair in report.values}


def parameters_of(values: Mapping[str, Any]) -> list[Any]:
    return [Parameter(name, value=value).to_parameter_msg() for name, value in values.items()]


def stamp_of(message: Any) -> int:
    """Return the number that `Node.stamped` has set on a message."""
    return message.header.stamp.sec


def unexplained(keys: Iterable[str], page: str) -> list[str]:
    """List the keys that no row of a node's page, or of the page on all nodes, stands for."""
    rows = [key for name in (page, 'nodes.md') for key in explained_keys(name)]
    patterns = [
        re.escape(key)
        .replace('<name>', '.+')
        .replace('<reason>', '[a-z_]+')
        .replace('<layer>', '[a-z_]+')
        for key in rows
    ]
    return [key for key in keys if not re.fullmatch('|'.join(patterns), key)]


def explained_keys(page: str) -> list[str]:
    """List the keys in the table of diagnostics on a page."""
    text = (DOC / page).read_text(encoding='utf-8').partition('<!-- keys of /diagnostics -->')[2]
    table = text.lstrip().partition('\n\n')[0]
    return re.findall(r'^\| `([^`]+)`', table, re.MULTILINE)
