# SPDX-License-Identifier: Apache-2.0
"""The commands `obbhbb chips` and `gallery`: what chips cost, and a page of received chips."""

from __future__ import annotations

import itertools
from argparse import ArgumentParser
from argparse import Namespace
from collections.abc import Callable
from collections.abc import Iterable
from collections.abc import Iterator
from pathlib import Path
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from obbhbb_ros.commands.shared_options import add_number_options
from obbhbb_ros.commands.shared_options import note_unread_folders
from obbhbb_ros.downlink.chips import to_8_bits
from obbhbb_ros.downlink.crops import CropSettings
from obbhbb_ros.files import write_text
from obbhbb_ros.geometry.converter import convert_by_rule
from obbhbb_ros.labels import ImageLabels
from obbhbb_ros.labels import map_images
from obbhbb_ros.labels import read_labels
from obbhbb_ros.labels.image_files import find_images
from obbhbb_ros.labels.image_files import load_image
from obbhbb_ros.labels.image_names import bare_name
from obbhbb_ros.progress import note
from obbhbb_ros.progress import track
from obbhbb_ros.study import chip_costs
from obbhbb_ros.study import tables
from obbhbb_ros.study.harbour import harbour
from obbhbb_ros.study.rules import DEFAULT_RULES

# Labels, and pixels of shape (H, W, C).
_Picture: TypeAlias = tuple[ImageLabels, NDArray[np.uint8]]


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
    add('--ships', type=Path, metavar='DIR', help='folder for a picture of each ship, all boxes')


def run_chips(options: Namespace) -> None:
    """Compare the size of the chips of each method: pixels, and bytes by codec."""
    what, pictures = _pictures(options.labels)
    first = next(pictures)
    pictures = itertools.chain([first], pictures)
    ships: list[int] = []
    if options.ships:
        pictures = _draw_ships(options.ships, pictures, ships.append)
    costs = chip_costs.chip_costs(pictures, CropSettings(padding=options.padding))
    print(f'chips of {what}; difference from outer in brackets\n')
    print(tables.cost_table(costs))
    if options.picture:
        from obbhbb_ros.study import figures

        figures.save(figures.cost_figure(costs, *first, what), options.picture, dpi=75)
        print(f'\npicture: {options.picture}')
    if options.ships:
        print(f'\nships: {sum(ships)} pictures in {options.ships}')


def _pictures(path: Path | None) -> tuple[str, Iterator[_Picture]]:
    """Name the images of labels, by default a harbour, and load them one by one."""
    if path is None:
        source = harbour()
        return 'a synthetic harbour (no real pixels)', iter([(source, chip_costs.render(source))])
    note_unread_folders(path)
    images = list(read_labels(path))
    pairs = zip(images, find_images(images), strict=True)
    pictured = [(image, file) for image, file in pairs if file is not None]
    if not pictured:
        raise ValueError(f'no image found for the labels in {path}')
    what = f'{path}, {len(pictured)} of {len(images)} images found'
    return what, itertools.starmap(_pictured, pictured)


def _draw_ships(
    folder: Path, pictures: Iterable[_Picture], on_drawn: Callable[[int], object]
) -> Iterator[_Picture]:
    """Draw the ships of images with the boxes of all methods as they pass, and count them."""
    from obbhbb_ros.study import figures

    folder.mkdir(parents=True, exist_ok=True)
    for labels, pixels in pictures:
        boxes = {
            name: convert_by_rule(labels.boxes(), rule) for name, rule in DEFAULT_RULES.items()
        }
        height, width = pixels.shape[:2]
        low, high = boxes['outer'][:, :2], boxes['outer'][:, 2:]
        rows = np.flatnonzero(((high > 0.0) & (low < (width, height))).all(axis=1)).tolist()
        for row in track(rows, f'drawing {labels.image}'):
            figure = figures.ship_figure(labels, pixels, boxes, row)
            figures.save(figure, folder / f'{bare_name(labels.image)}_{row + 1}.png', dpi=100)
        on_drawn(len(rows))
        yield labels, pixels


def _pictured(labels: ImageLabels, path: Path) -> _Picture:
    """
    Load the image of labels, (H, W, C); 16 bits are stretched. Say if labels lie outside it.

    Labels in a map are returned in pixels.
    """
    if labels.extras.label_set.crs:
        labels, pixels = map_images.in_pixels(labels, path), map_images.load_map_image(path)
    else:
        _, pixels = load_image(path)
    height, width = pixels.shape[:2]
    size, centers = f'{width} x {height} px', labels.boxes().center
    outside = ~((centers >= 0.0) & (centers <= (width, height))).all(axis=1)
    if outside.any():
        if outside.all() and map_images.lies_under(path, centers):
            raise ValueError(
                f'{labels.source}: the labels lie in the map of {path}, but name no reference '
                'system: give them one, for example with ogr2ogr -a_srs EPSG:32633'
            )
        count = np.count_nonzero(outside)
        note(f'obbhbb: {path}: {count} of {len(centers)} labels lie outside its {size}')
    if labels.size not in (None, (width, height)):
        claimed = '{} x {} px'.format(*labels.size or ())
        note(f'obbhbb: {path}: the image has {size}, its labels say {claimed}')
    return labels, np.atleast_3d(to_8_bits(pixels) if pixels.dtype.itemsize > 1 else pixels)


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
        help='maximum number of ships to show, the most valuable first; default: 0, all',
    )


def run_gallery(options: Namespace) -> None:
    """Show what came down: the chips of an outbox by ship, best first, on one HTML page."""
    from obbhbb_ros.ground.gallery import gallery_page
    from obbhbb_ros.ground.received import read_received

    # Resolved, because relative links do not work through symbolic links.
    outbox, beside = options.outbox.resolve(), options.output.resolve().parent
    received = read_received(outbox)
    if not (received.chips or received.lists or received.problems):
        raise ValueError(f'{options.outbox}: no chips found')
    page = gallery_page(
        received, beside, outbox.name, limit=options.limit, command=options.invocation
    )
    write_text(options.output, page)
    for problem in received.problems:
        note(f'obbhbb: {problem}')
    print(f'chips: {len(received.chips)}, problems: {len(received.problems)}')
    if received.ship_count:
        print(f'ships: {received.ship_count}')
    if received.cameras:
        print(f'cameras: {len(received.cameras)}')
    if received.lists:
        print(f'ship lists: {len(received.lists)}')
    print(f'written: {options.output}')
