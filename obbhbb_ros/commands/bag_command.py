# SPDX-License-Identifier: Apache-2.0
"""The command `obbhbb bag`."""

from __future__ import annotations

from argparse import ArgumentParser
from argparse import Namespace
from dataclasses import fields
from pathlib import Path

from obbhbb_ros.commands.shared_options import without_garbage_collection
from obbhbb_ros.study.progress import note
from obbhbb_ros.study.progress import track


def add_bag_options(parser: ArgumentParser) -> None:
    """Add the options of `obbhbb bag`."""
    add = parser.add_argument
    add('source', metavar='IN', type=Path, help='bag (rosbag2) or storage file of one to read')
    add('target', metavar='OUT', type=Path, help='bag to write')
    add(
        '--params-file',
        type=Path,
        metavar='FILE',
        help='ROS parameter file of the node; default: the defaults of the node',
    )
    add(
        '--node',
        metavar='NAME',
        default='',
        help='full name of the node in FILE; default: obb_to_hbb in the namespace of the topic',
    )
    add('--topic', default='', help='topic of the detections; default: the only one there is')
    add(
        '--camera-info',
        metavar='TOPIC',
        default='',
        help='topic that has the image size; default: camera_info beside the detections',
    )
    add('--replace', action='store_true', help='leave out the boxes and crop regions of IN')
    add('--storage', choices=('mcap', 'sqlite3'), default='', help='storage of OUT; default: as IN')
    add(
        '--compression',
        choices=('none', 'file', 'message', 'storage'),
        default='',
        help='what is compressed with zstd in OUT: nothing, the file as a whole, each message, or '
        'the chunks of mcap; default: as IN',
    )
    add(
        '--strict',
        action='store_true',
        help='exit with 1 if anything was lost, unreadable or could not be converted',
    )


def run_bag(options: Namespace) -> int:
    """Write a recorded bag with the boxes and crop regions that the node would have sent."""
    from obbhbb_ros.bags import replay

    with without_garbage_collection():
        tally = replay.add_boxes(
            options.source,
            options.target,
            replay.ReplayOptions(
                **{
                    field.name: getattr(options, field.name)
                    for field in fields(replay.ReplayOptions)
                }
            ),
            report=lambda text: note(f'obbhbb: {text}'),
            progress=lambda messages, total: track(messages, 'converting', total, 'messages'),
        )
    print(f'{tally}\nwritten: {options.target}')
    return 1 if options.strict and not tally.complete else 0
