# SPDX-License-Identifier: Apache-2.0
"""What each launch file starts: executables, names, parameter files, remaps, DDS profile."""

import math
import re
from pathlib import Path

import pytest
from launch_files import launched

from obbhbb_ros.settings.parameter_file import read_values

ROOT = Path(__file__).parents[2]
CONVERTER = ROOT / 'launch' / 'obb_to_hbb.launch.py'
DOWNLINK = ROOT / 'launch' / 'downlink.launch.py'
CHAIN = ('obb_to_hbb', 'chip_extractor', 'downlink')
NODES = (*CHAIN, 'overlay', 'ship_tracker')
CHAIN_TOPICS = (
    'detections',
    'polygons',
    'camera_info',
    'image',
    'contact',
    'boxes',
    'crop_regions',
    'crop_sources',
    'tracked_detections',
    'camera_pose',
    'fix',
    'attitude',
    'positions',
    'image_pose',
)
TOPICS = ('detections', 'polygons', 'camera_info', 'boxes', 'crop_regions', 'crop_sources')
LARGE = 'config/fastdds_nodes.xml'
SEEN_SOON = 'config/fastdds.xml'


def test_the_conversion_node_is_launched_as_it_is() -> None:
    (node,) = launched(CONVERTER).started
    assert node.executable == 'obb_to_hbb'
    itself = {'__node': 'obb_to_hbb', '__ns': '/'}
    assert node.remaps == itself | {topic: topic for topic in TOPICS}
    assert node.values('--params-file') == ['config/obb_to_hbb.yaml']
    assert node.values('--log-level') == ['info']
    assert node.parameters == {}
    assert node.profile == SEEN_SOON
    assert node.respawn


def test_every_argument_of_the_conversion_node_applies(tmp_path: Path) -> None:
    file = tmp_path / 'params.yaml'
    file.write_text('/**: {ros__parameters: {q: 2.0}}\n')
    topics = {topic: f'/other/{topic}' for topic in TOPICS}
    given = {
        'params_file': str(file),
        'name': 'ships',
        'namespace': 'sat/payload',
        'log_level': 'warn',
        'large_messages': 'true',
        **topics,
        'respawn': 'false',
        'respawn_delay': '0.5',
        'state': '/data/state',
    }
    ran = launched(CONVERTER, given)
    assert set(ran.declared) == set(given)
    (node,) = ran.started
    assert node.executable == 'obb_to_hbb'
    assert node.remaps == {'__node': 'ships', '__ns': '/sat/payload', **topics}
    assert node.values('--params-file') == [str(file)]
    assert node.values('--log-level') == ['warn']
    assert node.parameters == {'state.path': '/data/state/sat/payload/ships.json'}
    assert node.profile == LARGE
    assert not node.respawn


def test_the_downlink_is_three_nodes_each_with_its_parameters(monkeypatch) -> None:
    monkeypatch.setenv('ROS_HOME', '/home/of/ros')
    ran = launched(DOWNLINK).started
    assert [node.executable for node in ran] == sorted(CHAIN)
    spool, outbox = (f'/home/of/ros/obbhbb/{folder}' for folder in ('spool', 'outbox'))
    folders = {
        'chip_extractor': {'spool.path': spool},
        'obb_to_hbb': {},
        'downlink': {'spool.path': spool, 'outbox.path': outbox},
    }
    for node in ran:
        itself = {'__node': node.executable, '__ns': '/'}
        assert node.remaps == itself | {topic: topic for topic in CHAIN_TOPICS}
        assert node.values('--params-file') == [f'config/{node.executable}.yaml']
        assert node.parameters == folders[node.executable]
        assert node.profile == SEEN_SOON
        assert node.respawn


def test_every_argument_of_the_downlink_applies(tmp_path: Path) -> None:
    files = {name: tmp_path / f'{name}.yaml' for name in NODES}
    common = tmp_path / 'common.yaml'
    for file in (common, *files.values()):
        file.write_text('/**: {ros__parameters: {autostart: true}}\n')
    topics = {topic: f'/other/{topic}' for topic in CHAIN_TOPICS}
    given = {
        'params_file': str(common),
        'nodes': ' '.join(NODES),
        'namespace': 'payload',
        'large_messages': 'true',
        'spool': '/data/spool',
        'outbox': '/data/outbox',
        'log_level': 'debug',
        'respawn': 'false',
        'respawn_delay': '2.0',
        'state': '/data/state',
        **topics,
        **{f'{name}_params_file': str(file) for name, file in files.items()},
    }
    ran = launched(DOWNLINK, given)
    assert set(ran.declared) == {*given, 'one_process'}
    assert [node.executable for node in ran.started] == sorted(NODES)
    for node in ran.started:
        itself = {'__node': node.executable, '__ns': '/payload'}
        behind = {'detections': topics['tracked_detections']}
        read = behind if node.executable == 'obb_to_hbb' else {}
        assert node.remaps == itself | topics | read
        assert node.values('--params-file') == [str(files[node.executable]), str(common)]
        assert node.values('--log-level') == ['debug']
        assert node.parameters.get('spool.path', '/data/spool') == '/data/spool'
        assert node.parameters['state.path'] == f'/data/state/payload/{node.executable}.json'
        assert node.profile == LARGE
        assert not node.respawn


def test_a_dds_profile_of_the_environment_stays() -> None:
    (node,) = launched(CONVERTER, profile='/flight/dds.xml').started
    assert node.profile == '/flight/dds.xml'
    (node,) = launched(CONVERTER, {'large_messages': 'true'}, profile='/flight/dds.xml').started
    assert node.profile == LARGE


@pytest.mark.parametrize('name', NODES)
def test_each_node_can_be_launched_alone(name: str) -> None:
    (node,) = launched(DOWNLINK, {'nodes': name}).started
    assert node.executable == node.remaps['__node'] == name
    assert node.values('--params-file') == [f'config/{name}.yaml']
    assert node.respawn


def test_nodes_in_one_process_have_their_own_parameters_and_topics(tmp_path: Path) -> None:
    file = tmp_path / 'mission.yaml'
    file.write_text('/**/obb_to_hbb: {ros__parameters: {q: .inf, crop: {padding: 0.25}}}\n')
    given = {
        'one_process': 'true',
        'nodes': 'ship_tracker obb_to_hbb chip_extractor downlink',
        'namespace': 'sat',
        'params_file': str(file),
        'spool': '/data/spool',
        'state': '/data/state',
        'image': '/camera',
    }
    (process,) = launched(DOWNLINK, given).started
    nodes = given['nodes'].split()
    assert process.executable == 'payload'
    assert process.respawn
    assert process.arguments[: len(nodes) + 1] == ['--nodes', *nodes]
    assert process.remaps['__ns'] == '/sat'
    assert '__node' not in process.remaps
    assert process.remaps['chip_extractor:image'] == '/camera'
    assert process.remaps['obb_to_hbb:detections'] == 'tracked_detections'
    assert process.remaps['ship_tracker:detections'] == 'detections'
    (merged,) = map(Path, process.values('--params-file'))
    values = {name: read_values(merged, f'/sat/{name}') for name in nodes}
    assert (values['obb_to_hbb']['q'], values['obb_to_hbb']['crop.padding']) == (math.inf, 0.25)
    assert values['obb_to_hbb']['s'] == 1.0
    assert values['downlink']['spool.path'] == values['chip_extractor']['spool.path']
    assert values['ship_tracker']['spool.path'] == values['chip_extractor']['spool.path']
    assert 'spool.path' not in values['obb_to_hbb']
    assert {name: values[name]['state.path'] for name in nodes} == {
        name: f'/data/state/sat/{name}.json' for name in nodes
    }


def test_the_conversion_reads_what_the_tracker_publishes() -> None:
    names = 'obb_to_hbb ship_tracker'
    given = {'nodes': names, 'detections': '/yolo', 'tracked_detections': '/ships'}
    converter, tracker = launched(DOWNLINK, given).started
    assert converter.remaps['detections'] == '/ships'
    assert converter.parameters['input_type'] == 'Detection2DArray'
    assert tracker.remaps['detections'] == '/yolo'
    assert tracker.remaps['tracked_detections'] == '/ships'
    assert 'input_type' not in tracker.parameters


def test_some_of_the_nodes_can_be_launched() -> None:
    given = {'nodes': 'downlink, chip_extractor', 'spool': 'none', 'respawn': 'false'}
    ran = launched(DOWNLINK, given)
    assert [node.executable for node in ran.started] == ['chip_extractor', 'downlink']
    assert 'spool.path' not in {**ran.started[0].parameters, **ran.started[1].parameters}


@pytest.mark.parametrize(
    ('section', 'given', 'expected'),
    [
        ('/payload/downlink', {}, {'outbox.path'}),
        ('/**', {}, {'outbox.path'}),
        ('/elsewhere/downlink', {}, {'spool.path', 'outbox.path'}),
        ('/payload/downlink', {'spool': '/data/spool'}, {'spool.path', 'outbox.path'}),
        ('/payload/downlink', {'outbox': 'none'}, set()),
    ],
)
@pytest.mark.parametrize('which', ['downlink_params_file', 'params_file'])
def test_a_folder_in_the_parameter_file_applies_unless_an_argument_names_another(
    tmp_path: Path, which: str, section: str, given: dict[str, str], expected: set[str]
) -> None:
    file = tmp_path / 'params.yaml'
    file.write_text(f'{section}: {{ros__parameters: {{spool.path: /in/file, outbox.path: ""}}}}\n')
    arguments = {'nodes': 'downlink', 'namespace': 'payload', which: str(file)}
    (node,) = launched(DOWNLINK, arguments | given).started
    assert set(node.parameters) == expected
    assert node.parameters.get('spool.path') != '/in/file'


def test_each_namespace_has_folders_of_its_own_by_default(monkeypatch) -> None:
    monkeypatch.setenv('ROS_HOME', '/home/of/ros')
    (node,) = launched(DOWNLINK, {'nodes': 'downlink', 'namespace': '/sat/payload'}).started
    assert node.parameters == {
        f'{folder}.path': f'/home/of/ros/obbhbb/sat/payload/{folder}'
        for folder in ('spool', 'outbox')
    }


@pytest.mark.parametrize(
    ('section', 'readers'),
    [
        ('/**', ('chip_extractor', 'downlink', 'obb_to_hbb')),
        ('/payload/downlink', ('downlink',)),
        ('/elsewhere/downlink', ('chip_extractor', 'downlink', 'obb_to_hbb')),
    ],
)
def test_the_common_file_goes_to_the_nodes_that_it_names_or_if_there_are_none_to_all(
    tmp_path: Path, section: str, readers: tuple[str, ...]
) -> None:
    file = tmp_path / 'params.yaml'
    file.write_text(f'{section}: {{ros__parameters: {{autostart: true}}}}\n')
    ran = launched(DOWNLINK, {'params_file': str(file), 'namespace': 'payload'}).started
    assert [n.executable for n in ran if str(file) in n.values('--params-file')] == [*readers]


@pytest.mark.parametrize('file', [CONVERTER, DOWNLINK], ids=lambda file: file.name)
def test_a_missing_parameter_file_starts_nothing(file: Path) -> None:
    with pytest.raises((FileNotFoundError, AssertionError), match='no such parameter file'):
        launched(file, {'params_file': '/no.yaml'})


@pytest.mark.parametrize('file', [CONVERTER, DOWNLINK], ids=lambda file: file.name)
def test_nothing_is_logged_about_the_parameter_files_of_the_package(file: Path) -> None:
    assert launched(file, {'namespace': 'payload'}).logged == []


@pytest.mark.parametrize('file', [CONVERTER, DOWNLINK], ids=lambda file: file.name)
def test_what_a_launch_file_takes_by_default_exists(file: Path) -> None:
    defaults = launched(file).declared.values()
    paths = [value for value in defaults if value.startswith('config/')]
    assert paths
    assert all((ROOT / path).is_file() for path in [*paths, LARGE, SEEN_SOON])


def test_every_launch_file_is_tested_here() -> None:
    assert {*(ROOT / 'launch').glob('*.py')} == {CONVERTER, DOWNLINK}


def test_an_unknown_node_is_refused() -> None:
    with pytest.raises((ValueError, AssertionError), match='nodes: overlays is none of obb_to_hbb'):
        launched(DOWNLINK, {'nodes': 'downlink overlays'})


def test_every_dds_profile_makes_the_same_announcements() -> None:
    files = sorted((ROOT / 'config').glob('fastdds*.xml'))
    announcements = {
        re.search(r' *<discovery_config>.*</discovery_config>\n', file.read_text(), re.DOTALL)[0]
        for file in files
    }
    assert len(files) == 3
    assert len(announcements) == 1
