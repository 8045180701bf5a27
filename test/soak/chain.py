# SPDX-License-Identifier: Apache-2.0
"""
Run conversion and chips for a long time and account for every frame and every chip.

    python test/soak/chain.py --minutes 10

Images and detections go out at a steady rate; each frame must become boxes, a crop plan and chips:
none lost, none sent twice, the memory of both nodes flat in the second half.

    python test/soak/chain.py --minutes 60 --rate 5 --detections 20 --one-process

The same with `downlink`, in one process, while chips pass through a spool and an outbox.

    python test/soak/chain.py --minutes 10 --encoding yuv422 --binning 2 --moving-window

The window of the camera moves from image to image. Every chip must have its place on the sensor,
and the first one of every image the pixels of that place in that image.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import os
import sys
import time
from array import array
from collections import Counter
from collections import defaultdict
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any
from typing import NamedTuple

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from numpy.typing import NDArray
from PIL import Image as Picture
from rclpy.qos import QoSProfile
from rclpy.serialization import serialize_message
from sensor_msgs.msg import CameraInfo
from sensor_msgs.msg import CompressedImage
from sensor_msgs.msg import Image
from vision_msgs.msg import Detection2DArray

sys.path.insert(0, str(Path(__file__).parents[1]))

from harness import Peer
from harness import Site
from harness import payload_process
from harness import site_at
from harness import time_of
from ships import detector_message

from obbhbb_ros.wire.camera import read_camera
from obbhbb_ros.wire.image import read_compressed_image

REPORT_PERIOD, GRACE = 30.0, 30.0
# At start, camera infos may be received later than images: before these frames it is not known
# whether they have the same stamps.
WARM_UP = 50
DEEP = QoSProfile(depth=10_000)


class Scene(NamedTuple):
    """What the camera sees: square images of a moving window, if it moves."""

    side: int
    encoding: str = 'mono8'
    binning: int = 1
    moves: bool = False

    def window(self, frame: int) -> tuple[int, int]:
        """Return where on the sensor the image of a frame begins."""
        if not self.moves:
            return 0, 0
        return (
            2 * self.binning * (31 * frame % self.side),
            2 * self.binning * (17 * frame % self.side),
        )

    def camera(self, frame: int) -> CameraInfo:
        """Return the camera info of a frame."""
        info = CameraInfo(width=4 * self.side * self.binning, height=4 * self.side * self.binning)
        info.header.stamp.sec = frame
        info.binning_x = info.binning_y = self.binning
        info.roi.x_offset, info.roi.y_offset = self.window(frame)
        info.roi.width = info.roi.height = self.side * self.binning
        return info

    def image(self, frame: int) -> bytes:
        """Return the pixels of a frame."""
        luma = self.luma(frame)
        if self.encoding == 'mono8':
            return luma.tobytes()
        stored = np.full((self.side, 2 * self.side), 128, np.uint8)
        stored[:, 1::2] = luma
        return stored.tobytes()

    def luma(self, frame: int) -> NDArray[np.uint8]:
        """Return the brightness of a frame, different at every place and in every image."""
        rows, columns = np.ogrid[: self.side, : self.side]
        return (((columns + 3 * rows + 37 * frame) & 127) + 40).astype(np.uint8)

    def shows(self, file: bytes, frame: int, place: tuple[int, int, int, int]) -> bool:
        """Return whether a chip has the pixels of its place, given on the sensor."""
        with Picture.open(io.BytesIO(file)) as picture:
            grey = np.asarray(picture.convert('L')).astype(float)
        (x, y), (left, top, width, height) = self.window(frame), place
        x, y = (left - x) // self.binning, (top - y) // self.binning
        width, height = width // self.binning, height // self.binning
        expected = self.luma(frame)[y : y + height, x : x + width].astype(float)
        if self.encoding != 'mono8':
            expected = (expected - 16.0) * 255.0 / 219.0
        return grey.shape == expected.shape and bool(np.abs(grey - expected).max() <= 2.0)


class Witness:
    """Compares places and pixels of the chips with the scene."""

    def __init__(self, scene: Scene) -> None:
        self._scene = scene
        self._first: dict[int, dict[str, Any]] = defaultdict(dict)
        self.regions: dict[int, Counter[tuple[int, ...]]] = defaultdict(Counter)
        self.checked = self.wrong = 0

    def see(self, topic: str, data: bytes) -> None:
        """Take a message on a topic of the chips."""
        frame = stamp_of(data)
        if topic == 'chip/camera_info':
            camera = read_camera(data)
            x, y = self._scene.window(frame)
            left, top, width, height = camera.roi
            self.regions[frame][left - x, top - y, width, height] += 1
            stamp, seen = camera.stamp, camera.roi
        else:
            chip = read_compressed_image(data)
            stamp, seen = chip.stamp, bytes(chip.data)
        if stamp[1]:
            return
        first = self._first[frame]
        first[topic] = seen
        if len(first) == 2:
            del self._first[frame]
            self.checked += 1
            place, file = first['chip/camera_info'], first['chip/compressed']
            self.wrong += frame > WARM_UP and not self._scene.shows(file, frame, place)

    def misplaced(self) -> list[int]:
        """List the frames whose chips are not where those of the last frame are."""
        expected = self.regions[max(self.regions, default=0)]
        return [
            frame
            for frame, regions in self.regions.items()
            if frame > WARM_UP and regions != expected
        ]


class Chain(ExitStack):
    """Both nodes, in separate processes or in one, under a steady load."""

    def __init__(self, site: Site, scene: Scene, detections: int, folder: Path | None) -> None:
        super().__init__()
        side = scene.side
        self._scene, self.witness = scene, Witness(scene)
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
                kind, topic, partial(self._note, topic, note), DEEP, raw=True
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
            'codec': 'png',
        }
        parameters = {'obb_to_hbb': size | reliable, 'chip_extractor': patient}
        self._outbox = folder / 'outbox' if folder else None
        if folder:
            spool = {'spool.path': folder / 'spool'}
            patient |= spool | {'spool.max_bytes': 20e6}
            parameters['downlink'] = spool | {'outbox.path': self._outbox}
        started = (
            [payload_process(folder, self._namespace, parameters)]
            if folder
            else [
                site.start(name, namespace=self._namespace, parameters=values)
                for name, values in parameters.items()
            ]
        )
        self.processes = [self.enter_context(process) for process in started]
        self._message = bytearray(detector_message(detections, side))
        pixels = scene.image(0)
        step = len(pixels) // side
        image = Image(height=side, width=side, encoding=scene.encoding, step=step)
        image.data = array('B', pixels)
        self._image = bytearray(serialize_message(image))
        self._pixels_at = len(self._image) - len(pixels)
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
        self._cameras = self.peer.publisher(CameraInfo, 'camera_info', depths[0])
        graph = self.peer.node
        self.peer.spin_until(
            lambda: (
                graph.count_publishers('chip/compressed')
                and self._cameras.get_subscription_count() == 2
                and graph.count_subscribers('crop_regions')
                and {'obb_to_hbb', 'chip_extractor'} <= self.reports.keys()
            ),
            'both nodes',
        )
        self.peer.spin_to(time.monotonic() + 1.0)

    def collect(self) -> None:
        """Take the chips out of the outbox, as a bus does."""
        for file in self._outbox.glob('*/*') if self._outbox else ():
            file.unlink(missing_ok=True)

    def send(self) -> None:
        """Send a frame; its stamp is its number."""
        self.sent += 1
        self._cameras.publish(self._scene.camera(self.sent))
        self._image[self._pixels_at :] = self._scene.image(self.sent)
        for data, publisher in ((self._image, self._images), (self._message, self._detections)):
            data[4:8] = self.sent.to_bytes(4, 'little')
            publisher.publish(bytes(data))

    def _note(self, topic: str, note: Counter[int], data: bytes) -> None:
        """Count a message of a chip, and look at it."""
        note[stamp_of(data)] += 1
        self.witness.see(topic, data)

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

    jobs = (1.0 / rate, chain.send), (REPORT_PERIOD, report), (1.0, chain.collect)
    chain.peer.repeat(60.0 * minutes, *jobs)
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
    misplaced = chain.witness.misplaced()
    print(
        f'{chain.witness.checked} first chips compared with their image, {chain.witness.wrong} '
        f'differ; frames with misplaced chips: {misplaced[:20]}; camera_info by stamp '
        f'{count(last, "camera_info_by_stamp")}, latest {count(last, "camera_info_latest")}'
    )
    if missing:
        print(f'frames without chips: {missing[:20]}')
    return (
        chain.sent == count(first, 'messages_converted') == count(last, 'frames_paired')
        and planned == sent == chain.chips.total()
        and chain.chips == chain.places
        and not dropped
        and not missing
        and not misplaced
        and chain.witness.checked == chain.sent
        and not chain.witness.wrong
        and count(last, 'camera_info_latest') <= WARM_UP
    )


def main() -> None:
    """Run the soak and judge it."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parser.add_argument('--minutes', type=float, default=10.0)
    parser.add_argument('--side', type=int, default=512, help='of the images, pixels')
    parser.add_argument('--detections', type=int, default=100)
    parser.add_argument('--rate', type=float, default=10.0, help='frames per second')
    parser.add_argument('--encoding', choices=('mono8', 'yuv422'), default='mono8')
    parser.add_argument('--binning', type=int, default=1, help='of the camera')
    parser.add_argument(
        '--moving-window', action='store_true', help='another part of the sensor for every image'
    )
    parser.add_argument(
        '--one-process', action='store_true', help='both nodes and downlink, with a spool, in one'
    )
    options = parser.parse_args()
    scene = Scene(options.side, options.encoding, options.binning, options.moving_window)
    with site_at() as site, TemporaryDirectory() as scratch:
        folder = Path(scratch) if options.one_process else None
        with Chain(site, scene, options.detections, folder) as chain:
            resident = run(chain, options.rate, options.minutes)
            good = verdict(chain)
            codes = [process.close() for process in chain.processes]
    growth = grown(resident)
    print(f'memory grown in the second half {growth} MB; exit codes {codes}')
    sys.exit(0 if good and not any(codes) and max(growth, default=0.0) < 2.0 else 1)


if __name__ == '__main__':
    main()
