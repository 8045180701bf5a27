# SPDX-License-Identifier: Apache-2.0
"""The package as others get it: a wheel for pip, a colcon build for ROS."""

import os
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
SHARE = [
    'ament_index/resource_index/packages/obbhbb_ros',
    'obbhbb_ros/package.xml',
    'obbhbb_ros/config/obb_to_hbb.yaml',
    'obbhbb_ros/config/chip_extractor.yaml',
    'obbhbb_ros/config/overlay.yaml',
    'obbhbb_ros/config/ship_tracker.yaml',
    'obbhbb_ros/config/paper.yaml',
    'obbhbb_ros/config/diagnostic_aggregator.yaml',
    'obbhbb_ros/config/fastdds.xml',
    'obbhbb_ros/config/fastdds_large.xml',
    'obbhbb_ros/config/fastdds_nodes.xml',
    'obbhbb_ros/config/foxglove_layout.json',
    'obbhbb_ros/config/security/policy.xml',
    'obbhbb_ros/launch/downlink.launch.py',
    'obbhbb_ros/launch/obb_to_hbb.launch.py',
]


@pytest.fixture(scope='module')
def source(tmp_path_factory) -> Path:
    """Copy what git has, so that builds leave nothing in the checkout."""
    target = tmp_path_factory.mktemp('workspace') / 'src' / 'obbhbb_ros'
    ignore = shutil.ignore_patterns('.*', '*.egg-info', 'build', 'install', 'log', '__pycache__')
    shutil.copytree(ROOT, target, ignore=ignore)
    return target


def test_a_wheel_holds_code_data_and_ros_resources(source, tmp_path) -> None:
    command = [sys.executable, '-m', 'pip', 'wheel', '--quiet', '--no-deps', '-w', tmp_path, source]
    subprocess.run(command, check=True, timeout=300)
    (wheel,) = tmp_path.glob('*.whl')
    names = zipfile.ZipFile(wheel).namelist()
    assert all(any(name.endswith(f'/data/share/{path}') for name in names) for path in SHARE)
    files = [
        'data/harbour.csv',
        'labels/dota.py',
        'nodes/obb_to_hbb.py',
        'py.typed',
        'ground/templates/gallery.html',
        'study/templates/report.html',
        'templates/base.css',
    ]
    for path in files:
        assert f'obbhbb_ros/{path}' in names
    assert not any(name.startswith('test') for name in names)


def test_colcon_builds_a_package_whose_executables_run(source) -> None:
    workspace = source.parents[1]
    subprocess.run(
        ['colcon', 'build', '--packages-select', 'obbhbb_ros'],
        cwd=workspace,
        check=True,
        timeout=300,
        capture_output=True,
    )
    install = workspace / 'install' / 'obbhbb_ros'
    assert all((install / 'share' / path).is_file() for path in SHARE)
    site = next((install / 'lib').glob('python3*/site-packages'))
    environment = os.environ | {'PYTHONPATH': f'{site}:{os.environ.get("PYTHONPATH", "")}'}
    # Not `autostart`ed with a wrong value: the node starts, finds it, and says so.
    finished = subprocess.run(
        [install / 'lib' / 'obbhbb_ros' / 'obb_to_hbb', '--ros-args', '-p', 'q:=0.5'],
        env=environment,
        check=False,
        timeout=60,
        capture_output=True,
        text=True,
    )
    assert finished.returncode == 1
    assert 'q must be 1 to inf, not 0.5' in finished.stderr
