# SPDX-License-Identifier: Apache-2.0
"""
Run the node for a long time while its parameters flip, and hold every answer against both sets.

    python test/soak/node.py --minutes 10

A message of 100 detections goes out 50 times a second; ten times a second a set of parameters
replaces the other. Every message must be answered, each box of an answer under the same set, and
the node's memory must not grow after the first minute.
"""

from __future__ import annotations

import argparse
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import rclpy
from rcl_interfaces.srv import SetParametersAtomically
from rclpy.executors import SingleThreadedExecutor
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile
from vision_msgs.msg import Detection2DArray

sys.path.insert(0, str(Path(__file__).parents[1] / 'benchmarks'))

from node import message

from obbhbb_ros.boxes import OrientedBoxes
from obbhbb_ros.converter import HullRule
from obbhbb_ros.converter import half_extents
from obbhbb_ros.wire.detections import Detections

RULES = (HullRule(), HullRule('shape_aware', 2.2, 0.9, 1.05))
MESSAGE_PERIOD, FLIP_PERIOD, REPORT_PERIOD = 1 / 50, 1 / 10, 30.0
DETECTIONS = 100
GRACE = 5.0


class Soak:
    """A node in a process of its own, under a steady load."""

    def __init__(self) -> None:
        namespace = f'/soak_{os.getpid()}'
        # Best effort by default: where nothing may be lost, a user asks for it like this.
        qos = f'qos_overrides.{namespace}/detections.subscription'
        self._process = subprocess.Popen([
            sys.executable, '-m', 'obbhbb_ros.nodes', 'obb_to_hbb',
            '--ros-args', '-r', f'__ns:={namespace}',
            '-p', f'{qos}.reliability:=reliable', '-p', f'{qos}.depth:=100',
        ])
        self._node = rclpy.create_node('soak', namespace=namespace)
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(self._node)
        deep = QoSProfile(depth=100)
        self._publisher = self._node.create_publisher(Detection2DArray, 'detections', deep)
        self._node.create_subscription(Detection2DArray, 'boxes', self._check, deep, raw=True)
        self._parameters = self._node.create_client(
            SetParametersAtomically, 'obb_to_hbb/set_parameters_atomically'
        )
        self._template = bytearray(message(DETECTIONS))
        boxes = OrientedBoxes.from_xywhr(Detections(bytes(self._template)).xywhr())
        self._sizes = [2.0 * half_extents(boxes, [rule]).T for rule in RULES]
        self.sent = self.flips = self.rejected = self.mixed = self.unasked = 0
        self.by_rule = [0, 0]
        self._open: set[int] = set()

    @property
    def unanswered(self) -> int:
        """How many messages have had no answer yet."""
        return len(self._open)

    def wait_for_node(self) -> None:
        """Wait until the node is there."""
        deadline = time.monotonic() + 30
        while not (
            self._publisher.get_subscription_count()
            and self._node.count_publishers('boxes')
            and self._parameters.service_is_ready()
        ):
            if time.monotonic() > deadline:
                raise TimeoutError('the node does not answer')
            self._executor.spin_once(timeout_sec=0.1)
        self.spin_until(time.monotonic() + 1.0)

    def send(self) -> None:
        """Send a message; its stamp is its number."""
        self.sent += 1
        self._template[4:8] = self.sent.to_bytes(4, 'little')
        self._open.add(self.sent)
        self._publisher.publish(bytes(self._template))

    def flip(self) -> None:
        """Replace the set of parameters by the other, all at once."""
        rule = RULES[self.flips % 2]
        self.flips += 1
        request = SetParametersAtomically.Request()
        request.parameters = [
            Parameter(name, value=value).to_parameter_msg() for name, value in vars(rule).items()
        ]
        self._parameters.call_async(request).add_done_callback(self._note_reply)

    def _note_reply(self, future: rclpy.Future) -> None:
        self.rejected += not future.result().result.successful

    def _check(self, data: bytes) -> None:
        """Hold an answer against both sets of parameters."""
        answer = Detections(data)
        if answer.stamp[0] not in self._open:
            self.unasked += 1
            return
        self._open.remove(answer.stamp[0])
        sizes = answer.xywhr()[:, 2:4]
        matches = [np.array_equal(sizes, expected) for expected in self._sizes]
        if sum(matches) == 1:
            self.by_rule[matches.index(True)] += 1
        else:
            self.mixed += 1

    def spin_until(self, moment: float) -> None:
        """Take answers until a moment of the monotonic clock."""
        while (left := moment - time.monotonic()) > 0:
            self._executor.spin_once(timeout_sec=left)

    def resident_megabytes(self) -> float:
        """Tell the memory that the node holds."""
        pages = int(Path(f'/proc/{self._process.pid}/statm').read_text().split()[1])
        return pages * os.sysconf('SC_PAGE_SIZE') / 2**20

    def stop(self) -> int:
        """End the node; give its exit code."""
        self._process.send_signal(signal.SIGINT)
        code = self._process.wait(10)
        self._executor.shutdown()
        return code


def run(soak: Soak, minutes: float) -> list[float]:
    """Keep the load up; give the memory after each report period."""
    soak.wait_for_node()
    started = time.monotonic()
    next_send = next_flip = started
    next_report = started + REPORT_PERIOD
    resident = []
    while time.monotonic() < started + 60 * minutes:
        now = time.monotonic()
        if now >= next_send:
            soak.send()
            next_send += MESSAGE_PERIOD
        if now >= next_flip:
            soak.flip()
            next_flip += FLIP_PERIOD
        if now >= next_report:
            resident.append(soak.resident_megabytes())
            print(
                f'{now - started:5.0f} s: sent {soak.sent}, by set {soak.by_rule}, '
                f'flips {soak.flips}, resident {resident[-1]:.1f} MB', flush=True,
            )
            next_report += REPORT_PERIOD
        soak.spin_until(min(next_send, next_flip, next_report))
    deadline = time.monotonic() + GRACE
    while soak.unanswered and time.monotonic() < deadline:
        soak.spin_until(time.monotonic() + 0.1)
    return resident


def main() -> None:
    """Run the soak and judge it."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parser.add_argument('--minutes', type=float, default=10.0)
    options = parser.parse_args()
    rclpy.init()
    soak = Soak()
    try:
        resident = run(soak, options.minutes)
    finally:
        code = soak.stop()
        rclpy.try_shutdown()
    after_first_minute = resident[1:]
    growth = after_first_minute[-1] - after_first_minute[0] if after_first_minute else 0.0
    print(
        f'sent {soak.sent}, unanswered {soak.unanswered}, mixed {soak.mixed}, '
        f'not asked for {soak.unasked}, by set {soak.by_rule}; {soak.flips} flips, '
        f'{soak.rejected} rejected; memory after the first minute {growth:+.1f} MB; '
        f'exit code {code}'
    )
    good = not (soak.unanswered or soak.mixed or soak.unasked or soak.rejected or code)
    sys.exit(0 if good and growth < 1.0 else 1)


if __name__ == '__main__':
    main()
