# SPDX-License-Identifier: Apache-2.0
"""
Launch files, run with something else in place of the nodes, to see how those would be started.

On a machine with ROS they go through `launch` itself, elsewhere through stand-ins for it.
"""

from __future__ import annotations

import importlib.util
import json
import os
import re
import runpy
import signal
import subprocess
import sys
import time
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
    parameters: dict[str, str]
    respawn: bool

    def values(self, flag: str) -> list[str]:
        """Give what stands behind each occurrence of a flag."""
        return [value for name, value in pairwise(self.arguments) if name == flag]

    @property
    def remaps(self) -> dict[str, str]:
        """Give the remaps, with name and namespace of the node among them."""
        return dict(value.split(':=') for value in self.values('-r'))


@dataclass
class Launched:
    """What a launch file declares, with defaults below the package's folder, starts, and says."""

    declared: dict[str, str]
    started: list[Started]
    said: list[str]


def launched(file: Path, given: Mapping[str, str] | None = None) -> Launched:
    """Run a launch file with arguments."""
    with TemporaryDirectory() as folder:
        found = (_by_launch if HAVE_LAUNCH else _by_stand_ins)(file, given or {}, Path(folder))
        share = f'{folder}/share/obbhbb_ros/'
        found = json.loads(json.dumps(found).replace(share, ''))
    started = sorted((Started(*each) for each in found['started']), key=lambda s: s.executable)
    return Launched(found['declared'], started, found['said'])


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

# In place of each executable; the first process of each ends at once. launch writes parameters to
# files of its own.
NODE = f"""#!{sys.executable}
import json, os, signal, sys, yaml
from pathlib import Path
me = Path(sys.argv[0])
arguments, own = sys.argv[1:], {{}}
for at in [i for i, word in enumerate(arguments) if word == '--params-file'][::-1]:
    if Path(arguments[at + 1]).name.startswith('launch_params_'):
        (section,) = yaml.safe_load(Path(arguments[at + 1]).read_text()).values()
        own.update(section['ros__parameters'])
        del arguments[at : at + 2]
before = list(me.parents[2].glob(me.name + '.*.started'))
started = [me.name, arguments, os.environ.get({PROFILE!r}), own, bool(before)]
(me.parents[2] / f'{{me.name}}.{{len(before)}}.started').write_text(json.dumps(started))
if before:
    signal.sigwait([signal.SIGINT])
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
        'AMENT_PREFIX_PATH': os.pathsep.join(filter(None, prefixes)),
        'ROS_LOG_DIR': str(folder),
    }
    with (folder / 'log').open('w') as log:
        process = subprocess.Popen(
            [sys.executable, '-c', LAUNCH, file, folder, json.dumps(given)],
            env=environment,
            stdout=log,
            stderr=log,
            cwd=folder,
        )
        try:
            # Without respawn it ends by itself.
            process.wait(_settled(folder))
        except subprocess.TimeoutExpired:
            process.send_signal(signal.SIGINT)
        assert process.wait(30) == 0, (folder / 'log').read_text()
    latest = {each.name.split('.')[0]: each for each in sorted(folder.glob('*.started'))}
    return {
        'declared': json.loads((folder / 'declared').read_text()),
        'started': [json.loads(each.read_text()) for each in latest.values()],
        'said': re.findall(r'\[launch\.user\]: (.*)', (folder / 'log').read_text()),
    }


def _settled(folder: Path) -> float:
    """Wait until no node has been started for some seconds; return 0."""
    count, since = 0, time.monotonic()
    while time.monotonic() < since + 4.0:
        found = len(list(folder.glob('*.started')))
        if found != count:
            count, since = found, time.monotonic()
        time.sleep(0.1)
    return 0.0


# Stand-ins ------------------------------------------------------------------------------------


class Configuration(str):
    """The value of an argument."""

    def perform(self, context: object) -> str:
        return str(self)


def _by_stand_ins(file: Path, given: Mapping[str, str], folder: Path) -> dict[str, Any]:
    """Give the file functions whose results do what they stand for, in the order described."""
    defaults: dict[str, str] = {}
    declared: dict[str, str] = {}
    started: list[tuple[str, list[str], str | None, dict[str, str], bool]] = []
    environment: dict[str, str] = {}
    said: list[str] = []
    (folder / 'share').mkdir()
    (folder / 'share' / 'obbhbb_ros').symlink_to(ROOT)

    def declare(name: str, *, default_value: str, description: str) -> Callable[[], None]:
        assert description
        defaults[name] = default_value
        return lambda: declared.update({name: default_value})

    def configuration(name: str) -> Configuration:
        return Configuration(given.get(name, defaults[name]))

    def set_variable(name: str, value: str, condition: bool = True) -> Callable[[], None]:
        return lambda: environment.update({name: value} if condition else {})

    def node(
        *,
        package: str,
        executable: str,
        name: str,
        namespace: str,
        parameters: list[Any],
        remappings: list[tuple[str, str]],
        output: str,
        ros_arguments: Sequence[str],
        respawn: bool,
        respawn_delay: float,
    ) -> Callable[[], None]:
        assert (package, output) == ('obbhbb_ros', 'screen')
        arguments = [*ros_arguments, '-r', f'__node:={name}']
        arguments += ['-r', f'__ns:=/{namespace.lstrip("/")}']
        for path in parameters:
            if isinstance(path, str):
                arguments += ['--params-file', path]
        for old, new in remappings:
            arguments += ['-r', f'{old}:={new}']
        assert respawn_delay >= 0.0
        own = {
            name: value
            for each in parameters
            if isinstance(each, dict)
            for name, value in each.items()
        }
        return lambda: started.append(
            (executable, arguments, environment.get(PROFILE), own, respawn)
        )

    modules = {
        'launch': {'LaunchDescription': list},
        'launch.actions': {
            'DeclareLaunchArgument': declare,
            'SetEnvironmentVariable': set_variable,
            'LogInfo': lambda msg: lambda: said.append(msg),
            'OpaqueFunction': lambda function: lambda: [action() for action in function(None)],
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
    return {'declared': declared, 'started': started, 'said': said}
