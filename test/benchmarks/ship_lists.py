# SPDX-License-Identifier: Apache-2.0
"""
What ship lists tell and cost: a day of strips, each followed by a contact, with lists and without.

Ships, camera, detector and the sizes of the chips are synthetic, as in `ship_passes.py`; tracker,
collector, spool, outbox, release and budget are those of the nodes.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from collections import defaultdict
from contextlib import closing
from pathlib import Path
from typing import NamedTuple

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))

from passes import MEMORY
from ship_passes import RATES
from ship_passes import SHIPS
from ship_passes import WAYS
from ship_passes import Seen
from ship_passes import release
from ship_passes import ships_in
from ship_passes import store_strip
from ship_passes import strip
from ship_passes import tracker

from obbhbb_ros.earth.ellipsoid import to_ecef
from obbhbb_ros.earth.placement import Placement
from obbhbb_ros.reports.seen_ships import ShipCollector
from obbhbb_ros.reports.ship_list import read_ship_list
from obbhbb_ros.spool.list_spool import ListSpool
from obbhbb_ros.text_tables import text_table

# Metres of a degree, standard deviations of places in metres and of courses in radians.
DEGREE, PLACE_SIGMA, COURSE_SIGMA = 111_320.0, 12.0, 0.05
# First stamp, seconds since 1970.
START = 1_764_550_000


class Told(NamedTuple):
    """What came down of a strip: ships in lists, entries of lists, their bytes, ships on chips."""

    in_lists: int
    entries: int
    list_bytes: int
    on_chips: int
    chip_bytes: int


def placed(seen: Seen, random: np.random.Generator) -> Placement:
    """Place the boxes of a frame on Earth: at 36 degrees north, by an exact pose."""
    frame = seen.frame
    factor, shift = frame.view
    at = (frame.place - shift) / factor
    latitude = 36.0 - at.imag / DEGREE
    longitude = -5.4 + at.real / DEGREE / np.cos(np.radians(36.0))
    count, length = len(at), frame.length / np.abs(factor)
    spread = np.zeros((count, 4, 4))
    # No two poses are equally well known.
    sigma = PLACE_SIGMA * random.uniform(0.7, 1.3, (count, 2))
    spread[:, 0, 0], spread[:, 1, 1] = (sigma**2).T
    spread[:, 0, 1] = spread[:, 1, 0] = 0.3 * sigma.prod(axis=1)
    spread[:, 3, 3] = COURSE_SIGMA**2
    return Placement(
        points=to_ecef(latitude, longitude, np.zeros(count)),
        latitude=latitude,
        longitude=longitude,
        length=length,
        width=length / 5.5,
        course=np.degrees(frame.angle + np.pi / 2) % 180.0,
        elevation=np.full(count, 80.0),
        has_bow=np.zeros(count, np.bool_),
        covariance=spread,
        unplaced=np.zeros(count, np.uint8),
    )


def list_ships(seen: list[Seen], max_bytes: int, folder: Path) -> dict[str, set[int]]:
    """List the ships of a strip; return what is behind each id."""
    collector, random = ShipCollector(), np.random.default_rng(5)
    things: dict[str, set[int]] = defaultdict(set)
    for frame, ids in zip(seen, tracker(seen), strict=True):
        stamp = int((START + frame.frame.time) * 1e9)
        whole = frame.frame.share > 0.99
        classes = ['ship'] * len(ids)
        collector.note(stamp, ids, classes, frame.score, whole, placed(frame, random))
        for name, thing in zip(ids, frame.thing.tolist(), strict=True):
            things[name].add(thing)
    with closing(ListSpool(folder / 'spool', _fail)) as lists:
        lists.add(collector.take(), max_bytes)
    return things


def fly(seen: list[Seen], rate: float, max_bytes: int | None, folder: Path) -> Told:
    """Store chips and, unless `max_bytes` is None, a list; release both; see what came down."""
    store_strip(seen, WAYS['ids of ship_tracker'], folder)
    things = {} if max_bytes is None else list_ships(seen, max_bytes, folder)
    down = release(folder, rate)
    entries = [ship for content in down.lists for ship in read_ship_list(content)]
    listed = {thing for ship in entries for thing in things.get(ship.id, ()) if 0 <= thing < SHIPS}
    on_chips = {thing for thing in down.things if 0 <= thing < SHIPS}
    return Told(len(listed), len(entries), down.list_bytes, len(on_chips), down.chip_bytes)


def _fail(trouble: str) -> None:
    """Nothing may go wrong."""
    raise RuntimeError(trouble)


def main() -> None:
    """Fly and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parser.add_argument('--strips', type=int, default=11)
    options = parser.parse_args()
    seas = [strip(seed) for seed in range(1, options.strips + 1)]
    memory = str(MEMORY) if MEMORY.is_dir() else None
    table = []
    for link, rate in RATES.items():
        for name, max_bytes in (('none', None), ('GeoJSON', 0), ('messages of 340', 340)):
            told = []
            for seen in seas:
                with tempfile.TemporaryDirectory(dir=memory) as folder:
                    told.append(fly(seen, rate, max_bytes, Path(folder)))
            total = Told(*map(sum, zip(*told, strict=True)))
            cost = total.list_bytes / (total.list_bytes + total.chip_bytes)
            per_ship = total.list_bytes / total.entries if total.entries else 0.0
            table.append(
                (
                    link,
                    name,
                    str(total.in_lists),
                    f'{total.entries}',
                    f'{per_ship:.1f}',
                    f'{cost:.2%}',
                    f'{total.on_chips}',
                )
            )
    there = sum(len(ships_in(seen)) for seen in seas)
    print(f'synthetic: {options.strips} strips, {there} ships seen')
    head = ('link', 'lists', 'ships in lists', 'entries', 'bytes each', 'of the link', 'on chips')
    print(text_table(head, table))
    with tempfile.TemporaryDirectory() as folder, closing(ListSpool(Path(folder), _fail)) as lists:
        for count in (100, 1000, 10_000):
            ships = entries_of(seas[0], count)
            began = time.process_time()
            lists.add(ships)
            print(f'a list of {count} more ships is stored in {time.process_time() - began:.3f} s')


def entries_of(seen: list[Seen], count: int) -> list:
    """Make up so many ships of a list."""
    collector = ShipCollector()
    frame = seen[len(seen) // 2]
    places, rows = placed(frame, np.random.default_rng(1)), len(frame.thing)
    for first in range(0, count, rows):
        ids = [f'c0ffee00-{count}{first + row:06d}' for row in range(rows)]
        collector.note(1, ids, ['ship'] * rows, frame.score, np.ones(rows, np.bool_), places)
    return collector.take()[:count]


if __name__ == '__main__':
    main()
