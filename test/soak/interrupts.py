# SPDX-License-Identifier: Apache-2.0
"""
Start every executable many times and interrupt it twice, as Ctrl-C under `ros2 launch` does.

    python test/soak/interrupts.py --count 100

The first SIGINT comes at a random moment of the first two seconds, the second up to 50 ms later.
Every node must exit with 0 and without output. A signal that arrives while Python itself is still
starting cannot be handled by any program: those ends are counted separately.
"""

from __future__ import annotations

import argparse
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))

from harness import Site
from harness import site_at

# The parameters that have no default, by executable.
EXECUTABLES = {
    'obb_to_hbb': {},
    'chip_extractor': {},
    'downlink': {'spool.path': 'spool', 'outbox.path': 'outbox'},
    'overlay': {},
    'ship_tracker': {},
    'play_detections': {},
    'payload': {'downlink:spool.path': 'spool', 'downlink:outbox.path': 'outbox'},
}


def interrupted(site: Site, executable: str, source: random.Random) -> str:
    """Start a node, interrupt it twice, and return how it ended."""
    folders = {name: site.folder / folder for name, folder in EXECUTABLES[executable].items()}
    with site.start(executable, parameters=folders) as process:
        time.sleep(source.uniform(0.0, 2.0))
        early = not process.has_signals_in_hand
        process.send_signal(signal.SIGINT)
        time.sleep(source.uniform(0.0, 0.05))
        process.send_signal(signal.SIGINT)
        try:
            code = process.wait()
        except subprocess.TimeoutExpired:
            code = None
    if early:
        return 'before the first line'
    loud = [line for line in process.log.splitlines() if '[INFO]' not in line]
    if code == 0 and not loud:
        return 'clean'
    print(f'{executable}: exit code {code}; None: it hung\n{process.log}', file=sys.stderr)
    return 'unclean'


def main() -> None:
    """Interrupt and judge."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parser.add_argument('--count', type=int, default=100, help='starts of each executable')
    parser.add_argument('--seed', type=int, default=1)
    options = parser.parse_args()
    source = random.Random(options.seed)
    good = True
    os.environ['RCUTILS_LOGGING_MIN_SEVERITY'] = 'WARN'
    with tempfile.TemporaryDirectory() as folder, site_at(Path(folder)) as site:
        for executable in EXECUTABLES:
            ends = Counter(interrupted(site, executable, source) for _ in range(options.count))
            print(f'{executable}: {dict(ends)}', flush=True)
            good = good and not ends['unclean']
    sys.exit(0 if good else 1)


if __name__ == '__main__':
    main()
