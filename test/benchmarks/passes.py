# SPDX-License-Identifier: Apache-2.0
"""
What the spool is worth: value delivered over a day with a few contacts, against doing without.

Time is simulated and the harbour is synthetic; spool, outbox, release and budget are those of the
nodes. `python test/benchmarks/passes.py --help`
"""

from __future__ import annotations

import argparse
import json
import tempfile
from collections.abc import Callable
from collections.abc import Sequence
from contextlib import ExitStack
from contextlib import closing
from dataclasses import dataclass
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from obbhbb_ros import OrientedBoxes
from obbhbb_ros import convert
from obbhbb_ros.downlink.budget import BudgetSettings
from obbhbb_ros.downlink.budget import FrameBudget
from obbhbb_ros.downlink.budget import TokenBucket
from obbhbb_ros.downlink.chips import PIXEL_FORMATS
from obbhbb_ros.downlink.chips import ChipCutter
from obbhbb_ros.downlink.chips import CodecSettings
from obbhbb_ros.downlink.chips import EncodedChip
from obbhbb_ros.downlink.crops import CropPlan
from obbhbb_ros.downlink.crops import CropSettings
from obbhbb_ros.downlink.crops import plan_crops
from obbhbb_ros.downlink.frame import FrameCut
from obbhbb_ros.downlink.frame import FrameLink
from obbhbb_ros.geometry.boxes import FloatArray
from obbhbb_ros.spool.books import Status
from obbhbb_ros.spool.chip_rows import NewChip
from obbhbb_ros.spool.feeder import OutboxFeeder
from obbhbb_ros.spool.feeder import ReleaseSettings
from obbhbb_ros.spool.outbox import Outbox
from obbhbb_ros.spool.outbox import json_bytes
from obbhbb_ros.spool.releaser import SpoolReleaser
from obbhbb_ros.spool.writer import SpoolWriter
from obbhbb_ros.study.chip_costs import render
from obbhbb_ros.study.harbour import harbour
from obbhbb_ros.text_tables import text_table

# Seconds between two steps of the releaser that has to wait.
STEP = 0.1
# Nobody's disk is measured here, and each chip is flushed several times.
MEMORY = Path('/dev/shm')
# By strategy, the value by which its spool ranks a chip, from its own value and its number. A spool
# in the order of arrival takes nothing more when it is full.
ORDERS: dict[str, Callable[[float, int], float]] = {
    'most valuable first': lambda value, number: value,
    'first in, first out': lambda value, number: -number,
}


@dataclass(frozen=True)
class Day:
    """
    Frames, one every `period` seconds, and contacts, spread evenly; each starts with a frame.

    `rate` in bytes per second; ValueError if the contacts do not fit.
    """

    frames: int = 2880
    seed: int = 1
    period: float = 30.0
    contacts: int = 4
    contact_frames: int = 16
    rate: float = 20e3
    spool_bytes: float = 20e6

    def __post_init__(self) -> None:
        """Check that each contact ends before the day or the next one."""
        least = 2 * self.contacts * self.contact_frames
        if self.frames < least:
            raise ValueError(f'{self.frames} frames are too few, at least {least} are needed')

    @property
    def link(self) -> BudgetSettings:
        """The link, with the burst that the nodes have by default."""
        return BudgetSettings(self.rate)

    @property
    def capacity(self) -> float:
        """Bytes that all contacts carry."""
        seconds = self.contact_frames * self.period
        return self.contacts * (self.rate * seconds + self.link.bucket_size)

    @property
    def windows(self) -> list[range]:
        """The frames of each contact."""
        starts = (self.frames * (2 * i + 1) // (2 * self.contacts) for i in range(self.contacts))
        return [range(start, start + self.contact_frames) for start in starts]


class Planned(NamedTuple):
    """A chip that is planned: as it is cut, and as it is stored, with its score as value."""

    chip: EncodedChip
    record: NewChip


class Delivered(NamedTuple):
    """A chip that is delivered: when, what it is worth, its age in seconds, its bytes."""

    at: float
    value: float
    age: float
    bytes: int


class Clock:
    """A clock that is set by hand, in seconds."""

    def __init__(self) -> None:
        self.now = 0.0

    def __call__(self) -> float:
        return self.now


class Scene:
    """The harbour: its ships do not move, so that each looks the same in every frame."""

    def __init__(self) -> None:
        labels = harbour()
        boxes = OrientedBoxes.from_corners(labels.corners)
        self._labels, self._xyxy = labels, convert(boxes)
        self._obb = boxes.xywhr
        cutter = ChipCutter(render(labels), PIXEL_FORMATS['rgb8'], CodecSettings(), print)
        self._chips = {
            region: cutter.cut(0, region)
            for region in map(tuple, self._plan(labels.scores).regions.tolist())
        }

    @property
    def ships(self) -> int:
        """Their number."""
        return len(self._xyxy)

    def frame(self, time: float, scores: FloatArray) -> list[Planned]:
        """Plan a frame, with a score for each ship."""
        plan = self._plan(scores)
        planned = []
        for index, (row, region) in enumerate(
            zip(plan.sources.tolist(), plan.regions.tolist(), strict=True)
        ):
            chip = replace(self._chips[tuple(region)], index=index)
            planned.append(Planned(chip, self._record(time, chip, float(plan.values[index]), row)))
        return planned

    def _plan(self, scores: FloatArray) -> CropPlan:
        """Plan with the default settings: a region for each ship."""
        return plan_crops(self._xyxy, scores, self._labels.size, CropSettings())

    def _record(self, time: float, chip: EncodedChip, value: float, row: int) -> NewChip:
        """Describe a chip, with as much as `chip_extractor` says about one."""
        x0, y0, x1, y1 = chip.region
        facts = {
            'roi': [x0, y0, x1 - x0, y1 - y0],
            'score': value,
            'detection_ids': [self._labels.ids[row]],
            'obb': self._obb[row].tolist(),
            'frame_id': 'camera',
            'image_size': list(self._labels.size),
            'codec': 'jpeg',
            'camera': {
                'size': [1024, 768],
                'k': [1500.0, 0.0, 512.0, 0.0, 1500.0, 384.0, 0.0, 0.0, 1.0],
                'model': 'plumb_bob',
                'd': [0.0, 0.0, 0.0, 0.0, 0.0],
                'roi': [0, 0, 1024, 768],
                'binning': [1, 1],
            },
        }
        return NewChip(value, self._labels.class_ids[row], (int(time), 0), facts, chip.data)


def run_frame(
    planned: Sequence[Planned],
    link: FrameLink | None = None,
    record: Callable[[EncodedChip], NewChip] | None = None,
) -> FrameCut[NewChip]:
    """Run the node's loop over a frame whose chips are cut already."""
    frame = FrameCut[NewChip]([chip.region for chip, _ in planned])
    frame.run(lambda index, _: planned[index].chip, link, record)
    return frame


class Topic:
    """
    Without a spool: what the link does not take at once is dropped.

    In its favour, what the other topics say about a chip costs the link nothing.
    """

    name = 'drop at once'

    def __init__(self, day: Day) -> None:
        # As much as the link carries until the next frame, or it would idle.
        self._settings = BudgetSettings(day.rate, burst=day.rate * day.period)
        self._clock = Clock()
        self._bucket = TokenBucket(self._settings, 0.0)
        self.delivered: list[Delivered] = []

    def take(self, planned: Sequence[Planned], contact: bool) -> None:
        """Send of a frame what the link takes."""
        if not contact:
            return

        def send(chip: EncodedChip, data: bytes) -> None:
            value = planned[chip.index].record.value
            self.delivered.append(Delivered(self._clock.now, value, 0.0, len(data)))

        budget = FrameBudget(self._settings, self._bucket, CodecSettings(), self._clock)
        run_frame(planned, FrameLink(budget, send))

    def run(self, until: float, contact: bool) -> None:
        """Let time pass."""
        self._clock.now = until


class Spooled:
    """Chips wait in a spool; `rank` gives the value by which it orders them."""

    def __init__(
        self, name: str, rank: Callable[[float, int], float], day: Day, folder: Path
    ) -> None:
        self.name, self._rank, self._max_bytes = name, rank, day.spool_bytes
        self._clock = Clock()
        self._outbox = folder / 'outbox'
        self._outbox.mkdir(parents=True)
        self._writer = SpoolWriter(folder / 'spool', self._fail)
        self._settings = ReleaseSettings(day.link)
        self._feeder = OutboxFeeder(
            SpoolReleaser(folder / 'spool', self._fail),
            Outbox(self._outbox),
            self._settings,
            self._fail,
            self._clock,
        )
        self._stored = 0
        self.delivered: list[Delivered] = []

    def take(self, planned: Sequence[Planned], contact: bool) -> None:
        """Store a frame."""
        ticket = self._writer.plan(len(planned))

        def record(chip: EncodedChip) -> NewChip:
            planned_record = planned[chip.index].record
            value = self._rank(planned_record.value, self._stored + chip.index)
            return replace(planned_record, value=value)

        frame = run_frame(planned, record=record)
        self._stored += len(planned)
        self._writer.store(ticket, frame.records, frame.not_recorded, self._max_bytes)

    def run(self, until: float, contact: bool) -> None:
        """Release chips, if there is contact, until a time."""
        self._feeder.steer(self._settings, contact)
        while contact and self._clock.now < until:
            pause = self._feeder.step()
            self._collect()
            if pause:
                self._clock.now += STEP
        self._clock.now = until

    def status(self) -> Status:
        """Read the books of the spool."""
        return self._writer.status()

    def close(self) -> None:
        """Close the spool."""
        self._writer.close()
        self._feeder.close()

    def _collect(self) -> None:
        """Take from the outbox what the ground has now."""
        for described in self._outbox.glob('*/*.json'):
            chip, facts = described.with_suffix('.jpg'), json.loads(described.read_bytes())
            self.delivered.append(
                Delivered(
                    self._clock.now,
                    facts['score'],
                    self._clock.now - facts['stamp']['sec'],
                    described.stat().st_size + chip.stat().st_size,
                )
            )
            chip.unlink()
            described.unlink()

    def _fail(self, trouble: str) -> None:
        """Nothing may go wrong, but that a chip is larger than what a slow link takes at once."""
        if 'larger than budget.burst' not in trouble:
            raise RuntimeError(trouble)


@dataclass(frozen=True)
class Outcome:
    """
    What became of a day.

    Attributes
    ----------
    values, costs : ndarray, shape (N,)
        Value, and bytes of file and JSON, of all chips planned.
    in_time : ndarray of bool, shape (N,)
        Which were planned before the last contact ended.
    delivered : dict of str to list of Delivered
        By strategy, in the order of delivery.
    books : dict of str to Status
        The spools at the end of the day.
    """

    day: Day
    values: FloatArray
    costs: FloatArray
    in_time: NDArray[np.bool_]
    delivered: dict[str, list[Delivered]]
    books: dict[str, Status]

    def best(self) -> float:
        """Give the value of the most valuable chips that fit all contacts."""
        return self._that_fit(self.values)

    def best_by_byte(self) -> float:
        """Give the value that no spool exceeds: of the chips of most value per byte that fit."""
        return self._that_fit(self.values / self.costs)

    def _that_fit(self, rank: FloatArray) -> float:
        """Fill all contacts by rank, with chips not planned yet as well, and a part of the last."""
        order = np.argsort(-rank[self.in_time])
        values, costs = (
            np.append(0.0, np.cumsum(column[self.in_time][order]))
            for column in (self.values, self.costs)
        )
        return float(np.interp(self.day.capacity, costs, values))


def simulate(day: Day) -> Outcome:
    """Run a day, all strategies side by side."""
    scene, random = Scene(), np.random.default_rng(day.seed)
    planned: list[tuple[float, float, bool]] = []
    with ExitStack() as stack:
        memory = str(MEMORY) if MEMORY.is_dir() else None
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(dir=memory)))
        spooled = [
            stack.enter_context(closing(Spooled(name, rank, day, folder / name)))
            for name, rank in ORDERS.items()
        ]
        strategies = [*spooled, Topic(day)]
        for number in range(day.frames):
            time = number * day.period
            contact = any(number in window for window in day.windows)
            frame = scene.frame(time, random.uniform(size=scene.ships))
            in_time = number < day.windows[-1].stop
            planned += [(chip.record.value, cost(chip.record), in_time) for chip in frame]
            for strategy in strategies:
                strategy.take(frame, contact)
                strategy.run(time + day.period, contact)
        values, costs, before = np.array(planned).T
        return Outcome(
            day,
            values,
            costs,
            before.astype(bool),
            {strategy.name: strategy.delivered for strategy in strategies},
            {strategy.name: strategy.status() for strategy in spooled},
        )


def cost(chip: NewChip) -> int:
    """Give the bytes of file and JSON; a few less, for want of id, stamp, class and checksum."""
    return len(chip.data) + len(json_bytes(dict(chip.facts)))


HEAD = (
    'strategy',
    'planned',
    'delivered',
    'MB',
    'value',
    'of planned',
    'of best',
    'median age [h]',
)


def table(outcome: Outcome) -> str:
    """Tabulate strategies, and what would be possible with foresight."""
    planned, best = float(outcome.values.sum()), outcome.best()
    chips = str(len(outcome.values))
    rows = []
    for name, delivered in outcome.delivered.items():
        value = sum(chip.value for chip in delivered)
        age = float(np.median([chip.age for chip in delivered])) if delivered else float('nan')
        rows.append(
            (
                name,
                chips,
                str(len(delivered)),
                f'{sum(chip.bytes for chip in delivered) / 1e6:.1f}',
                f'{value:.0f}',
                f'{value / planned:.1%}',
                f'{value / best:.0%}',
                f'{age / 3600.0:.1f}',
            )
        )
    for name, value in (
        ('best: the most valuable that fit', best),
        ('the most value per byte that fits', outcome.best_by_byte()),
    ):
        rows.append(
            (
                name,
                chips,
                '',
                f'{outcome.day.capacity / 1e6:.1f}',
                f'{value:.0f}',
                f'{value / planned:.1%}',
                f'{value / best:.0%}',
                '',
            )
        )
    return text_table(HEAD, rows)


def draw(outcome: Outcome, path: Path) -> None:
    """Draw the value delivered over the day."""
    from delivery import delivery_figure

    day = outcome.day
    curves = {
        name: (
            np.array([chip.at for chip in delivered]) / 3600.0,
            np.array([chip.value for chip in delivered]),
        )
        for name, delivered in outcome.delivered.items()
    }
    contacts = [
        (window.start * day.period / 3600.0, window.stop * day.period / 3600.0)
        for window in day.windows
    ]
    figure = delivery_figure(
        curves,
        outcome.best(),
        contacts,
        day.frames * day.period / 3600.0,
        'Synthetic harbour: value delivered over a day',
    )
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=100)


def main() -> None:
    """Simulate, print and draw."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parser.add_argument(
        '--frames', type=int, default=Day.frames, help='one every 30 s; default: %(default)s, a day'
    )
    parser.add_argument('--seed', type=int, default=Day.seed, help='of the scores')
    parser.add_argument('--plot', type=Path, metavar='FILE', help='picture of the value delivered')
    options = parser.parse_args()
    try:
        day = Day(options.frames, options.seed)
    except ValueError as error:
        parser.error(str(error))
    outcome = simulate(day)
    print(
        f'synthetic: {day.frames} frames of a synthetic harbour, scores uniform from 0 to 1; '
        f'{day.contacts} contacts of {day.contact_frames * day.period / 60.0:g} minutes at '
        f'{day.rate / 1e3:g} kB/s, spools of {day.spool_bytes / 1e6:g} MB\n'
    )
    print(table(outcome))
    if options.plot:
        draw(outcome, options.plot)
        print(f'\npicture: {options.plot}')


if __name__ == '__main__':
    main()
