# SPDX-License-Identifier: Apache-2.0
"""The command `obbhbb convert`."""

from __future__ import annotations

import sys
from argparse import ArgumentParser
from argparse import Namespace
from pathlib import Path

from obbhbb_ros.commands.shared_options import PARAMETERS
from obbhbb_ros.commands.shared_options import add_bow_option
from obbhbb_ros.commands.shared_options import add_end_options
from obbhbb_ros.commands.shared_options import add_image_size_option
from obbhbb_ros.commands.shared_options import add_number_options
from obbhbb_ros.commands.shared_options import note_unread_folders
from obbhbb_ros.commands.shared_options import warn_of_ends
from obbhbb_ros.commands.shared_options import without_garbage_collection
from obbhbb_ros.geometry import converter
from obbhbb_ros.geometry.methods import METHODS
from obbhbb_ros.labels import FORMATS
from obbhbb_ros.labels.axis_aligned import convert_file
from obbhbb_ros.labels.image_labels import BOW_SOURCES
from obbhbb_ros.study.progress import note
from obbhbb_ros.study.progress import track


def add_convert_options(parser: ArgumentParser) -> None:
    """Add the options of `obbhbb convert`."""
    add = parser.add_argument
    rule = converter.HullRule()
    written = [name for name, form in FORMATS.items() if form.write_boxes is not None]
    add('source', metavar='IN', type=Path, help='label file or folder to read')
    add('target', metavar='OUT', type=Path, help='file or folder to write')
    add(
        '--from',
        dest='source_format',
        metavar='FORMAT',
        help=f'format of IN: {", ".join(FORMATS)}; default: detected',
    )
    add(
        '--to',
        dest='target_format',
        metavar='FORMAT',
        help=f'format of OUT: {", ".join(written)}; default: by the suffix of OUT',
    )
    variants = [f'{name} of {form.name}' for form in FORMATS.values() for name in form.variants]
    add(
        '--variant',
        metavar='NAME',
        help=f'write the format as other tools need it: {", ".join(variants)}',
    )
    add('--method', default=rule.method, help=f'{", ".join(METHODS)}; default: %(default)s')
    add_number_options(parser, rule, PARAMETERS)
    add_end_options(parser)
    add_bow_option(parser, BOW_SOURCES)
    for side, name in (('longer', 'length'), ('shorter', 'width')):
        text = f'maximum of the {side} side, pixels or units of the map; with m, metres: 400m'
        add(f'--max-{name}', metavar='NUMBER[m]', help=text)
    add(
        '--diagnostics',
        action='store_true',
        help='also write length, width, theta, t_x, t_y and capped of each box',
    )
    add_image_size_option(parser, '; default: from labels or images')
    add(
        '--strict',
        action='store_true',
        help='exit with 1 if any record was malformed or could not be converted',
    )


def run_convert(options: Namespace) -> int:
    """Convert label files of oriented boxes to label files of axis-aligned boxes."""
    warn_of_ends(options)
    note_unread_folders(options.source)
    rule = converter.HullRule(
        options.method, options.q, options.f, options.s, options.q_bow, options.q_stern
    )
    caps, metres = _parse_caps(options.max_length, options.max_width)
    with without_garbage_collection():
        tally = convert_file(
            options.source,
            options.target,
            rule,
            caps,
            source_format=options.source_format,
            target_format=options.target_format,
            variant=options.variant,
            image_size=options.image_size,
            diagnostics=options.diagnostics,
            bow=options.bow,
            metres=metres,
            report=note,
            progress=lambda images, total: track(images, 'converting', total),
        )
    print(tally)
    if not tally.readable:
        print(f'obbhbb: nothing to convert in {options.source}', file=sys.stderr)
        return 1
    return 1 if options.strict and not tally.complete else 0


def _parse_caps(*texts: str | None) -> tuple[converter.Caps, bool]:
    """Parse maximum length and width; the second result says whether they are in metres."""
    given = [text for text in texts if text is not None]
    in_metres = {text.endswith('m') for text in given}
    if len(in_metres) > 1:
        raise ValueError(f'give both --max-length and --max-width in metres, or none: {given}')
    try:
        values = [None if text is None else float(text.removesuffix('m')) for text in texts]
    except ValueError:
        raise ValueError(f'a maximum is a number or metres, as 400m: {", ".join(given)}') from None
    return converter.Caps(*values), True in in_metres
