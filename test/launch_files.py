# SPDX-License-Identifier: Apache-2.0
"""
Launch files, run with something else in place of the nodes, to see how those would be started.

On a machine with ROS they go through `launch` itself, elsewhere through stand-ins for it.
"""

from __future__ import annotations

import importlib.util
import json
import os
import runpy
import subprocess
import sys
from collections.abc import Callable
from collections.abc import Mapping
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.metadata import entry_points
from itertools import pairwise
from pathlib import Path
from tempfile import TemporaryDirectory
from types import SimpleNamespace
from typing import Any
from unittest.mock import patch

ROOT = Path(__file__).parents[1]
PROFILE = 'FASTRTPS_DEFAULT_PROFILES_FILE'
# The folder `launch` of the checkout can be imported too, so that one is no sign.
HAVE_LAUNCH = importlib.util.find_spec('launch_ros') is not None


@dataclass
class Started:
    """A node that a launch file starts."""

    executable: str
    arguments: list[str]
    profile: str | None

    def values(self, flag: str) -> list[str]:
        """Give what stands behind each occurrence of a flag."""
        return [value for name, value in pairwise(self.arguments) if name == flag]

    @property
    def remaps(self) -> dict[str, str]:
        """Give the remaps, with name and namespace of the node among them."""
        return dict(value.split(':=') for value in self.values('-r'))


@dataclass
class Launched:
    """What a launch file declares, with defaults below the package's folder, and what it starts."""

    declared: dict[str, str]
    started: list[Started]


def launched(file: Path, given: Mapping[str, str] | None = None) -> Launched:
    """Run a launch file with arguments."""
    with TemporaryDirectory() as folder:
        found = (_by_launch if HAVE_LAUNCH else _by_stand_ins)(file, given or {}, Path(folder))
        share = f'{folder}/share/obbhbb_ros/'
        found = json.loads(json.dumps(found).replace(share, ''))
    started = sorted((Started(*each) for each in found['started']), key=lambda s: s.executable)
    return Launched(found['declared'], started)


# The real one ---------------------------------------------------------------------------------

LAUNCH = """
import json, sys
from pathlib import Path
from launch import LaunchContext
from launch import LaunchDescription
from launch import LaunchService
from launch.actions import IncludeLaunchDescription
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.utilities import perform_substitutions

file, folder, given = sys.argv[1:]
source = PythonLaunchDescriptionSource(file)
context = LaunchContext()
declared = {
    each.name: perform_substitutions(context, each.default_value)
    for each in source.get_launch_description(context).get_launch_arguments()
    if each.description
}
(Path(folder) / 'declared').write_text(json.dumps(declared))
service = LaunchService()
include = IncludeLaunchDescription(source, launch_arguments=json.loads(given).items())
service.include_launch_description(LaunchDescription([include]))
sys.exit(service.run())
"""

# In place of each executable.
NODE = f"""#!{sys.executable}
import json, os, sys
from pathlib import Path
me = Path(sys.argv[0])
started = [me.name, sys.argv[1:], os.environ.get({PROFILE!r})]
(me.parents[2] / f'{{os.getpid()}}.started').write_text(json.dumps(started))
"""


def _by_launch(file: Path, given: Mapping[str, str], folder: Path) -> dict[str, Any]:
    """Install scripts in place of the executables and launch them."""
    (folder / 'share' / 'obbhbb_ros').mkdir(parents=True)
    (folder / 'share' / 'obbhbb_ros' / 'config').symlink_to(ROOT / 'config')
    index = folder / 'share' / 'ament_index' / 'resource_index' / 'packages'
    index.mkdir(parents=True)
    (index / 'obbhbb_ros').touch()
    programs = folder / 'lib' / 'obbhbb_ros'
    programs.mkdir(parents=True)
    for each in entry_points(group='console_scripts'):
        if each.value.startswith('obbhbb_ros.nodes.'):
            (programs / each.name).write_text(NODE)
            (programs / each.name).chmod(0o755)
    prefixes = [str(folder), *os.environ.get('AMENT_PREFIX_PATH', '').split(os.pathsep)]
    environment = {name: value for name, value in os.environ.items() if name != PROFILE} | {
        'AMENT_PREFIX_PATH': os.pathsep.join(filter(None, prefixes)), 'ROS_LOG_DIR': str(folder),
    }
    finished = subprocess.run(
        [sys.executable, '-c', LAUNCH, file, folder, json.dumps(given)],
        env=environment, check=False, timeout=60, capture_output=True, text=True, cwd=folder,
    )
    assert finished.returncode == 0, finished.stdout + finished.stderr
    return {
        'declared': json.loads((folder / 'declared').read_text()),
        'started': [json.loads(each.read_text()) for each in folder.glob('*.started')],
    }


# Stand-ins ------------------------------------------------------------------------------------

def _by_stand_ins(file: Path, given: Mapping[str, str], folder: Path) -> dict[str, Any]:
    """Give the file functions whose results do what they stand for, in the order described."""
    defaults: dict[str, str] = {}
    declared: dict[str, str] = {}
    started: list[tuple[str, list[str], str | None]] = []
    environment: dict[str, str] = {}

    def declare(name: str, *, default_value: str, description: str) -> Callable[[], None]:
        assert description
        defaults[name] = default_value
        return lambda: declared.update({name: default_value})

    def configuration(name: str) -> str:
        return given.get(name, defaults[name])

    def set_variable(name: str, value: str, condition: bool = True) -> Callable[[], None]:
        return lambda: environment.update({name: value} if condition else {})

    def node(
        *, package: str, executable: str, name: str, namespace: str, parameters: list[str],
        remappings: list[tuple[str, str]], output: str, ros_arguments: Sequence[str] = (),
    ) -> Callable[[], None]:
        assert (package, output) == ('obbhbb_ros', 'screen')
        arguments = [*ros_arguments, '-r', f'__node:={name}']
        arguments += ['-r', f'__ns:=/{namespace.lstrip("/")}']
        for path in parameters:
            arguments += ['--params-file', path]
        for old, new in remappings:
            arguments += ['-r', f'{old}:={new}']
        return lambda: started.append((executable, arguments, environment.get(PROFILE)))

    modules = {
        'launch': {'LaunchDescription': list},
        'launch.actions': {
            'DeclareLaunchArgument': declare, 'SetEnvironmentVariable': set_variable,
        },
        'launch.conditions': {'IfCondition': 'true'.__eq__},
        'launch.substitutions': {'LaunchConfiguration': configuration},
        'launch_ros': {},
        'launch_ros.actions': {'Node': node},
        'ament_index_python': {},
        'ament_index_python.packages': {
            'get_package_share_directory': lambda package: f'{folder}/share/{package}',
        },
    }
    with patch.dict(
        sys.modules, {name: SimpleNamespace(**content) for name, content in modules.items()}
    ):
        for action in runpy.run_path(str(file))['generate_launch_description']():
            action()
    return {'declared': declared, 'started': started}
