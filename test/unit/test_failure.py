# SPDX-License-Identifier: Apache-2.0
"""What a process says if its node cannot start."""

from __future__ import annotations

import pytest

from obbhbb_ros.nodes.failure import cannot_start


def test_a_whole_number_in_place_of_a_double_is_explained(
    capsys: pytest.CaptureFixture[str],
) -> None:
    text = "Trying to set parameter 'q' to '3' of type 'INTEGER', expecting type 'DOUBLE': q"
    assert cannot_start(RuntimeError(text)) == 1
    line = capsys.readouterr().err
    assert line == f'cannot start: {text}; write 2.0 instead of 2\n'
