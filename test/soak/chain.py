# SPDX-License-Identifier: Apache-2.0
"""
Run conversion and chips for a long time and account for every frame and every chip.

    python test/soak/chain.py --minutes 10

Images and detections go out at a steady rate; each frame must become boxes, a crop plan and chips:
none lost, none sent twice, the memory of both nodes flat after the first minute.
"""

from __future__ import annotations

import argparse
import os
import signal
import subprocess
import sys
import time
from array import array
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import QoSProfile
from rclpy.serialization import serialize_message
from sensor_msgs.msg import CameraInfo
from sensor_msgs.msg import CompressedImage
from sensor_msgs.msg import Image
from vision_msgs.msg import Detection2DArray

sys.path.insert(0, str(Path(__file__).parents[1] / 'benchmarks'))

from node import message

NODES = ('obb_to_hbb', 'chip_extractor')
REPORT_PERIOD, GRACE = 30.0, 10.0
DEEP = QoSProfile(depth=10_000)


class Chain:
    """Both nodes, each in a process of its own, under a steady load."""

    def __init__(self, side: int, detections: int) -> None:
        self._namespace = f'/chain_{os.getpid()}'
        size = ['-p', f'image_width:={side}', '-p', f'image_height:={side}']
        arguments = ['--ros-args', '-r', f'__ns:={self._namespace}']
        self._processes = {
            name: subprocess.Popen([
                sys.executable, '-m', 'obbhbb_ros.nodes', name, *arguments,
                *(size if name == 'obb_to_hbb' else []),
            ])
            for name in NODES
        }
        self._node = rclpy.create_node('source', namespace=self._namespace)
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(self._node)
        self._detections = self._node.create_publisher(Detection2DArray, 'detections', 100)
        self._images = self._node.create_publisher(Image, 'image', 16)
        self.chips: Counter[int] = Counter()
        self.places: Counter[int] = Counter()
        self.reports: dict[str, dict[str, str]] = {}
        for kind, topic, note in (
            (CompressedImage, 'chip/compressed', self.chips),
            (CameraInfo, 'chip/camera_info', self.places),
        ):
            self._node.create_subscription(
                kind, topic, lambda data, note=note: note.update((stamp_of(data),)), DEEP, raw=True
            )
        self._node.create_subscription(DiagnosticArray, '/diagnostics', self._report, 10)
        self._message = bytearray(message(detections, side))
        pixels = np.random.default_rng(1).integers(0, 256, side * side).astype(np.uint8)
        image = Image(height=side, width=side, encoding='mono8', step=side)
        image.data = array('B', pixels.tobytes())
        self._image = bytearray(serialize_message(image))
        self.sent = 0

    def _report(self, message: DiagnosticArray) -> None:
        status = message.status[0]
        if status.name.startswith(self._namespace.lstrip('/')):
            values = {pair.key: pair.value for pair in status.values}
            self.reports[status.name.rpartition('/')[2]] = {'level': str(status.level), **values}

    def wait_for_nodes(self) -> None:
        """Wait until everything is connected."""
        deadline = time.monotonic() + 30
        while not (
            self._detections.get_subscription_count()
            and self._images.get_subscription_count()
            and self._node.count_publishers('chip/compressed')
            and self._node.count_subscribers('crop_regions')
            and len(self.reports) == len(NODES)
        ):
            if time.monotonic() > deadline:
                raise TimeoutError('the nodes do not answer')
            self._executor.spin_once(timeout_sec=0.1)
        self.spin_until(time.monotonic() + 1.0)

    def send(self) -> None:
        """Send a frame; its stamp is its number."""
        self.sent += 1
        for data, publisher in ((self._image, self._images), (self._message, self._detections)):
            data[4:8] = self.sent.to_bytes(4, 'little')
            publisher.publish(bytes(data))

    def spin_until(self, moment: float) -> None:
        """Take answers until a moment of the monotonic clock."""
        while (left := moment - time.monotonic()) > 0:
            self._executor.spin_once(timeout_sec=left)

    def resident_megabytes(self) -> list[float]:
        """Tell the memory that each node holds."""
        page = os.sysconf('SC_PAGE_SIZE') / 2**20
        return [
            int(Path(f'/proc/{process.pid}/statm').read_text().split()[1]) * page
            for process in self._processes.values()
        ]

    def stop(self) -> list[int]:
        """End the nodes; give their exit codes."""
        for process in self._processes.values():
            process.send_signal(signal.SIGINT)
        codes = [process.wait(10) for process in self._processes.values()]
        self._executor.shutdown()
        return codes


def stamp_of(data: bytes) -> int:
    """Read the seconds of the stamp of a serialized message with a header."""
    return int.from_bytes(data[4:8], 'little')


def run(chain: Chain, rate: float, minutes: float) -> list[list[float]]:
    """Keep the load up; give the memory after each report period."""
    chain.wait_for_nodes()
    started = time.monotonic()
    next_send, next_report = started, started + REPORT_PERIOD
    resident = []
    while time.monotonic() < started + 60 * minutes:
        now = time.monotonic()
        if now >= next_send:
            chain.send()
            next_send += 1.0 / rate
        if now >= next_report:
            resident.append(chain.resident_megabytes())
            print(
                f'{now - started:5.0f} s: sent {chain.sent}, chips {chain.chips.total()}, resident '
                + ', '.join(f'{each:.1f} MB' for each in resident[-1]), flush=True,
            )
            next_report += REPORT_PERIOD
        chain.spin_until(min(next_send, next_report))
    chain.spin_until(time.monotonic() + GRACE)
    return resident


def verdict(chain: Chain) -> bool:
    """Hold what arrived against what the nodes say, and print it."""
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
        and planned == sent == chain.chips.total() and chain.chips == chain.places
        and not dropped and not missing
    )


def main() -> None:
    """Run the soak and judge it."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parser.add_argument('--minutes', type=float, default=10.0)
    parser.add_argument('--side', type=int, default=512, help='of the images, pixels')
    parser.add_argument('--detections', type=int, default=100)
    parser.add_argument('--rate', type=float, default=10.0, help='frames per second')
    options = parser.parse_args()
    rclpy.init()
    chain = Chain(options.side, options.detections)
    try:
        resident = run(chain, options.rate, options.minutes)
        good = verdict(chain)
    finally:
        codes = chain.stop()
        rclpy.try_shutdown()
    growth = np.subtract(resident[-1], resident[1]) if len(resident) > 2 else np.zeros(2)
    print(f'memory after the first minute {growth.round(1).tolist()} MB; exit codes {codes}')
    sys.exit(0 if good and not any(codes) and (growth < 2.0).all() else 1)


if __name__ == '__main__':
    main()
