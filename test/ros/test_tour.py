# SPDX-License-Identifier: Apache-2.0
"""The tour: every command of the page, in its order, in one shell."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
from harness import Site

from obbhbb_ros.colors import LAYER_COLORS

# What it tests depends on rclpy, which is the same in all environments.
pytestmark = pytest.mark.once

pytest.importorskip('matplotlib')
pytest.importorskip('rosbags')
Image = pytest.importorskip('PIL.Image')

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / 'doc' / 'tour.md').read_text(encoding='utf-8')
BLOCKS = re.findall(r'^```(bash|python)\n(.*?)^```$', PAGE, re.MULTILINE | re.DOTALL)
# Made with q 3 by the demo, and with q 1 by the page.
PICTURES = ('overlay', 'rhombus')


def script() -> str:
    """Write the page as a script; what is in Python is given to Python."""
    lines = ['set -e']
    for language, block in BLOCKS:
        lines.append(block if language == 'bash' else f"python - <<'END'\n{block}END")
    # The checkout is there already.
    made, count = re.subn('^git clone .*$', '', '\n'.join(lines), flags=re.MULTILINE)
    assert count == 1
    return made


@pytest.fixture(scope='module')
def checkout(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A checkout whose environment has been set up: that of the tests."""
    folder = tmp_path_factory.mktemp('checkout')
    for path in ROOT.iterdir():
        if path.name not in ('scripts', 'out') and not path.name.startswith('.'):
            (folder / path.name).symlink_to(path)
    activate = folder / '.venv' / 'bin' / 'activate'
    activate.parent.mkdir(parents=True)
    activate.write_text(f'PATH="{Path(sys.executable).parent}:$PATH"\n')
    scripts = folder / 'scripts'
    scripts.mkdir()
    (scripts / 'demo').symlink_to(ROOT / 'scripts' / 'demo')
    (scripts / 'environment').write_text('set -euo pipefail\n. .venv/bin/activate\n')
    return folder


@pytest.fixture(scope='module')
def printed(site: Site, checkout: Path) -> str:
    """What the commands print."""
    log = checkout / 'printed.txt'
    with log.open('w') as stream:
        process = subprocess.Popen(
            ['bash', '-c', script()],
            cwd=checkout,
            stdout=stream,
            stderr=subprocess.STDOUT,
            start_new_session=True,
        )
    try:
        code = process.wait(600.0)
    finally:
        # A command that failed leaves the nodes behind it running.
        with suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
    text = log.read_text(encoding='utf-8')
    assert code == 0, text
    return text


def test_every_command_of_the_tour_runs(printed: str) -> None:
    assert 'Traceback' not in printed
    assert '[ERROR]' not in printed


def test_every_file_that_the_tour_names_is_there(printed: str, checkout: Path) -> None:
    table = re.findall(r'^\| `([\w./]+)` \|', PAGE, re.MULTILINE)
    named = {f'out/{each}' for each in table} | set(re.findall(r'`(out/[\w./]+)`', PAGE))
    assert len(named) >= 7
    for path in named:
        assert (checkout / path).exists(), path


def test_the_demo_prints_where_everything_is(printed: str) -> None:
    for path in ('harbour.png', 'overlay.jpg', 'frames', 'harbour_bag', 'pass'):
        assert re.search(rf'^\w+: +out/{path}\b', printed, re.MULTILINE), path


def test_of_a_pass_every_ship_comes_down_with_its_place(printed: str) -> None:
    chips, ships, chips_down, ships_down = map(
        int, re.findall(r'(\d+) (?:chips|ships)', flown(printed))
    )
    # A busy machine may lose an image.
    assert ships >= 30
    assert chips > 4 * ships
    assert ships_down == ships <= chips_down < chips / 4
    placed = re.search(
        r'^ships: (\d+), of (\d+) ship lists and (\d+) chips$', printed, re.MULTILINE
    )
    assert placed
    assert int(placed[1]) >= ships
    assert int(placed[2]) >= 1
    assert int(placed[3]) == chips_down


def flown(printed: str) -> str:
    """Find the line of the demo about its pass."""
    (line,) = (line for line in printed.splitlines() if line.startswith('pass: '))
    return line


def test_a_smaller_q_shows_more_of_the_crop_regions(printed: str, checkout: Path) -> None:
    before, after = (blue_pixels(checkout / 'out' / f'{name}.jpg') for name in PICTURES)
    assert after > 1.3 * before > 0


def blue_pixels(path: Path) -> int:
    """Count pixels of the colour of crop regions, as a JPEG keeps it."""
    color = [int(LAYER_COLORS['crop_regions'][i : i + 2], 16) for i in (1, 3, 5)]
    with Image.open(path) as picture:
        difference = np.abs(np.asarray(picture).astype(int) - color).sum(axis=2)
    return int((difference < 60).sum())


def test_the_gallery_has_chips_and_no_problems(printed: str) -> None:
    found = re.search(r'^chips: (\d+), problems: (\d+)$', printed, re.MULTILINE)
    assert found
    assert int(found[1]) > 0
    assert int(found[2]) == 0
