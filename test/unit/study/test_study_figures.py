# SPDX-License-Identifier: Apache-2.0
"""The pictures and their place: colours of the methods, who draws and who does not."""

import subprocess
import sys

import numpy as np
import pytest
from fleets import REAL

from obbhbb_ros.geometry.methods import METHODS
from obbhbb_ros.geometry.methods import ONBOARD_METHODS
from obbhbb_ros.labels import read_labels
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


def test_what_computes_does_not_draw() -> None:
    program = (
        'import sys, obbhbb_ros.commands;'
        'sys.exit(any(name in sys.modules for name in ("matplotlib", "jinja2", "PIL")))'
    )
    assert subprocess.run([sys.executable, '-c', program], check=False).returncode == 0
