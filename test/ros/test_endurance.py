# SPDX-License-Identifier: Apache-2.0
"""Long-running commands of CONTRIBUTING still run, here for a moment each."""

import subprocess
import sys
from pathlib import Path

import pytest
from harness import Site

TEST = Path(__file__).parents[1]


@pytest.mark.once
@pytest.mark.parametrize(
    'command',
    [
        'fuzz/wire.py --inputs 300',
        'fuzz/inputs.py --inputs 20',
        'soak/node.py --minutes 0.05',
        'soak/chain.py --minutes 0.05 --rate 4 --detections 20',
        'soak/cycles.py --cycles 2',
        'soak/overload.py --seconds 2',
        'benchmarks/spool.py --chips 200 --seconds 0.5',
        'benchmarks/node.py --sizes 1 --rounds 1',
    ],
)
def test_it_runs_and_finds_nothing(site: Site, command: str) -> None:
    script, *arguments = command.split()
    ran = subprocess.run(
        [sys.executable, TEST / script, *arguments],
        capture_output=True,
        text=True,
        timeout=600,
        check=False,
    )
    assert ran.returncode == 0, ran.stdout + ran.stderr
