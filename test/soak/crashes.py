# SPDX-License-Identifier: Apache-2.0
"""
Crash the conversion node in every way, restart it as launch does, and time its absence.

    python test/soak/crashes.py --count 25

Each time the node must say why its last run ended. The time runs from the crash, or from the end
of the stuck process, to the first answer to a message, `respawn_delay` included.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))

from crashes import CRASHES
from crashes import Crashing
from harness import Site
from harness import site_at

from obbhbb_ros.text_tables import text_table

HEAD = ('end of the last run', 'crashes', 'until it ended [s]', 'then median [s]', 'then max [s]')


def measure(site: Site, folder: Path, name: str, count: int, delay: float) -> list[str]:
    """Crash a node in one way, many times; return a row of the table."""
    way, code, why = CRASHES[name]
    folder.mkdir()
    ends, absences = [], []
    with Crashing(site, folder, way) as node:
        node.connect()
        for restarts in range(1, count + 1):
            node.next_report()
            began = time.monotonic()
            node.crash()
            assert node.process.wait() == code, node.process.log
            ended = time.monotonic()
            time.sleep(delay)
            node.start()
            node.connect()
            absences.append(time.monotonic() - ended)
            ends.append(ended - began)
            node.come_back()
            assert node.values['last_run.ended'] == why, node.values
            assert node.values['restarts'] == str(restarts), node.values
    figures = max(ends), np.median(absences), max(absences)
    return [name, str(count), *(f'{figure:.2f}' for figure in figures)]


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parser.add_argument('--count', type=int, default=25)
    parser.add_argument('--respawn-delay', type=float, default=1.0)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix='crashes_') as text, site_at(Path(text)) as site:
        rows = [
            measure(
                site,
                Path(text) / name.replace(' ', '_'),
                name,
                options.count,
                options.respawn_delay,
            )
            for name in CRASHES
        ]
    print(f'respawn_delay {options.respawn_delay:g} s, watchdog_timeout 2 s')
    print(text_table(HEAD, rows))


if __name__ == '__main__':
    main()
