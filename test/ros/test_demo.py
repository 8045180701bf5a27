# SPDX-License-Identifier: Apache-2.0
"""`obbhbb demo`: the harbour through a node of its own."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
from harness import Site

from obbhbb_ros import OrientedBoxes
from obbhbb_ros import convert
from obbhbb_ros.cli import main
from obbhbb_ros.geometry.methods import ONBOARD_METHODS
from obbhbb_ros.nodes.demo import boxes_by_method
from obbhbb_ros.study.harbour import harbour

# What it tests depends on rclpy, which is the same in all environments.
pytestmark = pytest.mark.once


def test_the_node_converts_with_every_method(site: Site) -> None:
    labels = harbour()
    found = boxes_by_method(labels)
    assert list(found) == list(ONBOARD_METHODS)
    for method, boxes in found.items():
        expected = convert(OrientedBoxes.from_corners(labels.corners), method=method)
        np.testing.assert_allclose(boxes, expected, rtol=0, atol=0.01, err_msg=method)


def test_an_existing_bag_is_kept(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    (tmp_path / 'flight').mkdir()
    assert main(['demo', '--bag', str(tmp_path / 'flight')]) == 1
    assert 'flight exists already' in capfd.readouterr().err


def test_without_rosbags_the_command_says_what_it_needs(
    site: Site, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip('matplotlib')
    monkeypatch.setitem(sys.modules, 'rosbags.rosbag2', None)
    monkeypatch.delitem(sys.modules, 'obbhbb_ros.bags.recording', raising=False)
    picture = tmp_path / 'new' / 'harbour.png'
    assert main(['demo', '--picture', str(picture)]) == 0
    printed = capfd.readouterr()
    assert all(f'\n{method} ' in printed.out for method in ONBOARD_METHODS)
    assert 'no bag, no overlay: ' in printed.out
    assert 'need the extras `bags` and `chips`' in printed.out
    assert printed.err == ''
    assert picture.read_bytes().startswith(b'\x89PNG')
    assert list(picture.parent.iterdir()) == [picture]
