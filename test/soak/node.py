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
import contextlib
import sys
from pathlib import Path

import numpy as np
from rcl_interfaces.srv import SetParametersAtomically
from rclpy.qos import QoSProfile
from rclpy.task import Future
from vision_msgs.msg import Detection2DArray

sys.path.insert(0, str(Path(__file__).parents[1]))

from harness import Node
from harness import Site
from harness import parameters_of
from harness import site_at
from ships import detector_message

from obbhbb_ros.geometry.boxes import OrientedBoxes
from obbhbb_ros.geometry.converter import HullRule
from obbhbb_ros.geometry.converter import half_extents
from obbhbb_ros.wire.detections import Detections

RULES = (HullRule(), HullRule('shape_aware', 2.2, 0.9, 1.05))
FLIPPED = ('method', 'q', 'f', 's')
MESSAGE_PERIOD, FLIP_PERIOD, REPORT_PERIOD = 1 / 50, 1 / 10, 30.0
DETECTIONS = 100
GRACE = 30.0
DEEP = QoSProfile(depth=1000)


class Soak(Node):
    """A node under a steady load."""

    def __init__(self, site: Site) -> None:
        super().__init__(site, 'obb_to_hbb')
        self.peer.node.create_subscription(Detection2DArray, 'boxes', self._check, DEEP, raw=True)
        self._template = bytearray(detector_message(DETECTIONS))
        boxes = OrientedBoxes.from_xywhr(Detections(bytes(self._template)).xywhr())
        self._sizes = [2.0 * half_extents(boxes, [rule]) for rule in RULES]
        self.sent = self.flips = self.rejected = self.mixed = self.unasked = 0
        self.by_rule = [0, 0]
        self.unanswered: set[int] = set()
        # Best effort by default: where nothing may be lost, a user asks for it like this.
        qos = f'qos_overrides.{self.namespace}'
        self.start(
            parameters={
                f'{qos}/detections.subscription.reliability': 'reliable',
                f'{qos}/detections.subscription.depth': DEEP.depth,
                f'{qos}/boxes.publisher.depth': DEEP.depth,
            }
        )

    def connect(self) -> None:
        """Wait until the node is there."""
        self._publisher = self.peer.publisher(Detection2DArray, 'detections', DEEP)
        self.state()
        # Until the node knows who listens, it answers to nobody.
        self.send_until(self.send, lambda: self.sent not in self.unanswered, 'a first answer')
        self.unanswered.clear()

    def send(self) -> None:
        """Send a message; its stamp is its number."""
        self.sent += 1
        self._template[4:8] = self.sent.to_bytes(4, 'little')
        self.unanswered.add(self.sent)
        self._publisher.publish(bytes(self._template))

    def flip(self) -> None:
        """Replace the set of parameters by the other, all at once."""
        rule = RULES[self.flips % 2]
        self.flips += 1
        values = {name: getattr(rule, name) for name in FLIPPED}
        request = SetParametersAtomically.Request(parameters=parameters_of(values))
        future = self.call_async('set_parameters_atomically', request)
        future.add_done_callback(self._note_reply)

    def _note_reply(self, future: Future) -> None:
        self.rejected += not future.result().result.successful

    def _check(self, data: bytes) -> None:
        """Hold an answer against both sets of parameters."""
        answer = Detections(data)
        if answer.stamp[0] not in self.unanswered:
            self.unasked += 1
            return
        self.unanswered.remove(answer.stamp[0])
        sizes = answer.xywhr()[:, 2:4]
        matches = [np.array_equal(sizes, expected) for expected in self._sizes]
        if sum(matches) == 1:
            self.by_rule[matches.index(True)] += 1
        else:
            self.mixed += 1


def run(soak: Soak, minutes: float) -> list[float]:
    """Keep up the load; return the memory after every report period."""
    soak.connect()
    resident: list[float] = []

    def report() -> None:
        resident.append(soak.process.resident_megabytes())
        print(
            f'{len(resident) * REPORT_PERIOD:5.0f} s: sent {soak.sent}, by set {soak.by_rule}, '
            f'flips {soak.flips}, resident {resident[-1]:.1f} MB',
            flush=True,
        )

    soak.peer.repeat(
        60.0 * minutes,
        (MESSAGE_PERIOD, soak.send),
        (FLIP_PERIOD, soak.flip),
        (REPORT_PERIOD, report),
    )
    with contextlib.suppress(TimeoutError):
        soak.peer.spin_until(lambda: not soak.unanswered, 'the last answers', GRACE)
    return resident


def main() -> None:
    """Run the soak and judge it."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parser.add_argument('--minutes', type=float, default=10.0)
    options = parser.parse_args()
    with site_at() as site, Soak(site) as soak:
        resident = run(soak, options.minutes)
        code = soak.process.close()
    after_first_minute = resident[1:]
    growth = after_first_minute[-1] - after_first_minute[0] if after_first_minute else 0.0
    print(
        f'sent {soak.sent}, unanswered {len(soak.unanswered)}, mixed {soak.mixed}, '
        f'not asked for {soak.unasked}, by set {soak.by_rule}; {soak.flips} flips, '
        f'{soak.rejected} rejected; memory after the first minute {growth:+.1f} MB; '
        f'exit code {code}'
    )
    good = not (soak.unanswered or soak.mixed or soak.unasked or soak.rejected or code)
    sys.exit(0 if good and growth < 1.0 else 1)


if __name__ == '__main__':
    main()
