# SPDX-License-Identifier: Apache-2.0
"""The commands `obbhbb chips` and `gallery`: what chips cost, and a page of received chips."""

from __future__ import annotations

from argparse import ArgumentParser
from argparse import Namespace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from obbhbb_ros.commands.shared_options import add_number_options
from obbhbb_ros.downlink.chips import to_8_bits
from obbhbb_ros.downlink.crops import CropSettings
from obbhbb_ros.files import write_text
from obbhbb_ros.labels import ImageLabels
from obbhbb_ros.labels import read_labels
from obbhbb_ros.labels.image_files import find_images
from obbhbb_ros.labels.image_files import load_image
from obbhbb_ros.study import chip_costs
from obbhbb_ros.study import tables
from obbhbb_ros.study.harbour import harbour
from obbhbb_ros.study.progress import note


def add_chips_options(parser: ArgumentParser) -> None:
    """Add the options of `obbhbb chips`."""
    add = parser.add_argument
    add(
        'labels',
        type=Path,
        nargs='?',
        help='label file or folder with the images beside it; default: a synthetic harbour',
    )
    add_number_options(
        parser, CropSettings(), {'padding': 'fraction of the box to add on each side'}
    )
    add('--picture', type=Path, help='picture file for the first image and the costs')


def run_chips(options: Namespace) -> None:
    """Compare the size of the chips of each method: pixels, and bytes by codec."""
    if options.labels is None:
        what, source = 'a synthetic harbour (no real pixels)', harbour()
        pictures = [(source, chip_costs.render(source))]
    else:
        images = list(read_labels(options.labels))
        pictures = [
            (image, _picture(path, image))
            for image, path in zip(images, find_images(images), strict=True)
            if path is not None
        ]
        what = f'{options.labels}, {len(pictures)} of {len(images)} images found'
    if not pictures:
        raise ValueError(f'no image found for the labels in {options.labels}')
    costs = chip_costs.chip_costs(pictures, CropSettings(padding=options.padding))
    print(f'chips of {what}; difference from outer in brackets\n')
    print(tables.cost_table(costs))
    if options.picture:
        from obbhbb_ros.study import figures

        figures.save(figures.cost_figure(costs, *pictures[0], what), options.picture, dpi=75)
        print(f'\npicture: {options.picture}')


def _picture(path: Path, labels: ImageLabels) -> NDArray[np.uint8]:
    """Load the image of labels, (H, W, C); 16 bits are stretched. Say if labels lie outside it."""
    _, pixels = load_image(path)
    height, width = pixels.shape[:2]
    size, centers = f'{width} x {height} px', labels.boxes().center
    outside = np.count_nonzero(((centers < 0.0) | (centers > (width, height))).any(axis=1))
    if outside:
        note(f'obbhbb: {path}: {outside} of {len(centers)} labels lie outside its {size}')
    if labels.size not in (None, (width, height)):
        claimed = '{} x {} px'.format(*labels.size or ())
        note(f'obbhbb: {path}: the image has {size}, its labels say {claimed}')
    return np.atleast_3d(to_8_bits(pixels) if pixels.dtype.itemsize > 1 else pixels)


def add_gallery_options(parser: ArgumentParser) -> None:
    """Add the options of `obbhbb gallery`."""
    add = parser.add_argument
    add('outbox', type=Path, metavar='OUTBOX', help='outbox, or folder that received its files')
    add('-o', '--output', type=Path, default=Path('out/gallery.html'), help='default: %(default)s')
    add(
        '--limit',
        type=int,
        default=0,
        metavar='N',
        help='maximum number of chips to show, the most valuable first; default: 0, all',
    )


def run_gallery(options: Namespace) -> None:
    """Show what came down: the chips of an outbox, most valuable first, on one HTML page."""
    from obbhbb_ros.study.gallery import gallery_page
    from obbhbb_ros.study.gallery import read_received

    # Resolved, because relative links do not work through symbolic links.
    outbox, beside = options.outbox.resolve(), options.output.resolve().parent
    received = read_received(outbox)
    if not received.chips and not received.problems:
        raise ValueError(f'{options.outbox}: no chips found')
    page = gallery_page(
        received, beside, outbox.name, limit=options.limit, command=options.invocation
    )
    write_text(options.output, page)
    for problem in received.problems:
        note(f'obbhbb: {problem}')
    print(f'chips: {len(received.chips)}, problems: {len(received.problems)}')
    print(f'written: {options.output}')
