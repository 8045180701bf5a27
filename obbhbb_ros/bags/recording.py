# SPDX-License-Identifier: Apache-2.0
"""Writes received messages, as bytes, to a bag."""

from __future__ import annotations

from collections.abc import Iterable
from collections.abc import Mapping
from pathlib import Path

from rosbags.rosbag2 import CompressionFormat
from rosbags.rosbag2 import CompressionMode
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer

from obbhbb_ros.bags.topics import VERSION
from obbhbb_ros.bags.topics import add_live_topic
from obbhbb_ros.files import making


def write_bag(
    target: Path, topics: Mapping[str, str], messages: Iterable[tuple[str, int, bytes]]
) -> None:
    """
    Write messages to a bag: MCAP with all message definitions, its chunks compressed with zstd.

    Parameters
    ----------
    target : Path
        The bag to write; it appears when it is complete.
    topics : mapping of str to str
        Message type by topic; types of ROS 2 Jazzy, and `vision_msgs/msg/Detection2DArray`.
    messages : iterable of (str, int, bytes)
        Topic, nanoseconds since 1970 and serialized message, in order of time.

    Raises
    ------
    OSError
        If the bag cannot be written, or exists.
    """
    with making(target) as partial_bag:
        writer = Writer(partial_bag, version=VERSION, storage_plugin=StoragePlugin.MCAP)
        writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
        with writer:
            added = {
                topic: add_live_topic(writer, topic, msgtype) for topic, msgtype in topics.items()
            }
            for topic, moment, data in messages:
                writer.write(added[topic], moment, data)
