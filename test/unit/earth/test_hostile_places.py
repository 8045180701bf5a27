# SPDX-License-Identifier: Apache-2.0
"""A sample of what `test/fuzz/places.py` tries: a place or a reason, and no warning."""

import sys
from pathlib import Path

import pytest

FUZZ = Path(__file__).parents[2] / 'fuzz' / 'places.py'


def test_cameras_and_poses_that_nobody_means(monkeypatch, capsys) -> None:
    monkeypatch.syspath_prepend(str(FUZZ.parent))
    places = pytest.importorskip('places')
    monkeypatch.setattr(sys, 'argv', [str(FUZZ), '--inputs', '1500', '--seed', '2'])
    places.main()
    assert ' placed' in capsys.readouterr().out
