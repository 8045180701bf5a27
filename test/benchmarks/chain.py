# SPDX-License-Identifier: Apache-2.0
"""
What the whole chain takes: processor time, memory, and latency from an image to its chips.

A camera of 1024 x 1024 colour pixels and a detector of 20 ships at 10 Hz; the four nodes, each in
a process of its own and then all in one, in turn, with a spool and an outbox. With `--against`
another checkout of the package runs in turn with this one instead.
`python test/benchmarks/chain.py --help`
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
import time
from array import array
from contextlib import ExitStack
from pathlib import Path
from statistics import median

import numpy as np
from rclpy.qos import QoSProfile
from rclpy.serialization import serialize_message
from sensor_msgs.msg import CompressedImage
from sensor_msgs.msg import Image
from vision_msgs.msg import Detection2DArray

sys.path.insert(0, str(Path(__file__).parents[1]))

from harness import NodeProcess
from harness import Peer
from harness import Site
from harness import payload_process
from harness import site_at
from ships import detector_message

from obbhbb_ros.text_tables import text_table

ROOT = Path(__file__).parents[2]
SIDE, SHIPS = 1024, 20
NODES = ('obb_to_hbb', 'chip_extractor', 'downlink', 'overlay')
FIRST_FRAMES = 10
FIGURES = (
    *(f'{node} [ms/frame]' for node in NODES),
    'CPU [ms/frame]',
    'PSS [MB]',
    'first chip [ms]',
    'last chip [ms]',
    'in the outbox [chips/frame]',
)


def image_bytes() -> bytearray:
    """Write an image of smooth noise, which compresses as a sea does."""
    random = np.random.default_rng(1)
    coarse = random.integers(40, 90, (SIDE // 8, SIDE // 8, 3)).astype(np.uint8)
    pixels = coarse.repeat(8, axis=0).repeat(8, axis=1) + random.integers(
        0, 8, (SIDE, SIDE, 3)
    ).astype(np.uint8)
    image = Image(height=SIDE, width=SIDE, encoding='rgb8', step=3 * SIDE)
    image.data = array('B', pixels.tobytes())
    return bytearray(serialize_message(image))


def pss_megabytes(process: NodeProcess) -> float:
    """Read the memory of a process, with its share of what it shares."""
    lines = Path(f'/proc/{process.pid}/smaps_rollup').read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith('Pss:')) / 1024


class MeasuredChain(ExitStack):
    """The nodes of a checkout, and what feeds them."""

    def __init__(self, site: Site, checkout: Path, folder: Path, one_process: bool) -> None:
        super().__init__()
        self.outbox = folder / 'outbox'
        namespace = f'/chain_{os.getpid()}_{folder.name}'
        self._peer = self.enter_context(Peer(site.context, namespace))
        self._arrivals: list[float] = []
        self._peer.node.create_subscription(
            CompressedImage, 'chip/compressed', self._note_chip, QoSProfile(depth=1000), raw=True
        )
        size = {'image_width': SIDE, 'image_height': SIDE}
        spool = {'spool.path': folder / 'spool'}
        parameters = dict(
            zip(NODES, (size, spool, spool | {'outbox.path': self.outbox}, {}), strict=True)
        )
        # `python -m` looks for the package here before anywhere else.
        os.chdir(checkout)
        started = (
            [payload_process(folder, namespace, parameters)]
            if one_process
            else [
                NodeProcess(node, namespace=namespace, parameters=parameters[node])
                for node in NODES
            ]
        )
        self.processes = [self.enter_context(process) for process in started]
        self._image, self._message = image_bytes(), bytearray(detector_message(SHIPS, SIDE))
        self._images = self._peer.publisher(Image, 'image', QoSProfile(depth=100))
        self._detections = self._peer.publisher(Detection2DArray, 'detections')
        graph = self._peer.node
        self._peer.spin_until(
            lambda: (
                graph.count_publishers('chip/compressed')
                and graph.count_subscribers('crop_regions')
            ),
            'the chain',
        )
        self._sent = 0

    def _note_chip(self, _: bytes) -> None:
        self._arrivals.append(time.perf_counter())

    def frame(self) -> tuple[float, float]:
        """Send a frame; milliseconds to its first and its last chip, NaN if they do not come."""
        self._sent += 1
        self._arrivals.clear()
        started = time.perf_counter()
        for data, publisher in ((self._image, self._images), (self._message, self._detections)):
            data[4:8] = self._sent.to_bytes(4, 'little')
            publisher.publish(bytes(data))
        self._peer.spin_to(time.monotonic() + 0.1)
        if not self._arrivals:
            return float('nan'), float('nan')
        return tuple((end - started) * 1e3 for end in (self._arrivals[0], self._arrivals[-1]))

    def measure(self, seconds: float) -> list[float]:
        """Keep a steady load for some time; give a row of figures."""
        for _ in range(FIRST_FRAMES):
            self.frame()
        before = [process.cpu_seconds() for process in self.processes]
        files = self._files_delivered()
        latencies = [self.frame() for _ in range(int(seconds * 10))]
        count = len(latencies)
        after = [process.cpu_seconds() for process in self.processes]
        spent = [(end - start) / count * 1e3 for start, end in zip(before, after, strict=True)]
        first, last = np.nanmedian(np.array(latencies), axis=0)
        delivered = (self._files_delivered() - files) / count
        pss = sum(map(pss_megabytes, self.processes))
        by_node = spent if len(spent) == len(NODES) else [float('nan')] * len(NODES)
        return [*by_node, sum(spent), pss, float(first), float(last), delivered]

    def _files_delivered(self) -> int:
        return sum(1 for _ in self.outbox.glob('*/*.jpg'))


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parser.add_argument('--against', type=Path, help='another checkout of the package')
    parser.add_argument('--rounds', type=int, default=3)
    parser.add_argument('--seconds', type=float, default=8.0, help='of each round')
    options = parser.parse_args()
    # By heading: the checkout, and whether all nodes are in one process.
    ways = {'four processes': (ROOT, False), 'one process': (ROOT, True)}
    if options.against:
        against = options.against.resolve()
        ways = {str(checkout): (checkout, False) for checkout in (ROOT, against)}
    rows: dict[str, list[list[float]]] = {way: [] for way in ways}
    with site_at() as site, tempfile.TemporaryDirectory() as scratch:
        for i in range(options.rounds):
            for k, (way, (checkout, one_process)) in enumerate(ways.items()):
                folder = Path(scratch) / f'round{i}{k}'
                with MeasuredChain(site, checkout, folder, one_process) as chain:
                    rows[way].append(chain.measure(options.seconds))
    columns = [map(spread, zip(*rows[way], strict=True)) for way in ways]
    print(f'{SHIPS} ships at 10 Hz, {options.rounds} rounds of {options.seconds:g} s: median (all)')
    print(text_table(('', *ways), list(zip(FIGURES, *columns, strict=True))))


def spread(values: tuple[float, ...]) -> str:
    """Write a median, and the values it is of."""
    return f'{median(values):.1f} ({", ".join(f"{value:.1f}" for value in values)})'


if __name__ == '__main__':
    main()
