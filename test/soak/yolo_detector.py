# SPDX-License-Identifier: Apache-2.0
"""
Run the real nodes of yolo_ros in front of ours, with a network of random weights.

    git clone https://github.com/mgonzs13/yolo_ros
    python -m venv yolo
    yolo/bin/pip install '.[jazzy,chips]' ultralytics lap ./test/interfaces/*_msgs
    yolo/bin/python test/soak/yolo_detector.py yolo_ros --rate 30 --seconds 60

Needs an environment with Ultralytics, and a checkout of yolo_ros; no weights are downloaded. Its
boxes mean nothing, but numbers, stamps and corners have to come through: each box is compared with
the formula. `cv_bridge`, `message_filters` and a service of yolo_msgs, which PyPI lacks, have
stand-ins here if they are missing; without `message_filters` the tracker does not run.
"""

from __future__ import annotations

import argparse
import importlib
import importlib.util
import subprocess
import sys
import tempfile
import time
from array import array
from contextlib import ExitStack
from pathlib import Path
from statistics import median
from types import ModuleType
from types import SimpleNamespace
from typing import Any

import numpy as np
from numpy.typing import NDArray

sys.path.insert(0, str(Path(__file__).parents[1]))

WIDTH, HEIGHT = 640, 480
NAMESPACE = '/yolo_soak'
# Random weights give every class a score near zero.
DETECTOR = {
    'device': 'cpu',
    'threshold': 1e-9,
    'max_det': 40,
    # They overlap nearly all.
    'iou': 0.9,
    'imgsz_height': 256,
    'imgsz_width': 320,
    'image_reliability': 1,
}
START, GRACE = 120.0, 10.0


# In the process of yolo_ros -------------------------------------------------------------------


class CvBridge:
    """Stand-in for that of cv_bridge: images of one encoding."""

    def imgmsg_to_cv2(self, message: Any, *_: Any, **__: Any) -> NDArray[np.uint8]:
        """Return the pixels of a bgr8 image."""
        pixels = np.frombuffer(message.data, np.uint8)
        return pixels.reshape(message.height, message.width, 3)


def stand_in(name: str, **attributes: Any) -> None:
    """Provide a module, if it is missing."""
    if importlib.util.find_spec(name) is None:
        module = ModuleType(name)
        vars(module).update(attributes)
        sys.modules[name] = module


def run_detector(checkout: Path, node: str) -> None:
    """Run a node of yolo_ros; its arguments are in `sys.argv`."""
    sys.path.insert(0, str(checkout / 'yolo_ros'))
    stand_in('cv_bridge', CvBridge=CvBridge)
    stand_in('yolo_msgs.srv', SetClasses=SimpleNamespace(Request=None, Response=None))
    importlib.import_module(f'yolo_ros.{node}').main()


def make_model(path: Path) -> None:
    """Write an OBB network with random weights."""
    from ultralytics import YOLO

    YOLO('yolo11n-obb.yaml').save(path)


# In our process -------------------------------------------------------------------------------


def formula(detections: Any) -> NDArray[np.float64]:
    """Work out the boxes, (N, 4) of center and size: superellipse with q 3, so p 3/2."""
    rows = []
    for detection in detections:
        box = detection.bbox
        cos, sin = abs(np.cos(box.center.theta)), abs(np.sin(box.center.theta))
        x, y = box.size.x, box.size.y
        size = (
            ((x * cos) ** 1.5 + (y * sin) ** 1.5) ** (2 / 3),
            ((x * sin) ** 1.5 + (y * cos) ** 1.5) ** (2 / 3),
        )
        rows.append((box.center.position.x, box.center.position.y, *size))
    return np.reshape(rows, (-1, 4))


def boxes_of(message: Any) -> NDArray[np.float64]:
    """Read the boxes of a message, (N, 4) of center and size."""
    rows = [
        (box.center.position.x, box.center.position.y, box.size_x, box.size_y)
        for box in (detection.bbox for detection in message.detections)
    ]
    return np.reshape(rows, (-1, 4))


class Run:
    """Camera, yolo_ros, `obb_to_hbb` and `chip_extractor`, and everything that they send."""

    def __init__(self, stack: ExitStack, checkout: Path, folder: Path) -> None:
        from harness import NodeProcess
        from harness import Peer
        from harness import site_at
        from sensor_msgs.msg import CompressedImage
        from sensor_msgs.msg import Image
        from vision_msgs.msg import Detection2DArray
        from yolo_msgs.msg import DetectionArray

        site = stack.enter_context(site_at(folder))
        self.peer = stack.enter_context(Peer(site.context, NAMESPACE))
        self.detected: dict[int, Any] = {}
        self.latencies: list[float] = []
        self.boxes: dict[int, Any] = {}
        self.plans: dict[int, Any] = {}
        self.tracked: dict[int, Any] = {}
        self.chips: list[bytes] = []
        for kind, topic, note in (
            (DetectionArray, 'detections', self._note_detections),
            (DetectionArray, 'tracking', lambda message: self._note(self.tracked, message)),
            (Detection2DArray, 'boxes', lambda message: self._note(self.boxes, message)),
            (Detection2DArray, 'crop_regions', lambda message: self._note(self.plans, message)),
        ):
            self.peer.node.create_subscription(kind, topic, note, 100)
        self.peer.node.create_subscription(
            CompressedImage, 'chip/compressed', self.chips.append, 1000, raw=True
        )
        model = folder / 'random-obb.pt'
        subprocess.run([sys.executable, __file__, '--make-model', model], check=True)
        nodes: dict[str, dict[str, Any]] = {'yolo_node': {**DETECTOR, 'model': model}}
        if importlib.util.find_spec('message_filters'):
            nodes['tracking_node'] = {'image_reliability': 1}
        size = {'image_width': WIDTH, 'image_height': HEIGHT}
        converter = {'input_type': 'DetectionArray', **size}
        self.processes = [
            *(
                stack.enter_context(
                    NodeProcess(
                        [sys.executable, __file__, str(checkout), '--node', node],
                        folder / f'{node}.log',
                        ['-r', 'image_raw:=image'],
                        parameters,
                        NAMESPACE,
                    )
                )
                for node, parameters in nodes.items()
            ),
            stack.enter_context(
                site.start('obb_to_hbb', namespace=NAMESPACE, parameters=converter)
            ),
            stack.enter_context(site.start('chip_extractor', namespace=NAMESPACE)),
        ]
        self.sent: list[int] = []
        self._images = self.peer.node.create_publisher(Image, 'image', 10)
        noise = np.random.default_rng(1).integers(0, 256, WIDTH * HEIGHT * 3).astype(np.uint8)
        self._image = Image(height=HEIGHT, width=WIDTH, encoding='bgr8', step=3 * WIDTH)
        self._image.data = array('B', noise.tobytes())

    def connect(self) -> None:
        """Wait until images reach the detector, and its detections our node."""
        graph = self.peer.node
        self.peer.spin_until(
            lambda: (
                self._images.get_subscription_count() >= len(self.processes) - 1
                and graph.count_subscribers('detections') > 1
                and graph.count_publishers('boxes')
                and graph.count_publishers('chip/compressed')
            ),
            'all nodes; their logs are in the folder',
            START,
        )
        self.peer.spin_to(time.monotonic() + 1.0)

    def send(self) -> None:
        """Send an image; its stamp is the time."""
        now = time.time_ns()
        stamp = self._image.header.stamp
        stamp.sec, stamp.nanosec = divmod(now, 10**9)
        self._images.publish(self._image)
        self.sent.append(now)

    def _note_detections(self, message: Any) -> None:
        self._note(self.detected, message)
        self.latencies.append(time.time() - stamp_of(message) / 1e9)

    @staticmethod
    def _note(messages: dict[int, Any], message: Any) -> None:
        messages[stamp_of(message)] = message

    def report(self) -> bool:
        """Print what came; return whether it is right."""
        if not self.detected:
            print('no detections; the logs say why')
            return False
        worst = max(
            float(
                np.max(np.abs(boxes_of(self.boxes[stamp]) - formula(message.detections)), initial=0)
            )
            if stamp in self.boxes and len(self.boxes[stamp].detections) == len(message.detections)
            else np.inf
            for stamp, message in self.detected.items()
        )
        foreign = len(self.detected.keys() - set(self.sent))
        planned = sum(len(plan.detections) for plan in self.plans.values())
        moved = len(self.tracked.keys() - self.detected.keys())
        print(
            f'{len(self.sent)} images, {len(self.detected)} messages of yolo_ros with '
            f'{sum(len(message.detections) for message in self.detected.values())} boxes, '
            f'{foreign} with a stamp of no image\n'
            f'latency {median(self.latencies):.2f} s, at most {max(self.latencies):.2f} s\n'
            f'worst box {worst:.2g} px from the formula; inf: missing\n'
            f'{planned} chips planned, {len(self.chips)} cut\n'
            f'/tracking: {len(self.tracked)} messages, {moved} with the stamp of an image that was '
            'not searched'
        )
        return worst < 1e-6 and not foreign


def stamp_of(message: Any) -> int:
    """Return the stamp of a message, nanoseconds."""
    stamp = message.header.stamp
    return int(stamp.sec) * 10**9 + int(stamp.nanosec)


def main() -> int:
    """Run for some time; exit with 1 if a box is wrong or missing."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument('checkout', type=Path, nargs='?', help='checkout of yolo_ros')
    parser.add_argument('--rate', type=float, default=5.0, help='images per second')
    parser.add_argument('--seconds', type=float, default=60.0)
    parser.add_argument('--logs', type=Path, help='folder for the logs; default: a temporary one')
    parser.add_argument('--node', help=argparse.SUPPRESS)
    parser.add_argument('--make-model', type=Path, help=argparse.SUPPRESS)
    options, _ = parser.parse_known_args()
    if options.make_model:
        make_model(options.make_model)
        return 0
    if options.node:
        run_detector(options.checkout, options.node)
        return 0
    with tempfile.TemporaryDirectory() as temporary, ExitStack() as stack:
        folder = options.logs or Path(temporary)
        folder.mkdir(parents=True, exist_ok=True)
        run = Run(stack, options.checkout, folder)
        run.connect()
        run.peer.repeat(options.seconds, (1.0 / options.rate, run.send))
        run.peer.spin_to(time.monotonic() + GRACE)
        return 0 if run.report() else 1


if __name__ == '__main__':
    sys.exit(main())
