# SPDX-License-Identifier: Apache-2.0
"""Nodes in processes of their own, and a peer that talks to them over DDS."""

from __future__ import annotations

import itertools
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from collections.abc import Mapping
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import Any
from typing import NamedTuple

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from diagnostic_msgs.msg import DiagnosticStatus
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from lifecycle_msgs.srv import GetAvailableTransitions
from lifecycle_msgs.srv import GetState
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
from rclpy.qos import QoSProfile
from rclpy.task import Future
from vision_msgs.msg import Detection2DArray

from obbhbb_ros.nodes.documentation import yaml_value
from obbhbb_ros.nodes.managed import message_type
from obbhbb_ros.settings import OBB_TO_HBB
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

# Far more than anything takes, for machines that are busy with something else.
TIMEOUT = 30.0
RELIABLE = QoSProfile(depth=1000)

_numbers = itertools.count()


class NodeProcess:
    """
    An executable of the package, as users run it; everything that it prints goes to a file.

    `arguments` and `parameters` go behind `--ros-args`.
    """

    def __init__(
        self,
        executable: str,
        log: Path,
        arguments: Sequence[str] = (),
        parameters: Mapping[str, Any] | None = None,
    ) -> None:
        command = [sys.executable, '-m', 'obbhbb_ros.nodes', executable, '--ros-args']
        for name, value in (parameters or {}).items():
            command += ['-p', f'{name}:={yaml_value(value)}']
        self.path = log
        with log.open('wb') as stream:
            self._process = subprocess.Popen(
                [*command, *arguments], stdout=stream, stderr=subprocess.STDOUT
            )

    @property
    def log(self) -> str:
        return self.path.read_text(encoding='utf-8', errors='replace')

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
        """Whether the process blocks SIGINT, which is the first thing that it does."""
        status = Path(f'/proc/{self.pid}/status').read_text(encoding='ascii')
        (mask,) = (line.split()[1] for line in status.splitlines() if line.startswith('SigBlk'))
        return bool(int(mask, 16) >> (signal.SIGINT - 1) & 1)

    def wait(self, timeout: float = TIMEOUT) -> int:
        """Wait for the end and give the exit code."""
        return self._process.wait(timeout)

    def close(self) -> None:
        """Leave nothing running, whatever happened."""
        if not self.running:
            return
        self.send_signal(signal.SIGINT)
        try:
            self.wait(10.0)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self.wait()


class Site(NamedTuple):
    """
    Where tests take place.

    One context for all: with one for each peer, discovery now and then takes three seconds longer.
    """

    folder: Path
    context: Context


class Peer:
    """Somebody else on the network, with a node of its own in a namespace."""

    def __init__(self, context: Context, namespace: str) -> None:
        self.node = rclpy.create_node('peer', namespace=namespace, context=context)
        self._executor = SingleThreadedExecutor(context=context)
        self._executor.add_node(self.node)

    def close(self) -> None:
        self._executor.shutdown()
        self.node.destroy_node()

    def spin(self, seconds: float = 0.0) -> None:
        """Take what has arrived, or arrives first within that time."""
        self._executor.spin_once(timeout_sec=seconds)

    def spin_until(
        self, condition: Callable[[], Any], what: str, timeout: float = TIMEOUT
    ) -> None:
        deadline = time.monotonic() + timeout
        while not condition():
            if time.monotonic() > deadline:
                raise TimeoutError(f'waited {timeout:g} s for {what}')
            self.spin(0.02)

    def collect(
        self, kind: Any, topic: str, qos: QoSProfile = RELIABLE, raw: bool = False
    ) -> list[Any]:
        """Subscribe, and give the list that messages will be put in."""
        messages: list[Any] = []
        self.node.create_subscription(kind, topic, messages.append, qos, raw=raw)
        return messages

    def publisher(self, kind: Any, topic: str, qos: QoSProfile = RELIABLE) -> Any:
        """Create a publisher and wait until somebody listens to it."""
        publisher = self.node.create_publisher(kind, topic, qos)
        self.spin_until(publisher.get_subscription_count, f'a subscriber of {topic}')
        return publisher


class Converter:
    """
    The node `obb_to_hbb` in a process and a namespace of its own, and a peer that talks to it.

    What the peer hears on `boxes` is in `boxes`, unless `listen` is false.
    """

    def __init__(
        self,
        site: Site,
        arguments: Sequence[str] = (),
        parameters: Mapping[str, Any] | None = None,
        namespace: str = '',
        listen: bool = True,
    ) -> None:
        number = next(_numbers)
        self.namespace = namespace or f'/test_{os.getpid()}_{number}'
        self._input_type = INPUT_TYPES[(parameters or {}).get('input_type', 'Detection2DArray')]
        self._stamps = itertools.count(1)
        self._publisher: Any = None
        self.peer = Peer(site.context, self.namespace)
        self._clients = {
            service: self.peer.node.create_client(kind, f'obb_to_hbb/{service}')
            for service, kind in SERVICES.items()
        }
        self._heard = False
        self.boxes = self.peer.collect(Detection2DArray, 'boxes') if listen else []
        self._diagnostics = self.peer.collect(DiagnosticArray, '/diagnostics')
        self.process = NodeProcess(
            'obb_to_hbb',
            site.folder / f'obb_to_hbb_{number}.log',
            ['-r', f'__ns:={self.namespace}', *arguments],
            parameters,
        )

    def __enter__(self) -> Converter:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.process.close()
        self.peer.close()

    @property
    def publisher(self) -> Any:
        """The peer's publisher of the node's input."""
        if self._publisher is None:
            self._publisher = self.peer.publisher(
                message_type(self._input_type), self._input_type.topic
            )
        return self._publisher

    def wait(self, condition: Callable[[], Any], what: str) -> None:
        """Spin until something holds; give up at once if the node is gone."""

        def holds() -> Any:
            if not self.process.running:
                raise ChildProcessError(f'the node ended before {what}: {self.process.log}')
            return condition()

        try:
            self.peer.spin_until(holds, what)
        except TimeoutError as error:
            raise TimeoutError(f'{error}; the log of the node:\n{self.process.log}') from None

    def wait_for_log(self, *texts: str) -> str:
        """Wait for a line of the log that holds all of the texts, and give it."""
        return self.wait_for(
            lambda: (
                line for line in self.process.log.splitlines()
                if all(text in line for text in texts)
            ),
            f'{texts} in the log',
        )

    def wait_for(self, candidates: Callable[[], Any], what: str) -> Any:
        """Spin until there is a first candidate, and give it."""
        found: list[Any] = []

        def holds() -> bool:
            found.extend(itertools.islice(candidates(), 1))
            return bool(found)

        self.wait(holds, what)
        return found[0]

    def connect(self, answers: list[Any] | None = None) -> None:
        """
        Send empty messages until one comes back on `boxes`, or wherever `answers` come from.

        The node's publisher may know of us a little later than we know of it. When this returns,
        nothing is on its way any more.
        """
        answers = self.boxes if answers is None else answers
        last, again = 0, 0.0

        def answered() -> bool:
            nonlocal last, again
            if time.monotonic() > again:
                last = self.send(message_type(self._input_type)())
                again = time.monotonic() + 0.1
            return any(stamp_of(message) == last for message in answers)

        self.wait(answered, 'the first answer')
        answers.clear()

    def stamped(self, message: Any) -> int:
        """Give a message a stamp that no other has."""
        number = next(self._stamps)
        message.header.stamp.sec, message.header.stamp.nanosec = number, 7 * number
        return number

    def send(self, message: Any) -> int:
        """Publish a message, and give the stamp by which its answer is known."""
        number = self.stamped(message)
        self.publisher.publish(message)
        return number

    def answer_to(self, stamp: int, answers: list[Any] | None = None) -> Any:
        """Wait for the answer to the message of that stamp."""
        answers = self.boxes if answers is None else answers
        return self.wait_for(
            lambda: (message for message in answers if stamp_of(message) == stamp),
            f'the answer to message {stamp}',
        )

    def convert(self, message: Any, answers: list[Any] | None = None) -> Any:
        """Publish a message and wait for its answer."""
        return self.answer_to(self.send(message), answers)

    def call_async(self, service: str, request: Any) -> Future:
        """Call a service of the node, once it is there."""
        if not self._heard:
            self._make_heard()
        client = self._clients[service]
        self.wait(client.service_is_ready, f'the service {service}')
        return client.call_async(request)

    def call(self, service: str, request: Any) -> Any:
        """Call a service of the node and wait for the response."""
        future = self.call_async(service, request)
        self.wait(future.done, f'a response of {service}')
        return future.result()

    def _make_heard(self) -> None:
        """
        Wait until the node's responses find their way.

        A node drops the response to a client that it has not discovered in full. It discovers
        clients in the order of their creation, so a response to the last one is enough.
        """
        client = self._clients['get_state']
        futures: list[Future] = []
        again = 0.0

        def answered() -> bool:
            nonlocal again
            if client.service_is_ready() and time.monotonic() > again:
                futures.append(client.call_async(GetState.Request()))
                again = time.monotonic() + 1.0
            return any(future.done() for future in futures)

        self.wait(answered, 'the first response')
        self._heard = True

    def set_one_by_one(self, values: Mapping[str, Any]) -> list[SetParametersResult]:
        request = SetParameters.Request(parameters=parameters_of(values))
        return list(self.call('set_parameters', request).results)

    def set_atomically(self, values: Mapping[str, Any]) -> SetParametersResult:
        request = SetParametersAtomically.Request(parameters=parameters_of(values))
        return self.call('set_parameters_atomically', request).result

    def set(self, values: Mapping[str, Any]) -> None:
        """Set parameters that have to be accepted."""
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

    def reports(self) -> list[DiagnosticArray]:
        """Give the node's own diagnostics that have arrived."""
        name = f'{self.namespace}/obb_to_hbb'.lstrip('/')
        return [array for array in self._diagnostics if array.status[0].name == name]

    def next_report(self) -> DiagnosticStatus:
        """Wait for diagnostics that are made after this moment."""
        # One may have arrived already.
        self.peer.spin()
        self._diagnostics.clear()
        self.wait(self.reports, 'diagnostics')
        return self.reports()[0].status[0]

    def counts(self) -> Counts:
        """Give the numbers of the next diagnostics."""
        return Counts(self.next_report())

    def reset(self) -> None:
        """Go back to the default parameters and forget what was heard."""
        self.set({spec.name: spec.default for spec in OBB_TO_HBB.rows if not spec.read_only})
        self.boxes.clear()


class Counts(dict[str, float]):
    """The numbers of a report by name, 0 for those that it does not have."""

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
        """Give the counters that have changed, and by how much."""
        return {
            name: value - before[name]
            for name, value in self.items()
            if name.startswith(prefix) and value != before[name]
        }


def values_of(report: DiagnosticStatus) -> dict[str, str]:
    return {pair.key: pair.value for pair in report.values}


def parameters_of(values: Mapping[str, Any]) -> list[Any]:
    return [Parameter(name, value=value).to_parameter_msg() for name, value in values.items()]


def stamp_of(message: Any) -> int:
    """Give the number that `Converter.stamped` has put into a message."""
    return message.header.stamp.sec
