# SPDX-License-Identifier: Apache-2.0
"""Flies over a harbour with real nodes, and brings a fifth of what they cut to the ground."""

from __future__ import annotations

from collections.abc import Mapping
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path
from typing import Any
from typing import NamedTuple

from geometry_msgs.msg import PoseStamped
from sensor_msgs.msg import CameraInfo
from sensor_msgs.msg import Image
from vision_msgs.msg import Detection2DArray

from obbhbb_ros.nodes.demo_chain import DemoChain
from obbhbb_ros.spool.books import Status
from obbhbb_ros.spool.console import SpoolConsole
from obbhbb_ros.wire.detections import Detections

# From orbit, at a metre a pixel.
_PASS = {
    'rate': 4.0,
    'pass_height': 300,
    'pass_step': 40,
    'pass_altitude': 500e3,
    'pass_latitude': 54.1675,
    'pass_longitude': 12.1012,
}
# Bytes of the JSON of a chip.
_JSON = 900
_SHARE = 0.2
# Seconds for what was discovered to connect, and without change when all has come.
_SETTLED = 2.0
# How many times that is waited for: an image may be lost.
_MAX_WAITS = 15


class FlownPass(NamedTuple):
    """Chips that were cut in a pass, and those that came down, with the number of their ships."""

    chips: int
    ships: int
    chips_down: int
    ships_down: int


def fly_over(images: Path, folder: Path) -> FlownPass:
    """
    Fly over images with labels, with a tracker, and let the link take a fifth of the bytes.

    Parameters
    ----------
    images : Path
        Folder of the images and their labels.
    folder : Path
        Folder for spool and outbox, which must not exist there yet.

    Returns
    -------
    FlownPass
        What came of it.

    Raises
    ------
    TimeoutError, ChildProcessError
        If the nodes do not answer in time, or end.
    """
    images, folder = images.absolute(), folder.absolute()
    spool = {'spool.path': folder / 'spool'}
    nodes = {
        'ship_tracker': _given(
            {'ids': 'assign', 'pose_type': 'PoseStamped', 'report_period': 1.0} | spool
        ),
        'obb_to_hbb': ['-r', 'detections:=tracked_detections'],
        'chip_extractor': _given(spool),
    }
    with DemoChain(nodes) as chain, closing(SpoolConsole(folder / 'spool', _ignore)) as console:
        plans = _connect(chain)
        chain.start('play_detections', _given({'path': images} | _PASS))
        chain.spin_to_end_of('play_detections')
        cut = _settled(chain, console, plans)
        room = _SHARE * (cut.waiting_bytes + _JSON * cut.waiting)
        link = {'outbox.path': folder / 'outbox', 'outbox.max_bytes': room}
        chain.start('downlink', _given(spool | link | {'acknowledge': 'removal'}))
        chain.spin_until(lambda: console.status().in_outbox > 0, 'chip in the outbox')
        down = _settled(chain, console, plans)
    counts = down.counts
    return FlownPass(
        cut.waiting, cut.objects_waiting, down.in_outbox, counts.get('objects_released', 0)
    )


def _connect(chain: DemoChain) -> list[bytes]:
    """Send empty messages until all nodes hear one another; return the list of crop plans."""
    node = chain.node
    plans: list[bytes] = []
    node.create_subscription(Detection2DArray, 'crop_regions', plans.append, 10, raw=True)
    # They remain, so that the nodes already listen reliably when the player comes.
    for kind, topic in ((PoseStamped, 'camera_pose'), (Image, 'image')):
        node.create_publisher(kind, topic, 10)
    cameras = node.create_publisher(CameraInfo, 'camera_info', 10)
    publisher = node.create_publisher(Detection2DArray, 'detections', 10)

    def send() -> None:
        cameras.publish(CameraInfo(width=1024, height=300))
        publisher.publish(Detection2DArray())

    # This node, and `chip_extractor`.
    chain.spin_until(
        lambda: bool(plans) and node.count_subscribers('crop_regions') > 1, 'crop regions', send
    )
    chain.spin_for(_SETTLED)
    return plans


def _settled(chain: DemoChain, console: SpoolConsole, plans: Sequence[bytes]) -> Status:
    """Return the books of a spool when they have come to rest, with all chips that are planned."""
    last = console.status()
    for _ in range(_MAX_WAITS):
        chain.spin_for(_SETTLED)
        status = console.status()
        cut = status.counts.get('planned', 0) - status.in_work
        if status == last and cut >= sum(len(Detections(data)) for data in plans):
            break
        last = status
    return last


def _given(parameters: Mapping[str, Any]) -> list[str]:
    """Write parameters as arguments after `--ros-args`."""
    return [text for name, value in parameters.items() for text in ('-p', f'{name}:={value}')]


def _ignore(trouble: str) -> None:
    """Leave it to the nodes, which report it as well."""
