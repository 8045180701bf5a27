# SPDX-License-Identifier: Apache-2.0
"""
Clean up and configure nodes again and again while their publishers and subscribers come and go.

    python test/soak/cycles.py --cycles 60
    python test/soak/cycles.py --executor rclpy.experimental:EventsExecutor

The node must survive and end with exit code 0. With another executor this is the first half of the
test described in doc/executor.md.
"""

from __future__ import annotations

import argparse
import random
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import rclpy
from lifecycle_msgs.msg import Transition
from rclpy.context import Context
from sensor_msgs.msg import CompressedImage
from sensor_msgs.msg import Image
from vision_msgs.msg import Detection2DArray

sys.path.insert(0, str(Path(__file__).parents[1]))

from executors import OURS
from harness import Node
from harness import NodeProcess
from harness import Site
from harness import site_at

TEST = Path(__file__).parents[1]
OUTPUTS = {'overlay': 'overlay/compressed', 'chip_extractor': 'chip/compressed'}
INPUTS = {'boxes': Detection2DArray, 'crop_regions': Detection2DArray, 'image': Image}
CYCLE = (
    Transition.TRANSITION_DEACTIVATE,
    Transition.TRANSITION_CLEANUP,
    Transition.TRANSITION_CONFIGURE,
    Transition.TRANSITION_ACTIVATE,
)
MAX_PAUSE = 0.02


def come_and_go(context: Context, namespace: str, output: str, end: threading.Event) -> None:
    """Subscribe to the output of a node and publish on its inputs, for moments."""
    node = rclpy.create_node('passer_by', namespace=namespace, context=context)
    source = random.Random(1)
    while not end.is_set():
        subscriptions = [
            node.create_subscription(CompressedImage, output, lambda _: None, 10, raw=True)
            for _ in range(4)
        ]
        publishers = [node.create_publisher(kind, topic, 10) for topic, kind in INPUTS.items()]
        time.sleep(source.uniform(0.0, MAX_PAUSE))
        for publisher in publishers:
            publisher.publish(publisher.msg_type())
        for subscription in subscriptions:
            node.destroy_subscription(subscription)
        for publisher in publishers:
            node.destroy_publisher(publisher)
    node.destroy_node()


@contextmanager
def visited(context: Context, namespace: str, output: str) -> Iterator[None]:
    """Let publishers and subscribers come and go as long as the `with` block lasts."""
    end = threading.Event()
    thread = threading.Thread(target=come_and_go, args=(context, namespace, output, end))
    thread.start()
    try:
        yield
    finally:
        end.set()
        thread.join()


def survives(site: Site, executor: str, executable: str, cycles: int) -> bool:
    """Put a node through the cycles, and return whether it survived them."""
    command = [sys.executable, str(TEST / 'executors.py'), executor, executable]
    done = 0
    with Node(site, executable) as node:
        log = site.folder / f'{executable}.log'
        node.process = NodeProcess(command, log, namespace=node.namespace)
        node.wait(lambda: node.state() == 'active', 'the active state')
        with visited(site.context, node.namespace, OUTPUTS[executable]):
            try:
                while done < cycles:
                    if not all(node.change_state(transition) for transition in CYCLE):
                        raise ChildProcessError('a transition was refused')
                    done += 1
            except (ChildProcessError, TimeoutError) as error:
                print(error)
        code = node.process.close()
    print(f'{executable}: {done} of {cycles} cycles, exit code {code}', flush=True)
    return done == cycles and code == 0


def main() -> None:
    """Run the cycles and judge."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parser.add_argument('--cycles', type=int, default=60)
    parser.add_argument('--executor', default=OURS, help='module:class')
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder, site_at(Path(folder)) as site:
        survived = [survives(site, options.executor, name, options.cycles) for name in OUTPUTS]
    sys.exit(0 if all(survived) else 1)


if __name__ == '__main__':
    main()
