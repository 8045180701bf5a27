# SPDX-License-Identifier: Apache-2.0
"""The pictures and their place: colours of the methods, who draws and who does not."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from fleets import REAL

from obbhbb_ros.geometry.methods import METHODS
from obbhbb_ros.geometry.methods import ONBOARD_METHODS
from obbhbb_ros.labels import read_labels
from obbhbb_ros.labels.label_file import Box
from obbhbb_ros.labels.label_file import LabelFile
from obbhbb_ros.study.harbour import harbour
from obbhbb_ros.study.ships import read_ships

figures = pytest.importorskip('obbhbb_ros.study.figures')
report = pytest.importorskip('obbhbb_ros.study.report')


def test_every_method_has_a_colour_of_its_own() -> None:
    assert set(figures.METHOD_COLORS) == set(METHODS)
    assert len(set(figures.METHOD_COLORS.values())) == len(METHODS)


def test_a_method_without_a_colour_is_drawn_all_the_same(monkeypatch) -> None:
    monkeypatch.delitem(figures.METHOD_COLORS, 'midpoint')
    page = report.report_page(read_ships([REAL]), 'real', gallery=2)
    assert '.m-midpoint { stroke: black;' in page


def test_a_scene_is_drawn_with_and_without_hulls(tmp_path) -> None:
    for labels in (harbour(), next(iter(read_labels(REAL)))):
        boxes = {
            name: np.hstack((labels.corners.min(axis=1), labels.corners.max(axis=1)))
            for name in ONBOARD_METHODS
        }
        figures.save(figures.scene_figure(labels, boxes), tmp_path / 'scene.png')
        assert (tmp_path / 'scene.png').read_bytes().startswith(b'\x89PNG')


@pytest.mark.parametrize('channels', [1, 3])
def test_a_large_ship_is_drawn_from_few_pixels_in_its_place(channels: int) -> None:
    box = Box((100.0, 100.0, 2900.0, 100.0, 2900.0, 900.0, 100.0, 900.0), 'ship')
    labels = LabelFile(Path('a')).image('a', [box])
    pixels = np.zeros((1001, 3001, channels), np.uint8)
    pixels[:, 1500:] = 200
    boxes = {'outer': np.array([[100.0, 100.0, 2900.0, 900.0]])}
    (axes,) = figures.ship_figure(labels, pixels, boxes, 0).axes
    (picture,) = axes.images
    shown, (left, right, _, _) = np.asarray(picture.get_array()), picture.get_extent()
    assert max(shown.shape) <= 1600
    first = int(np.flatnonzero(shown.reshape(*shown.shape[:2], -1)[0, :, 0] > 100)[0])
    assert left + first * (right - left) / shown.shape[1] == pytest.approx(1500.0, abs=4.0)


def test_what_computes_does_not_draw() -> None:
    program = (
        'import sys, obbhbb_ros.commands;'
        'sys.exit(any(name in sys.modules for name in ("matplotlib", "jinja2", "PIL")))'
    )
    assert subprocess.run([sys.executable, '-c', program], check=False).returncode == 0
