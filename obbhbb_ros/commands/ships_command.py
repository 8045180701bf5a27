# SPDX-License-Identifier: Apache-2.0
"""The command `obbhbb ships`."""

from __future__ import annotations

import math
from argparse import ArgumentParser
from argparse import ArgumentTypeError
from argparse import Namespace
from collections import Counter
from collections.abc import Callable
from datetime import datetime
from datetime import timezone
from pathlib import Path

from obbhbb_ros.study.progress import note
from obbhbb_ros.study.received import Received
from obbhbb_ros.study.received import read_received
from obbhbb_ros.study.ship_files import SHIP_FILES
from obbhbb_ros.study.ship_files import ship_writer
from obbhbb_ros.study.ship_files import utc_time
from obbhbb_ros.study.ship_rows import ShipRow
from obbhbb_ros.study.ship_rows import merged_within
from obbhbb_ros.study.ship_rows import near_to
from obbhbb_ros.study.ship_rows import ship_rows

_MIN_METRES = 0.001


def add_ships_options(parser: ArgumentParser) -> None:
    """Add the options of `obbhbb ships`."""
    add = parser.add_argument
    add(
        'outbox',
        type=Path,
        nargs='+',
        metavar='OUTBOX',
        help='outboxes, or folders that received their files',
    )
    add(
        '-o',
        '--output',
        type=Path,
        default=Path('out/ships.geojson'),
        help=f'file to write, by its suffix: {", ".join(SHIP_FILES)}; default: %(default)s',
    )
    add(
        '--merge-within',
        type=_metres,
        metavar='M',
        help='join rows within M metres of each other that were not seen at the same time',
    )
    add(
        '--near',
        type=float,
        nargs=3,
        metavar=('LAT', 'LON', 'M'),
        help='only ships within M metres of a place; latitude and longitude in degrees',
    )
    add('--since', type=_time, metavar='TIME', help='only ships seen then or later, ISO 8601, UTC')
    add('--min-length', type=_metres, metavar='M', help='only ships of M metres or more')


def _metres(text: str) -> float:
    """Parse metres."""
    metres = float(text)
    if not _MIN_METRES <= metres < math.inf:
        raise ArgumentTypeError(f'{text} is not a number of metres, at least {_MIN_METRES}')
    return metres


def _time(text: str) -> datetime:
    """Parse a time; without a time zone it is UTC."""
    time = datetime.fromisoformat(text.removesuffix('Z'))
    return time if time.tzinfo else time.replace(tzinfo=timezone.utc)


def run_ships(options: Namespace) -> None:
    """Write a table of the ships in ship lists and chips that came down, with their places."""
    write, choices = ship_writer(options.output), _choices(options)
    folders = [_read(folder) for folder in options.outbox]
    left_out: Counter[str] = Counter()
    rows = ship_rows(folders, left_out)
    if not rows:
        names = ', '.join(map(str, options.outbox))
        reasons = _reasons(left_out) or f'{names}: neither ship lists nor chips'
        raise ValueError(f'no ships with a place: {reasons}')
    if options.merge_within:
        rows = merged_within(rows, options.merge_within)
    for reason, chosen in choices.items():
        kept = chosen(rows)
        left_out[reason] += len(rows) - len(kept)
        rows = kept
    write(options.output, rows)
    lists = sum(len(folder.lists) for folder in folders)
    chips = sum(len(folder.chips) for folder in folders)
    print(f'ships: {len(rows)}, of {lists} ship lists and {chips} chips')
    if reasons := _reasons(left_out):
        print(f'left out: {reasons}')
    print(f'written: {options.output}')


def _read(folder: Path) -> Received:
    """Read a folder, and say what is wrong in it."""
    received = read_received(folder)
    for problem in received.problems:
        note(f'obbhbb: {problem}')
    return received


def _choices(options: Namespace) -> dict[str, Callable[[list[ShipRow]], list[ShipRow]]]:
    """List the conditions that are given, by what to call the ships that do not meet them."""
    choices: dict[str, Callable[[list[ShipRow]], list[ShipRow]]] = {}
    if options.near:
        *place, distance = options.near
        if not (abs(place[0]) <= 90.0 and abs(place[1]) <= 180.0 and distance > 0.0):
            raise ValueError('--near takes latitude, longitude and metres above 0')
        choices['ships away from --near'] = lambda rows: near_to(rows, tuple(place), distance)
    if options.since:
        choices['ships before --since'] = lambda rows: [
            row for row in rows if utc_time(row.facts.last) >= options.since
        ]
    if options.min_length:
        choices['ships below --min-length'] = lambda rows: [
            row for row in rows if row.facts.length_m >= options.min_length
        ]
    return choices


def _reasons(left_out: Counter[str]) -> str:
    """Say what was left out, and why."""
    return ', '.join(f'{count} {reason}' for reason, count in left_out.items() if count)
