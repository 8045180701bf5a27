# SPDX-License-Identifier: Apache-2.0
"""What each launch file starts: executables, names, parameter files, remaps, DDS profile."""

from pathlib import Path

import pytest
from launch_files import launched

ROOT = Path(__file__).parents[2]
CONVERTER = ROOT / 'launch' / 'obb_to_hbb.launch.py'
DOWNLINK = ROOT / 'launch' / 'downlink.launch.py'
TOPICS = ('detections', 'polygons', 'camera_info', 'boxes', 'crop_regions')
LARGE = 'config/fastdds_large.xml'


def test_the_conversion_node_is_launched_as_it_is() -> None:
    (node,) = launched(CONVERTER).started
    assert node.executable == 'obb_to_hbb'
    itself = {'__node': 'obb_to_hbb', '__ns': '/'}
    assert node.remaps == itself | {topic: topic for topic in TOPICS}
    assert node.values('--params-file') == ['config/obb_to_hbb.yaml']
    assert node.values('--log-level') == ['info']
    assert node.profile is None


def test_every_argument_of_the_conversion_node_counts(tmp_path: Path) -> None:
    file = tmp_path / 'mine.yaml'
    file.write_text('/**: {ros__parameters: {q: 2.0}}\n')
    topics = {topic: f'/other/{topic}' for topic in TOPICS}
    given = {
        'params_file': str(file), 'name': 'ships', 'namespace': 'sat/payload',
        'log_level': 'warn', 'large_messages': 'true', **topics,
    }
    ran = launched(CONVERTER, given)
    assert set(ran.declared) == set(given)
    (node,) = ran.started
    assert node.executable == 'obb_to_hbb'
    assert node.remaps == {'__node': 'ships', '__ns': '/sat/payload', **topics}
    assert node.values('--params-file') == [str(file)]
    assert node.values('--log-level') == ['warn']
    assert node.profile == LARGE


def test_the_downlink_is_both_nodes_each_with_its_parameters() -> None:
    nodes = launched(DOWNLINK).started
    assert [node.executable for node in nodes] == ['chip_extractor', 'obb_to_hbb']
    for node in nodes:
        assert node.remaps == {'__node': node.executable, '__ns': '/', 'image': 'image'}
        assert node.values('--params-file') == [f'config/{node.executable}.yaml']
        assert node.profile is None


def test_every_argument_of_the_downlink_counts(tmp_path: Path) -> None:
    files = {name: tmp_path / f'{name}.yaml' for name in ('chip_extractor', 'obb_to_hbb')}
    for file in files.values():
        file.write_text('/**: {ros__parameters: {autostart: true}}\n')
    given = {
        'namespace': 'payload', 'image': '/camera/image', 'large_messages': 'true',
        **{f'{name}_params_file': str(file) for name, file in files.items()},
    }
    ran = launched(DOWNLINK, given)
    assert set(ran.declared) == set(given)
    assert [node.executable for node in ran.started] == list(files)
    for node in ran.started:
        assert node.remaps['__node'] == node.executable
        assert node.remaps['__ns'] == '/payload'
        assert node.remaps['image'] == '/camera/image'
        assert node.values('--params-file') == [str(files[node.executable])]
        assert node.profile == LARGE


@pytest.mark.parametrize('file', [CONVERTER, DOWNLINK], ids=lambda file: file.name)
def test_what_a_launch_file_takes_by_default_exists(file: Path) -> None:
    defaults = launched(file).declared.values()
    paths = [value for value in defaults if value.startswith('config/')]
    assert paths
    assert all((ROOT / path).is_file() for path in [*paths, LARGE])


def test_every_launch_file_is_tested_here() -> None:
    assert {*(ROOT / 'launch').glob('*.py')} == {CONVERTER, DOWNLINK}
