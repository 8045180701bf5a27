# SPDX-License-Identifier: Apache-2.0
"""Kills and failing disks at any instruction: nothing is lost, nothing comes twice."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from library import build

FAULTS = Path(__file__).parent


@pytest.fixture(scope='session')
def library(tmp_path_factory):
    return build(tmp_path_factory.mktemp('faults'))


@pytest.mark.once
@pytest.mark.parametrize('script', ['kill_points', 'disk_errors'])
def test_nothing_is_lost_and_nothing_comes_twice(script, library, tmp_path) -> None:
    """A fault at every few calls; the scripts take all of them with --all."""
    environment = {**os.environ, 'LD_PRELOAD': str(library), 'TMPDIR': str(tmp_path)}
    done = subprocess.run(
        [sys.executable, str(FAULTS / f'{script}.py')],
        env=environment,
        text=True,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        check=False,
    )
    assert done.returncode == 0, done.stdout
    # There were faults, and chips that they cost.
    assert 'refused' in done.stdout
