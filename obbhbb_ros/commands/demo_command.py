# SPDX-License-Identifier: Apache-2.0
"""The command `obbhbb demo`."""

from __future__ import annotations

import shutil
from argparse import ArgumentParser
from argparse import Namespace
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from obbhbb_ros.downlink import chips
from obbhbb_ros.files import write_bytes
from obbhbb_ros.labels import ImageLabels
from obbhbb_ros.labels import write_labels
from obbhbb_ros.progress import announce
from obbhbb_ros.study import chip_costs
from obbhbb_ros.study import tables
from obbhbb_ros.study.harbour import harbour
from obbhbb_ros.study.harbour import passing

_DEMO_IMAGES = 16


def add_demo_options(parser: ArgumentParser) -> None:
    """Add the options of `obbhbb demo`."""
    add = parser.add_argument
    add('--picture', type=Path, default=Path('out/harbour.png'), help='default: %(default)s')
    add(
        '--bag',
        type=Path,
        help='bag (rosbag2, MCAP) to write; default: harbour_bag beside the picture, where it is '
        'replaced',
    )


def run_demo(options: Namespace) -> None:
    """Send a synthetic harbour through the real nodes; print a table, draw it, record a bag."""
    from obbhbb_ros.nodes.demo import boxes_by_method
    from obbhbb_ros.study import figures

    if options.bag and options.bag.exists():
        raise ValueError(f'{options.bag} exists already')
    ships = harbour()
    announce('converting a harbour with the node, by each method')
    boxes = boxes_by_method(ships)
    print(f'{len(ships.class_ids)} ships of a synthetic harbour, converted by the node over DDS\n')
    print(tables.scene_table(ships, boxes))
    figures.save(figures.scene_figure(ships, boxes), options.picture, dpi=100)
    print(f'\npicture: {options.picture}')
    _record_demo(ships, options.bag, options.picture.parent)


def _record_demo(ships: ImageLabels, bag: Path | None, folder: Path) -> None:
    """Record the nodes at work and keep their images, or print which extras are missing."""
    from obbhbb_ros.nodes import demo

    try:
        from obbhbb_ros.bags.recording import write_bag

        frames = [(image, chip_costs.render(image)) for image in passing(ships, _DEMO_IMAGES)]
    except ImportError as error:
        print(f'no bag, no overlay: {error}; they need the extras `bags` and `chips`')
        return
    announce('recording the nodes at work')
    messages = demo.record_chain(frames)
    write_bytes(folder / 'overlay.jpg', demo.last_overlay(messages))
    print(f'overlay: {folder / "overlay.jpg"}, the last picture of the node overlay')
    _write_images(folder / 'frames', frames)
    print(f'frames:  {folder / "frames"}, {len(frames)} images and their labels')
    if bag is None:
        bag = folder / 'harbour_bag'
        shutil.rmtree(bag, ignore_errors=True)
    write_bag(bag, demo.RECORDED_TOPICS, messages)
    print(f'bag:     {bag}, {len(messages)} messages on {len(demo.RECORDED_TOPICS)} topics')
    _fly_over(ships, folder / 'pass')


def _fly_over(ships: ImageLabels, folder: Path) -> None:
    """Fly over the harbour, and say what a link that takes a fifth brings to the ground."""
    from obbhbb_ros.nodes import demo_pass

    shutil.rmtree(folder, ignore_errors=True)
    # Grey: beside larger images, of 0.9 MB, the middleware is late with the poses.
    grey = chip_costs.render(ships).mean(axis=2, keepdims=True).round().astype(np.uint8)
    _write_images(folder / 'harbour', [(ships, grey)])
    announce('flying over the harbour with a tracker, and releasing what the link takes')
    flown = demo_pass.fly_over(folder / 'harbour', folder)
    print(
        f'pass:    {folder}, {flown.chips} chips of {flown.ships} ships; of a fifth of the bytes, '
        f'{flown.chips_down} chips, of {flown.ships_down} ships'
    )


def _write_images(folder: Path, frames: Sequence[tuple[ImageLabels, NDArray[np.uint8]]]) -> None:
    """Write images and their labels to a folder."""
    for image, pixels in frames:
        jpeg = chips.encode(pixels, chips.CodecSettings('jpeg', quality=90))
        write_bytes(folder / f'{image.image}.jpg', jpeg)
    write_labels(folder / 'labels.csv', [image for image, _ in frames])
