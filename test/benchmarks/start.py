# SPDX-License-Identifier: Apache-2.0
"""
Seconds from the start of a node to its first answer, over DDS, and the processor time until then.

    python test/benchmarks/start.py
    python test/benchmarks/start.py --profile config/fastdds.xml

The peer runs already, without the profile. The node has found it when it sees the subscription.
"""

from __future__ import annotations

import os
import sys
import time
from argparse import ArgumentParser
from pathlib import Path
from typing import NamedTuple

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))
from harness import Node
from harness import Peer
from harness import Site
from harness import site_at
from ships import detections
from ships import fleet
from vision_msgs.msg import Detection2DArray


class Start(NamedTuple):
    """When the subscription was seen, when the first answer came, and the time of the processor."""

    seen: float
    answered: float
    processor: float


def start(site: Site) -> Start:
    """Start the conversion, and wait for its first answer."""
    with Node(site, 'obb_to_hbb') as node:
        boxes = node.peer.collect(Detection2DArray, 'boxes')
        publisher = node.peer.node.create_publisher(Detection2DArray, 'detections', 10)
        began = time.monotonic()
        node.start(parameters={'image_width': 256, 'image_height': 256})
        node.wait(publisher.get_subscription_count, 'the subscription')
        seen = time.monotonic() - began
        message = detections(fleet(3))
        node.send_until(lambda: publisher.publish(message), lambda: boxes, 'an answer')
        return Start(seen, time.monotonic() - began, node.process.cpu_seconds())


def main() -> None:
    parser = ArgumentParser(description=__doc__.partition('\n\n')[0])
    parser.add_argument('--starts', type=int, default=20, help='how many; default: %(default)s')
    parser.add_argument('--profile', type=Path, help='Fast DDS profile of the node alone')
    options = parser.parse_args()
    with site_at() as site, Peer(site.context, '/start'):
        # The participant of the peers exists by now, and takes no profile any more.
        if options.profile:
            os.environ['FASTRTPS_DEFAULT_PROFILES_FILE'] = str(options.profile.resolve())
        starts = [start(site) for _ in range(options.starts)]
    print('seconds     median   p90   max  over 2 s')
    for name, values in zip(Start._fields, np.transpose(starts), strict=True):
        median, most = np.quantile(values, [0.5, 0.9])
        slow = f'{np.count_nonzero(values > 2.0)} of {len(values)}'
        print(f'{name:11} {median:6.2f} {most:5.2f} {values.max():5.2f}  {slow}')


if __name__ == '__main__':
    main()
