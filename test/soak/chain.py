# SPDX-License-Identifier: Apache-2.0
"""
Run conversion and chips for a long time and account for every frame and every chip.

    python test/soak/chain.py --minutes 10

Images and detections go out at a steady rate; each frame must become boxes, a crop plan and chips:
none lost, none sent twice, the memory of both nodes flat in the second half.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import sys
import time
from array import array
from collections import Counter
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.qos import QoSProfile
from rclpy.serialization import serialize_message
from sensor_msgs.msg import CameraInfo
from sensor_msgs.msg import CompressedImage
from sensor_msgs.msg import Image
from vision_msgs.msg import Detection2DArray

sys.path.insert(0, str(Path(__file__).parents[1]))

from harness import Peer
from harness import Site
from harness import site_at
from harness import time_of
from ships import detector_message

REPORT_PERIOD, GRACE = 30.0, 30.0
DEEP = QoSProfile(depth=10_000)


class Chain(ExitStack):
    """Both nodes, in separate processes, under a steady load."""

    def __init__(self, site: Site, side: int, detections: int) -> None:
        super().__init__()
        self._namespace = f'/chain_{os.getpid()}'
        self.peer = self.enter_context(Peer(site.context, self._namespace))
        self.chips: Counter[int] = Counter()
        self.places: Counter[int] = Counter()
        self.reports: dict[str, dict[str, str]] = {}
        self.reported: dict[str, float] = {}
        for kind, topic, note in (
            (CompressedImage, 'chip/compressed', self.chips),
            (CameraInfo, 'chip/camera_info', self.places),
        ):
            self.peer.node.create_subscription(
                kind, topic, lambda data, note=note: note.update((stamp_of(data),)), DEEP, raw=True
            )
        self.peer.node.create_subscription(DiagnosticArray, '/diagnostics', self._report, 10)
        size = {'image_width': side, 'image_height': side}
        # Where nothing may be lost, whatever else the machine does.
        qos = f'qos_overrides.{self._namespace}'
        reliable = {
            f'{qos}/detections.subscription.reliability': 'reliable',
            f'{qos}/detections.subscription.depth': 1000,
            f'{qos}/crop_regions.publisher.depth': 1000,
        }
        patient = {
            f'{qos}/image.subscription.depth': 100,
            'cache.max_age': 60.0,
        }
        self.processes = [
            self.enter_context(site.start(name, namespace=self._namespace, parameters=parameters))
            for name, parameters in (('obb_to_hbb', size | reliable), ('chip_extractor', patient))
        ]
        self._message = bytearray(detector_message(detections, side))
        pixels = np.random.default_rng(1).integers(0, 256, side * side).astype(np.uint8)
        image = Image(height=side, width=side, encoding='mono8', step=side)
        image.data = array('B', pixels.tobytes())
        self._image = bytearray(serialize_message(image))
        self.sent = 0

    def _report(self, message: DiagnosticArray) -> None:
        status = message.status[0]
        if status.name.startswith(self._namespace.lstrip('/')):
            values = {pair.key: pair.value for pair in status.values}
            node = status.name.rpartition('/')[2]
            self.reports[node], self.reported[node] = values, time_of(message)

    def connect(self) -> None:
        """Wait until everything is connected."""
        depths = QoSProfile(depth=1000), QoSProfile(depth=100)
        self._detections = self.peer.publisher(Detection2DArray, 'detections', depths[0])
        self._images = self.peer.publisher(Image, 'image', depths[1])
        graph = self.peer.node
        self.peer.spin_until(
            lambda: (
                graph.count_publishers('chip/compressed')
                and graph.count_subscribers('crop_regions')
                and len(self.reports) == 2
            ),
            'both nodes',
        )
        self.peer.spin_to(time.monotonic() + 1.0)

    def send(self) -> None:
        """Send a frame; its stamp is its number."""
        self.sent += 1
        for data, publisher in ((self._image, self._images), (self._message, self._detections)):
            data[4:8] = self.sent.to_bytes(4, 'little')
            publisher.publish(bytes(data))

    def settled(self) -> bool:
        """Return whether the last frame has come through."""
        return self.sent in self.chips


def stamp_of(data: bytes) -> int:
    """Read the seconds of the stamp of a serialized message with a header."""
    return int.from_bytes(data[4:8], 'little')


def run(chain: Chain, rate: float, minutes: float) -> list[list[float]]:
    """Keep up the load; return the memory after every report period."""
    chain.connect()
    resident: list[list[float]] = []

    def report() -> None:
        resident.append([process.resident_megabytes() for process in chain.processes])
        print(
            f'{len(resident) * REPORT_PERIOD:5.0f} s: sent {chain.sent}, '
            f'chips {chain.chips.total()}, resident '
            + ', '.join(f'{size:.1f} MB' for size in resident[-1]),
            flush=True,
        )

    chain.peer.repeat(60.0 * minutes, (1.0 / rate, chain.send), (REPORT_PERIOD, report))
    with contextlib.suppress(TimeoutError):
        chain.peer.spin_until(chain.settled, 'the last chips', GRACE)
    # What comes twice would come now, and the reports with the last counts.
    settled = time.time()
    chain.peer.spin_to(time.monotonic() + 1.0)
    chain.peer.spin_until(lambda: min(chain.reported.values()) > settled, 'the last counts')
    return resident


def grown(resident: list[list[float]]) -> list[float]:
    """
    Return how much memory the processes gained in the second half.

    A busy machine may raise it once; a leak goes on.
    """
    half = resident[len(resident) // 2 :]
    return np.subtract(half[-1], half[0]).round(1).tolist() if half else []


def verdict(chain: Chain) -> bool:
    """Compare what arrived with what the nodes report, and print both."""
    first, last = chain.reports['obb_to_hbb'], chain.reports['chip_extractor']

    def count(report: dict[str, Any], name: str) -> int:
        return int(report.get(name, 0))

    planned, sent = count(last, 'chips_planned'), count(last, 'chips_sent')
    dropped = {name: value for name, value in last.items() if 'dropped' in name}
    print(
        f'sent {chain.sent} frames; converted {count(first, "messages_converted")}, paired '
        f'{count(last, "frames_paired")}; chips planned {planned}, sent {sent}, arrived '
        f'{chain.chips.total()} and {chain.places.total()} places; dropped {dropped}; '
        f'lost {count(first, "messages_lost")} and {count(last, "messages_lost")}'
    )
    missing = [i for i in range(1, chain.sent + 1) if i not in chain.chips]
    if missing:
        print(f'frames without chips: {missing[:20]}')
    return (
        chain.sent == count(first, 'messages_converted') == count(last, 'frames_paired')
        and planned == sent == chain.chips.total()
        and chain.chips == chain.places
        and not dropped
        and not missing
    )


def main() -> None:
    """Run the soak and judge it."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parser.add_argument('--minutes', type=float, default=10.0)
    parser.add_argument('--side', type=int, default=512, help='of the images, pixels')
    parser.add_argument('--detections', type=int, default=100)
    parser.add_argument('--rate', type=float, default=10.0, help='frames per second')
    options = parser.parse_args()
    with site_at() as site, Chain(site, options.side, options.detections) as chain:
        resident = run(chain, options.rate, options.minutes)
        good = verdict(chain)
        codes = [process.close() for process in chain.processes]
    growth = grown(resident)
    print(f'memory grown in the second half {growth} MB; exit codes {codes}')
    sys.exit(0 if good and not any(codes) and max(growth, default=0.0) < 2.0 else 1)


if __name__ == '__main__':
    main()
