# SPDX-License-Identifier: Apache-2.0
"""
Ids of ships by `ShipMatcher`, on synthetic seas: ids a ship, ships that share one, and time.

With `--node` by the node `ship_tracker`, over DDS; its time is that from message to answer. Nothing
here was tuned on real video. `python test/benchmarks/tracking.py --help`
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable
from collections.abc import Iterator
from collections.abc import Sequence
from contextlib import AbstractContextManager
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any
from typing import NamedTuple

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))

from seas import HOVERING
from seas import Frame
from seas import Ints
from seas import Sea
from seas import frames
from seas import quality

from obbhbb_ros.text_tables import text_table
from obbhbb_ros.tracking.matcher import ShipMatcher

OPEN: dict[str, Any] = {'berthed': 0.0}
BAD: dict[str, Any] = {'misses': 0.3, 'false_alarms': 0.3, 'jitter': 4.0}


class Case(NamedTuple):
    """A sea, and how often it is tried."""

    name: str
    sea: Sea
    seeds: int = 1
    memory: float = 30.0


def hovering(rate: float, ships: int, cut: str) -> Case:
    """Make the case of a camera that stands still over ships that are larger than its border."""
    seconds = 30.0 if rate > 1 else 60.0
    sea = replace(HOVERING, ships=ships, hover=seconds, rate=rate, cut=cut)
    return Case(f'hover {rate:g} Hz, {ships} ships around, cut: {cut}', sea, 3)


GROUPS: dict[str, Sequence[Case]] = {
    'strip': (
        Case('strip of 60 km, 1000 ships', Sea()),
        Case('100 ships', Sea(ships=100, **OPEN), 3),
        Case('30 ships, 3 in view', Sea(ships=30, **OPEN), 5),
        Case('10 ships', Sea(ships=10, **OPEN), 8),
        Case('1000 ships, cut: axis', Sea(cut='axis')),
        Case('1000 ships, not cut', Sea(cut='none')),
    ),
    'turn': (
        Case('turn of 5 degrees, 1000 ships', Sea(turn=5.0), 5),
        Case('the same, 100 ships', Sea(turn=5.0, ships=100, turns_at=20, **OPEN), 5),
        Case('zoom of 5 %, 1000 ships', Sea(zoom=0.05), 5),
        Case('the same, 100 ships', Sea(zoom=0.05, ships=100, turns_at=20, **OPEN), 5),
        Case('both, 1000 ships', Sea(turn=5.0, zoom=0.05), 5),
        Case('wobble of 1 degree, 1000 ships', Sea(wobble=1.0)),
    ),
    'berth': tuple(
        Case(f'berthed rows (80 %), gap {gap:g} m', Sea(gap=gap, berthed=0.8), 3)
        for gap in (15.0, 5.0, 0.0)
    ),
    'noise': (
        *(Case(f'misses {share:.0%}', Sea(misses=share)) for share in (0.2, 0.3)),
        *(Case(f'false alarms {share:.0%}', Sea(false_alarms=share)) for share in (0.0, 0.2, 0.3)),
        *(Case(f'jitter {pixels:g} px', Sea(jitter=pixels)) for pixels in (2.0, 4.0)),
        Case('misses 30 %, false alarms 30 %, jitter 4 px', Sea(**BAD)),
        Case('the same, 100 ships', Sea(ships=100, **BAD, **OPEN), 3),
        Case('the same, 30 ships', Sea(ships=30, **BAD, **OPEN), 3),
        Case('an image lost, three times', Sea(dropped=(20, 40, 60))),
        Case('two lost, three times', Sea(dropped=(20, 21, 40, 41, 60, 61))),
        Case('the same, 100 ships', Sea(ships=100, dropped=(20, 21, 40, 41, 60, 61), **OPEN), 3),
    ),
    'hover': tuple(
        hovering(rate, ships, cut)
        for cut in ('frame', 'axis', 'none')
        for rate in (10.0, 1.0)
        for ships in (100, 30)
    ),
    'revisit': (
        Case('again after 60 s, forgotten', Sea(revisit=60.0, speed=(0.0, 0.0))),
        Case('memory of 120 s', Sea(revisit=60.0, speed=(0.0, 0.0)), 1, 120.0),
        Case('the same, half of them under way', Sea(revisit=60.0), 1, 120.0),
        Case(
            'the same, 100 ships at rest',
            Sea(ships=100, revisit=60.0, speed=(0.0, 0.0), **OPEN),
            3,
            120.0,
        ),
    ),
}
HEAD = ('sea', 'ids a ship', 'merged', 'ships', 'boxes', 'µs a frame', 'p90')


Track = Callable[[Frame], Ints]
"""Numbers the boxes of an image."""


@contextmanager
def matcher(case: Case) -> Iterator[Track]:
    """Number by a matcher."""
    made = ShipMatcher(case.memory)
    yield lambda frame: made.track(
        frame.time, frame.place, frame.length, frame.angle, case.sea.size
    )


def posed(error: float) -> Callable[[Case], AbstractContextManager[Track]]:
    """Return what numbers by a matcher that knows poses, each off by an error, metres."""

    @contextmanager
    def tracker(case: Case) -> Iterator[Track]:
        made, random = ShipMatcher(case.memory), np.random.default_rng(1)
        last: list[tuple[Frame, complex]] = []

        def track(frame: Frame) -> Ints:
            off = complex(*random.normal(0.0, error, 2))
            carry = frame.carry_from(last[-1][0], off - last[-1][1]) if last else None
            last[:] = [(frame, off)]
            return made.track(*frame[:4], case.sea.size, carry)

        yield track

    return tracker


@contextmanager
def node(case: Case) -> Iterator[Track]:
    """Number by a node, which starts for it."""
    from harness import Converter
    from harness import site_at
    from seas_over_dds import numbers_of

    size = {'image_width': int(case.sea.size.real), 'image_height': int(case.sea.size.imag)}
    with (
        # The log of the node goes there.
        TemporaryDirectory() as folder,
        site_at(Path(folder)) as site,
        Converter(
            site,
            parameters=size | {'memory': case.memory},
            executable='ship_tracker',
            topic='tracked_detections',
        ) as tracker,
    ):
        tracker.connect()
        yield lambda frame: numbers_of(tracker, frame)


def measure(
    case: Case,
    tracker: Callable[[Case], AbstractContextManager[Track]] = matcher,
    clock: Callable[[], float] = time.process_time,
) -> list[str]:
    """Track the ships of all seeds; one row, medians over the seeds."""
    found, boxes, seconds = [], [], []
    for seed in range(1, case.seeds + 1):
        truth, numbers = [], []
        with tracker(case) as track:
            for frame in frames(case.sea, seed):
                started = clock()
                given = track(frame)
                seconds.append(clock() - started)
                truth.append(frame.truth)
                numbers.append(given)
                boxes.append(len(given))
        found.append(quality(truth, numbers))
    ids, merged, ships = np.median(found, axis=0)
    middle, high = np.percentile(seconds, (50, 90)) * 1e6
    return [
        case.name,
        f'{ids:.2f}',
        f'{merged:.1%}',
        f'{ships:.0f}',
        f'{np.mean(boxes):.0f}',
        f'{middle:.0f}',
        f'{high:.0f}',
    ]


def crowds() -> list[list[str]]:
    """Measure the time that frames of very many or few boxes take."""
    cases = [
        Case(f'{ships} ships in 20 km', Sea(ships=ships, strip=20e3))
        for ships in (30, 300, 3000, 30_000)
    ]
    return [measure(case) for case in cases]


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parser.add_argument('groups', nargs='*', default=[], metavar='GROUP', help=', '.join(GROUPS))
    parser.add_argument('--crowds', action='store_true', help='only the time of crowded frames')
    parser.add_argument('--node', action='store_true', help='through the node, over DDS')
    parser.add_argument('--pose', type=float, help='with poses, off by so many metres')
    options = parser.parse_args()
    if unknown := {*options.groups} - {*GROUPS}:
        parser.error(f'{", ".join(sorted(unknown))}: choose from {", ".join(GROUPS)}')
    if options.crowds:
        print(text_table(HEAD, crowds()))
        return
    chosen = [case for name in options.groups or GROUPS for case in GROUPS[name]]
    way = (node, time.perf_counter) if options.node else (matcher, time.process_time)
    if options.pose is not None:
        way = posed(options.pose), time.process_time
    print(text_table(HEAD, [measure(case, *way) for case in chosen]))


if __name__ == '__main__':
    main()
