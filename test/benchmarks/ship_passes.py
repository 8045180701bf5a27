# SPDX-License-Identifier: Apache-2.0
"""
How many ships come down of a strip in which each is seen nine times, by the ids of the detections.

Ships, camera and detector are synthetic, and so are the sizes of the chips; spool, outbox, release,
budget and tracker are those of the nodes. `python test/benchmarks/ship_passes.py --help`
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from collections import Counter
from collections.abc import Callable
from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))

from passes import MEMORY
from passes import Clock
from seas import FALSE_ALARM
from seas import Floats
from seas import Frame
from seas import Ints
from seas import Sea
from seas import frames

from obbhbb_ros.downlink.budget import BudgetSettings
from obbhbb_ros.reports.ship_list import LIST_KIND
from obbhbb_ros.reports.ship_list import LIST_SUFFIXES
from obbhbb_ros.spool.chip_rows import NewChip
from obbhbb_ros.spool.feeder import OutboxFeeder
from obbhbb_ros.spool.feeder import ReleaseSettings
from obbhbb_ros.spool.outbox import Outbox
from obbhbb_ros.spool.ranking import FADE
from obbhbb_ros.spool.releaser import SpoolReleaser
from obbhbb_ros.spool.writer import SpoolWriter
from obbhbb_ros.text_tables import text_table
from obbhbb_ros.tracking.matcher import ShipMatcher
from obbhbb_ros.tracking.object_ids import ObjectIds

SHIPS, ROCKS = 1000, 150
# Of a contact after the strip, and the share of a rock's views in which the detector takes it for a
# ship.
CONTACT, ROCK_SEEN = 480.0, 0.65
RATES = {'full link': 6.7e3, 'a quarter': 6.7e3 / 4}
# Bytes that the link takes at once, so that the largest chip can go.
BURST = 40e3
SPOOL = 20e6
# A line through the sizes of the harbour's chips: bytes of one, and of each of its pixels.
CHIP_BYTES, PIXEL_BYTES = 1042.0, 0.364


class Seen(NamedTuple):
    """A frame with the scores of its boxes, and which of them are the same thing (-1: nothing)."""

    frame: Frame
    score: Floats
    thing: Ints


def strip(seed: int) -> list[Seen]:
    """Fly over ships, and over rocks that the detector sometimes takes for ships."""
    random = np.random.default_rng(seed)
    liking = np.concatenate((random.beta(4, 2, SHIPS), random.beta(2, 3.5, ROCKS)))
    seen = []
    for every in frames(Sea(ships=SHIPS + ROCKS, berthed=0.4, false_alarms=0.03), seed):
        is_rock = every.truth >= SHIPS
        kept = np.flatnonzero(~is_rock | (random.random(len(is_rock)) < ROCK_SEEN))
        columns = (column[kept] for column in every[1:-1])
        frame = Frame(every.time, *columns, every.view)
        nothing = frame.truth == FALSE_ALARM
        mean = np.where(nothing, random.beta(2, 4, len(kept)), liking[frame.truth])
        score = mean * np.sqrt(frame.share) + random.normal(0.0, 0.08, len(kept))
        seen.append(Seen(frame, np.clip(score, 0.05, 0.99), frame.truth))
    return seen


# Ids ------------------------------------------------------------------------------------------

Ids = Callable[[list[Seen]], list[list[str]]]


def no_ids(seen: list[Seen]) -> list[list[str]]:
    """Give none, as most detectors do."""
    return [[''] * len(thing) for _, _, thing in seen]


def oracle(seen: list[Seen]) -> list[list[str]]:
    """Number ships and rocks as they are, and each false alarm anew."""
    return _numbered(seen, 'c0ffee00-', restart=None)


def tracker(seen: list[Seen]) -> list[list[str]]:
    """Number them as `ship_tracker` does."""
    matcher = ShipMatcher()
    return [
        [
            f'c0ffee00-{number}'
            for number in matcher.track(
                frame.time, frame.place, frame.length, frame.angle, Sea().size
            )
        ]
        for frame, _, _ in seen
    ]


def rows(seen: list[Seen]) -> list[list[str]]:
    """Number the boxes of each frame."""
    return [list(map(str, range(len(thing)))) for _, _, thing in seen]


def restarted(seen: list[Seen]) -> list[list[str]]:
    """Number them as they are, from 1, and from 1 again in the middle, as yolo_ros does."""
    return _numbered(seen, '', restart=len(seen) // 2)


def _numbered(seen: list[Seen], prefix: str, restart: int | None) -> list[list[str]]:
    """Number things in the order in which they are seen."""
    numbers: dict[int, int] = {}
    count, ids = 0, []
    for row, (_, _, things) in enumerate(seen):
        if row == restart:
            numbers, count = {}, 0
        ids.append([])
        for thing in things.tolist():
            number = numbers.get(thing)
            if number is None:
                count += 1
                number = count
                if thing != FALSE_ALARM:
                    numbers[thing] = number
            ids[-1].append(f'{prefix}{number}')
    return ids


@dataclass(frozen=True)
class Way:
    """
    How chips are ordered.

    `exponent`: the value is divided by this power of the bytes. `is_fifo`: the first one first.
    `by_sightings`: the value is multiplied by n / (n + 1) where its id is seen for the n-th time.
    """

    ids: Ids
    exponent: float = 0.0
    is_fifo: bool = False
    by_sightings: bool = False


WAYS = {
    'value alone (no ids)': Way(no_ids),
    'first in, first out': Way(no_ids, is_fifo=True),
    'ids of an oracle': Way(oracle),
    'ids of ship_tracker': Way(tracker),
    'row numbers': Way(rows),
    'a tracker started again in the middle': Way(restarted),
    'ship_tracker, value by the root of bytes': Way(tracker, 0.5),
    'ship_tracker, value by byte': Way(tracker, 1.0),
    'ship_tracker, value by sightings': Way(tracker, by_sightings=True),
}


# The downlink ---------------------------------------------------------------------------------


class Delivered(NamedTuple):
    """Shares of the ships that came down, and of the chips that show none; number, megabytes."""

    ships: float
    false_alarms: float
    chips: int
    megabytes: float


def chips_of(
    seen: Seen, ids: Sequence[str], way: Way, first: int, factors: Floats
) -> list[NewChip]:
    """Describe the chips of a frame; `first` is the number of the first."""
    frame, score, thing = seen
    width = frame.length / 5.5
    cos, sin = np.abs(np.cos(frame.angle)), np.abs(np.sin(frame.angle))
    pixels = (cos * frame.length + sin * width) * (sin * frame.length + cos * width)
    sizes = (CHIP_BYTES + PIXEL_BYTES * pixels * frame.share).astype(int)
    values = factors * score / sizes**way.exponent
    if way.is_fifo:
        values = -np.arange(first, first + len(thing))
    chips = []
    for row, size in enumerate(sizes.tolist()):
        x, y, length = frame.place[row].real, frame.place[row].imag, frame.length[row]
        facts = {
            'roi': [round(x), round(y), round(length), round(length)],
            'score': float(score[row]),
            'detection_ids': [int(thing[row])],
            'obb': [x, y, length, length / 5.5, float(frame.angle[row])],
            'frame_id': 'camera',
            'image_size': [int(Sea().size.real), int(Sea().size.imag)],
            'codec': 'jpeg',
        }
        stamp = int(frame.time), int(frame.time % 1 * 1e9)
        chips.append(
            NewChip(float(values[row]), 'ship', stamp, facts, bytes(size), object_id=ids[row])
        )
    return chips


def store_strip(seen: list[Seen], way: Way, folder: Path) -> None:
    """Store the chips of a strip in the spool of a folder."""
    with closing(SpoolWriter(folder / 'spool', _fail)) as writer:
        writer.set_fade(FADE)
        objects, count, sightings = ObjectIds(), 0, Counter[str]()
        for frame, ids in zip(seen, way.ids(seen), strict=True):
            sightings.update(ids)
            times = np.array([sightings[name] for name in ids], np.float64)
            factors = times / (times + 1.0) if way.by_sightings else np.ones(len(ids))
            chips = chips_of(frame, objects.name(ids, frame.frame.time), way, count, factors)
            writer.store(writer.plan(len(chips)), chips, {}, SPOOL)
            count += len(chips)


class Down(NamedTuple):
    """What came down: the things on the chips, the bytes of chips, files of lists, their bytes."""

    things: list[int]
    chip_bytes: int
    lists: list[bytes]
    list_bytes: int


def release(folder: Path, rate: float) -> Down:
    """Release in a contact what the spool of a folder holds."""
    outbox = folder / 'outbox'
    outbox.mkdir()
    clock, settings = Clock(), ReleaseSettings(BudgetSettings(rate, burst=BURST))
    feeder = OutboxFeeder(
        SpoolReleaser(folder / 'spool', _fail), Outbox(outbox), settings, _fail, clock
    )
    things: list[int] = []
    lists: list[bytes] = []
    chip_bytes = list_bytes = 0
    with closing(feeder):
        feeder.steer(settings, True)
        while clock.now < CONTACT:
            if feeder.step():
                clock.now += 1.0
                continue
            for file in outbox.glob('*/*.json'):
                described = json.loads(file.read_bytes())
                if described.get('kind') == LIST_KIND:
                    content = file.with_suffix(f'.{LIST_SUFFIXES[described["format"]]}')
                    lists.append(content.read_bytes())
                    list_bytes += _taken(file, content)
                else:
                    things += described['detection_ids']
                    chip_bytes += _taken(file, file.with_suffix('.jpg'))
    return Down(things, chip_bytes, lists, list_bytes)


def _taken(*files: Path) -> int:
    """Take files as a bus does; return their bytes."""
    size = sum(file.stat().st_size for file in files)
    for file in files:
        file.unlink()
    return size


def fly(seen: list[Seen], way: Way, rate: float, folder: Path) -> Delivered:
    """Store the chips of a strip, release them in a contact, and see what came down."""
    store_strip(seen, way, folder)
    things, chip_bytes, _, _ = release(folder, rate)
    is_ship = np.isin(things, range(SHIPS))
    ships = len({thing for thing in things if 0 <= thing < SHIPS})
    return Delivered(
        ships / len(ships_in(seen)), 1.0 - is_ship.mean(), len(things), chip_bytes / 1e6
    )


def ships_in(seen: list[Seen]) -> set[int]:
    """Return the ships that a strip shows."""
    return {thing for frame in seen for thing in frame.thing.tolist() if 0 <= thing < SHIPS}


def _fail(trouble: str) -> None:
    """Nothing may go wrong, but that a chip is larger than what a slow link takes at once."""
    if 'larger than budget.burst' not in trouble:
        raise RuntimeError(trouble)


FORMS = ('{:.1%}', '{:.1%}', '{}', '{:.2f}')
HEAD = ('', 'link', 'ships delivered', 'false alarms among chips', 'chips', 'MB')


def main() -> None:
    """Fly, print and draw."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parser.add_argument('--seeds', type=int, default=3)
    parser.add_argument('--plot', type=Path, metavar='FILE', help='picture of the ships delivered')
    options = parser.parse_args()
    seas = [strip(seed) for seed in range(1, options.seeds + 1)]
    memory = str(MEMORY) if MEMORY.is_dir() else None
    results: dict[tuple[str, str], list[Delivered]] = {}
    for name, way in WAYS.items():
        for link, rate in RATES.items():
            for seen in seas:
                with tempfile.TemporaryDirectory(dir=memory) as folder:
                    results.setdefault((name, link), []).append(fly(seen, way, rate, Path(folder)))
    chips = [sum(len(seen.thing) for seen in sea) for sea in seas]
    print(f'synthetic: strips of {SHIPS} ships and {ROCKS} rocks, {chips} chips')
    table = [(name, link, *row_of(outcomes)) for (name, link), outcomes in results.items()]
    print(text_table(HEAD, table))
    if options.plot:
        draw(results, options.plot)


def row_of(outcomes: Sequence[Delivered]) -> list[str]:
    """Write what came down for all seeds."""
    return [
        ' '.join(form.format(value) for value in values)
        for form, values in zip(FORMS, zip(*outcomes, strict=True), strict=True)
    ]


def draw(results: dict[tuple[str, str], list[Delivered]], path: Path) -> None:
    """Draw the ships that came down as bars, with the mean over the seeds."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8.0, 4.5), layout='constrained')
    axes = figure.subplots()
    names = list(WAYS)
    for k, link in enumerate(RATES):
        shares = [
            100.0 * np.mean([outcome.ships for outcome in results[name, link]]) for name in names
        ]
        places = np.arange(len(names)) + 0.4 * k - 0.2
        bars = axes.barh(places, shares, 0.38, label=link, color=('tab:blue', 'tab:orange')[k])
        axes.bar_label(bars, fmt='%.0f', padding=3)
    axes.set_yticks(range(len(names)), names)
    axes.invert_yaxis()
    axes.set(xlim=(0, 110), xlabel='ships delivered [%]')
    axes.set_title('Synthetic strip: 1000 ships, each seen nine times', loc='left')
    figure.legend(loc='outside lower left', ncols=2, frameon=False)
    axes.spines[['top', 'right']].set_visible(False)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=100)


if __name__ == '__main__':
    main()
