# SPDX-License-Identifier: Apache-2.0
"""Options of several commands, and what commands share when they run."""

from __future__ import annotations

import gc
from argparse import ArgumentParser
from argparse import Namespace
from collections.abc import Iterable
from collections.abc import Iterator
from collections.abc import Mapping
from collections.abc import Sequence
from contextlib import contextmanager
from pathlib import Path

from obbhbb_ros.geometry import converter
from obbhbb_ros.labels import FORMATS
from obbhbb_ros.labels import LabelError
from obbhbb_ros.labels.folders import unread_folders
from obbhbb_ros.progress import note
from obbhbb_ros.study.ships import BOWS
from obbhbb_ros.study.ships import Ships
from obbhbb_ros.study.ships import read_ships

SUFFIXES = frozenset(suffix for entry in FORMATS.values() for suffix in entry.suffixes)
PARAMETERS = {
    'q': f'shape exponent, {converter.Q_RANGE}',
    'f': f'fullness, {converter.F_RANGE}',
    's': f'shrink factor, {converter.S_RANGE}',
}
BOW_MEANINGS = {
    'labels': 'as the labels say (head points of hrsc)',
    'first-edge': 'the first two corners of every box are its bow end',
    'hull': 'the end of the hull with less area',
}


def add_label_options(parser: ArgumentParser, count: str) -> None:
    """Add the options that select the ships to read."""
    add = parser.add_argument
    add('labels', type=Path, nargs=count, metavar='LABELS', help='label files or folders')
    add('--format', help=f'{", ".join(FORMATS)}; default: detected')
    add(
        '--reference',
        type=Path,
        metavar='FILE',
        help='labels with the reference boxes, matched by image and overlap',
    )
    add_image_size_option(parser, ', for normalised formats without images')
    add_bow_option(parser, BOWS)


def add_image_size_option(parser: ArgumentParser, purpose: str) -> None:
    """Add the option for the size of the images; its help text ends with the purpose."""
    parser.add_argument(
        '--image-size',
        type=int,
        nargs=2,
        metavar=('W', 'H'),
        help=f'size of every image, pixels{purpose}',
    )


def add_bow_option(parser: ArgumentParser, sources: Sequence[str]) -> None:
    """Add the option that says where the bow of a ship is known."""
    meanings = '; '.join(
        f'{name}: {text}' for name, text in BOW_MEANINGS.items() if name in sources
    )
    add_choice_option(parser, 'bow', sources, 'none', f'where the bow is known: {meanings}')


def add_choice_option(
    parser: ArgumentParser, name: str, choices: Iterable[str], default: str, meaning: str
) -> None:
    """Add an option that takes one of some words."""
    help_text = f'{meaning}; default: %(default)s'
    parser.add_argument(f'--{name}', choices=tuple(choices), default=default, help=help_text)


def add_end_options(parser: ArgumentParser) -> None:
    """Add the options for hulls whose bow is known."""
    for end in ('bow', 'stern'):
        parser.add_argument(
            f'--q-{end}',
            type=float,
            help=f'shape exponent of the {end} where the bow is known, 1 to inf; default: q',
        )


def add_number_options(
    parser: ArgumentParser, defaults: object, meanings: Mapping[str, str]
) -> None:
    """Add an option for each number, with the type and default of that attribute of an object."""
    for name, meaning in meanings.items():
        default = getattr(defaults, name)
        parser.add_argument(
            f'--{name}', type=type(default), default=default, help=f'{meaning}; default: {default}'
        )


def warn_of_ends(options: Namespace) -> None:
    """Warn that q_bow and q_stern do nothing if no bow is known."""
    if options.bow == 'none' and not options.q_bow is options.q_stern is None:
        note('obbhbb: --q-bow and --q-stern have no effect without --bow')


def note_unread_folders(path: Path) -> None:
    """Say which folders beside label files are not read."""
    for folder in unread_folders(path, SUFFIXES):
        note(f'obbhbb: not read: {folder}: label files lie beside it, name it to read it')


def read_labelled_ships(options: Namespace) -> Ships:
    """Read the ships; malformed records are reported, counted and left out."""
    errors: list[LabelError] = []

    def report(error: LabelError) -> None:
        errors.append(error)
        note(f'obbhbb: left out: {error}')

    for path in options.labels:
        note_unread_folders(path)
    size = tuple(options.image_size) if options.image_size else None
    ships = read_ships(
        options.labels,
        options.format,
        reference=options.reference,
        image_size=size,
        bow=options.bow,
        on_error=report,
    )
    if options.reference:
        count = int(ships.with_reference.sum())
        note(f'obbhbb: {count} of {len(ships)} ships have a box in {options.reference}')
    if options.bow != 'none':
        note(f'obbhbb: the bow of {int(ships.boxes.bow.sum())} of {len(ships)} ships is known')
    if ships.crowds or ships.difficult:
        note(f'obbhbb: left out: {ships.crowds} crowds, {ships.difficult} difficult ships')
    if errors or ships.skipped:
        note(
            f'obbhbb: {len(errors)} malformed records and {ships.skipped} boxes without area left '
            f'out, {len(ships)} ships read'
        )
    return ships


@contextmanager
def without_garbage_collection() -> Iterator[None]:
    """Switch off garbage collection in a block: conversion creates many objects, but no cycles."""
    gc.disable()
    try:
        yield
    finally:
        gc.enable()
