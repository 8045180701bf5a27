# SPDX-License-Identifier: Apache-2.0
"""The analyzers for diagnostic_aggregator match the status names of the managed nodes."""

import re
from pathlib import Path

import pytest
import yaml

MANAGED = {'obb_to_hbb', 'chip_extractor', 'downlink', 'overlay', 'ship_tracker'}
FILE = Path(__file__).parents[2] / 'config' / 'diagnostic_aggregator.yaml'
PARAMETERS = yaml.safe_load(FILE.read_text(encoding='utf-8'))['analyzers']['ros__parameters']
GROUP = PARAMETERS['obbhbb']


def matching(name: str) -> list[str]:
    """List the analyzers that take a status; like std::regex_match, for the whole name."""
    return [
        analyzer['path']
        for analyzer in GROUP['analyzers'].values()
        if any(re.fullmatch(pattern, name) for pattern in analyzer['regex'])
    ]


def test_a_managed_node_has_one_analyzer() -> None:
    assert GROUP['type'] == 'diagnostic_aggregator/AnalyzerGroup'
    assert set(GROUP['analyzers']) >= MANAGED
    for analyzer in GROUP['analyzers'].values():
        assert analyzer['type'] == 'diagnostic_aggregator/GenericAnalyzer'
        # ROS parameters have types.
        assert isinstance(analyzer['timeout'], float)


# `test_diagnostics.py` holds that a status has the full name of its node without the first slash.
@pytest.mark.parametrize('node', sorted(MANAGED))
def test_a_status_goes_to_the_analyzer_of_its_node(node: str) -> None:
    for name in (node, f'payload/{node}', f'fleet/one/{node}'):
        assert matching(name) == [node]
    assert matching(f'my_{node}') == matching(f'{node}_2') == matching(f'{node}/driver') == []
