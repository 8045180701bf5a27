# SPDX-License-Identifier: Apache-2.0
"""
Kill `chip_extractor` and `downlink` at random moments, and compare their books with the bus.

    python test/soak/kills.py --count 500

After each kill the books of the spool must balance; in the end every chip must have reached the
bus, or be counted as evicted or refused, no ship's first view may be lost, and no file may be
wrong.

    python test/soak/kills.py --count 200 --lists

The same with `ship_tracker` and `downlink`: every ship must be in a list that reached the bus, in
its place, but for those that `ship_tracker` saw after its last list when it was killed.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))

import kills
import list_kills
from harness import site_at

PROFILE = Path(__file__).parents[2] / 'config' / 'fastdds_large.xml'


def main() -> None:
    """Run the kills."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parser.add_argument('--count', type=int, default=500)
    parser.add_argument('--seed', type=int, default=0)
    parser.add_argument('--one-process', action='store_true', help='both nodes in one')
    parser.add_argument(
        '--passing', action='store_true', help='over ships that are seen once or twice'
    )
    parser.add_argument('--lists', action='store_true', help='ship lists instead of chips')
    options = parser.parse_args()
    # Fast DDS never frees the shared memory that a killed subscriber had not read: by default that
    # of a publisher is used up after some kills, and it cannot send any more.
    os.environ['FASTRTPS_DEFAULT_PROFILES_FILE'] = str(PROFILE)
    with tempfile.TemporaryDirectory(prefix='kills_') as folder, site_at(Path(folder)) as site:
        common = (site, Path(folder), options.count, options.seed, report, options.one_process)
        if options.lists:
            list_kills.run(*common)
        else:
            kills.run(*common, options.passing)


def report(text: str) -> None:
    """Print how it goes."""
    print(text, flush=True)


if __name__ == '__main__':
    main()
