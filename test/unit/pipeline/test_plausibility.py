# SPDX-License-Identifier: Apache-2.0
"""Scores and angles that a detector hardly means."""

import numpy as np
import pytest

from obbhbb_ros.pipeline.plausibility import OutsideWatch
from obbhbb_ros.pipeline.plausibility import doubtful_angles
from obbhbb_ros.pipeline.plausibility import doubtful_scores
from obbhbb_ros.pipeline.plausibility import frames_text


@pytest.mark.parametrize(
    ('theta', 'rows'),
    [([0.0, 2 * np.pi, -6.3, np.nan, np.inf], []), ([0.0, 6.31, np.nan, -90.0, -np.inf], [1, 3])],
)
def test_angles_beyond_a_turn_are_doubtful(theta: list[float], rows: list[int]) -> None:
    doubts = list(doubtful_angles(np.array(theta)))
    assert [doubt.rows.tolist() for doubt in doubts] == ([rows] if rows else [])


@pytest.mark.parametrize(
    ('scores', 'reasons'),
    [
        ([], {}),
        ([0.0, 1.0, np.nan, np.float32(1.0) + np.finfo(np.float32).eps / 2], {}),
        ([87.0, 0.5, 12.0], {'above_one': [0, 2]}),
        ([-0.5, np.nan, -7.0, 2.0], {'above_one': [3], 'negative': [0, 2]}),
        ([0.5, -np.inf, np.inf], {'infinite': [1, 2]}),
    ],
)
def test_scores_that_are_no_fractions_are_doubtful(
    scores: list[float], reasons: dict[str, list[int]]
) -> None:
    doubts = doubtful_scores(np.array(scores))
    assert {doubt.key: doubt.rows.tolist() for doubt in doubts} == {
        f'scores_doubtful.{reason}': rows for reason, rows in reasons.items()
    }


@pytest.mark.parametrize(
    ('one', 'other', 'differ'),
    [('left', 'right', True), ('left', 'left', False), ('', 'right', False), ('left', '', False)],
)
def test_frames_differ_where_both_are_named(one: str, other: str, differ: bool) -> None:
    text = frames_text(('image', one), ('camera_info', other))
    assert bool(text) == differ
    assert not differ or ("'left'" in text and "'right'" in text)


@pytest.mark.parametrize(
    ('messages', 'said'),
    [
        ([(19, 19)], [False]),
        ([(11, 20)], [True]),
        ([(10, 20)], [False]),
        ([(1, 1)] * 20, [False] * 19 + [True]),
        # After a verdict, it begins again.
        ([(30, 30), (0, 19), (1, 1)], [True, False, False]),
    ],
)
def test_detections_that_lie_outside_as_a_rule_are_noticed(
    messages: list[tuple[int, int]], said: list[bool]
) -> None:
    watch = OutsideWatch()
    assert [bool(watch.note(*message, (640, 480))) for message in messages] == said
