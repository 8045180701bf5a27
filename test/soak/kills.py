# SPDX-License-Identifier: Apache-2.0
"""
Kill `chip_extractor` and `downlink` at random moments, and compare their books with the bus.

    python test/soak/kills.py --count 500

After each kill the books of the spool must balance; in the end every chip must have reached the
bus, or be counted as evicted or refused, no ship's first view may be lost, and no file may be
wrong.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))

from harness import site_at
from kills import run

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
    options = parser.parse_args()
    # Fast DDS never frees the shared memory that a killed subscriber had not read: by default that
    # of a publisher is used up after some kills, and it cannot send any more.
    os.environ['FASTRTPS_DEFAULT_PROFILES_FILE'] = str(PROFILE)
    with tempfile.TemporaryDirectory(prefix='kills_') as folder, site_at(Path(folder)) as site:
        run(
            site,
            Path(folder),
            options.count,
            options.seed,
            lambda text: print(text, flush=True),
            options.one_process,
            options.passing,
        )


if __name__ == '__main__':
    main()
