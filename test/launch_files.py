# SPDX-License-Identifier: Apache-2.0
"""
Launch files, run with scripts in place of the nodes, to see how the nodes would be started.

On a machine with ROS they are run by `launch` itself, elsewhere with stand-ins for it.
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
# Not `launch`: the folder of that name in the checkout can be imported too.
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
        """Return the value behind each occurrence of a flag."""
        return [value for name, value in pairwise(self.arguments) if name == flag]

    @property
    def remaps(self) -> dict[str, str]:
        """Return the remaps, including name and namespace of the node."""
        return dict(value.split(':=') for value in self.values('-r'))


@dataclass
class Launched:
    """What a launch file declares (paths relative to the package's folder), starts, and logs."""

    declared: dict[str, str]
    started: list[Started]
    logged: list[str]


def launched(
    file: Path, arguments: Mapping[str, str] | None = None, profile: str | None = None
) -> Launched:
    """Run a launch file with arguments, in an environment with a DDS profile or none."""
    with TemporaryDirectory() as folder, patch.dict(os.environ):
        os.environ.pop(PROFILE, None)
        os.environ.update({} if profile is None else {PROFILE: profile})
        run = (_by_launch if HAVE_LAUNCH else _by_stand_ins)(file, arguments or {}, Path(folder))
        share = f'{folder}/share/obbhbb_ros/'
        run = json.loads(json.dumps(run).replace(share, ''))
    started = sorted((Started(*node) for node in run['started']), key=lambda s: s.executable)
    return Launched(run['declared'], started, run['logged'])


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

file, folder, arguments = sys.argv[1:]
source = PythonLaunchDescriptionSource(file)
context = LaunchContext()
declared = {
    argument.name: perform_substitutions(context, argument.default_value)
    for argument in source.get_launch_description(context).get_launch_arguments()
    if argument.description
}
(Path(folder) / 'declared').write_text(json.dumps(declared))
service = LaunchService()
include = IncludeLaunchDescription(source, launch_arguments=json.loads(arguments).items())
service.include_launch_description(LaunchDescription([include]))
sys.exit(service.run())
"""

# In place of each executable; the first process of each exits at once. launch writes parameters
# that are no file to files of its own.
NODE = f"""#!{sys.executable}
import json, os, signal, sys, yaml
from pathlib import Path
program = Path(sys.argv[0])
arguments, parameters = sys.argv[1:], {{}}
for at in [i for i, word in enumerate(arguments) if word == '--params-file'][::-1]:
    if Path(arguments[at + 1]).name.startswith('launch_params_'):
        (section,) = yaml.safe_load(Path(arguments[at + 1]).read_text()).values()
        parameters.update(section['ros__parameters'])
        del arguments[at : at + 2]
folder, name = program.parents[2], program.name
before = list(folder.glob(name + '.*.started'))
started = [name, arguments, os.environ.get({PROFILE!r}), parameters, bool(before)]
(folder / f'{{name}}.{{len(before)}}.started').write_text(json.dumps(started))
if before:
    signal.sigwait([signal.SIGINT])
"""


def _by_launch(file: Path, arguments: Mapping[str, str], folder: Path) -> dict[str, Any]:
    """Install scripts in place of the executables and launch them."""
    (folder / 'share' / 'obbhbb_ros').mkdir(parents=True)
    (folder / 'share' / 'obbhbb_ros' / 'config').symlink_to(ROOT / 'config')
    index = folder / 'share' / 'ament_index' / 'resource_index' / 'packages'
    index.mkdir(parents=True)
    (index / 'obbhbb_ros').touch()
    programs = folder / 'lib' / 'obbhbb_ros'
    programs.mkdir(parents=True)
    for script in entry_points(group='console_scripts'):
        if script.value.startswith('obbhbb_ros.nodes.'):
            (programs / script.name).write_text(NODE)
            (programs / script.name).chmod(0o755)
    prefixes = [str(folder), *os.environ.get('AMENT_PREFIX_PATH', '').split(os.pathsep)]
    environment = os.environ | {
        'AMENT_PREFIX_PATH': os.pathsep.join(filter(None, prefixes)),
        'ROS_LOG_DIR': str(folder),
    }
    with (folder / 'log').open('w') as log:
        process = subprocess.Popen(
            [sys.executable, '-c', LAUNCH, file, folder, json.dumps(arguments)],
            env=environment,
            stdout=log,
            stderr=log,
            cwd=folder,
        )
        try:
            # Without respawn it exits by itself.
            process.wait(_settled(folder))
        except subprocess.TimeoutExpired:
            process.send_signal(signal.SIGINT)
        assert process.wait(30) == 0, (folder / 'log').read_text()
    latest = {path.name.split('.')[0]: path for path in sorted(folder.glob('*.started'))}
    return {
        'declared': json.loads((folder / 'declared').read_text()),
        'started': [json.loads(path.read_text()) for path in latest.values()],
        'logged': re.findall(r'\[launch\.user\]: (.*)', (folder / 'log').read_text()),
    }


def _settled(folder: Path) -> float:
    """Wait until no node has been started for some seconds; return 0."""
    count, since = 0, time.monotonic()
    while time.monotonic() < since + 4.0:
        started = len(list(folder.glob('*.started')))
        if started != count:
            count, since = started, time.monotonic()
        time.sleep(0.1)
    return 0.0


# Stand-ins ------------------------------------------------------------------------------------


class Configuration(str):
    """The value of an argument."""

    def perform(self, context: object) -> str:
        return str(self)


def _by_stand_ins(file: Path, arguments: Mapping[str, str], folder: Path) -> dict[str, Any]:
    """Run the file with functions that return actions, and perform those in the order described."""
    defaults: dict[str, str] = {}
    declared: dict[str, str] = {}
    started: list[tuple[str, list[str], str | None, dict[str, str], bool]] = []
    environment: dict[str, str] = {}
    logged: list[str] = []
    (folder / 'share').mkdir()
    (folder / 'share' / 'obbhbb_ros').symlink_to(ROOT)

    def declare(name: str, *, default_value: str, description: str) -> Callable[[], None]:
        assert description
        defaults[name] = default_value
        return lambda: declared.update({name: default_value})

    def configuration(name: str) -> Configuration:
        return Configuration(arguments.get(name, defaults[name]))

    def set_variable(name: str, value: str, condition: bool = True) -> Callable[[], None]:
        return lambda: environment.update({name: value} if condition else {})

    def node(
        *,
        package: str,
        executable: str,
        namespace: str,
        parameters: list[Any],
        remappings: list[tuple[str, str]],
        output: str,
        ros_arguments: Sequence[str],
        respawn: bool,
        respawn_delay: float,
        name: str = '',
        arguments: Sequence[str] = (),
    ) -> Callable[[], None]:
        assert (package, output) == ('obbhbb_ros', 'screen')
        words = [*arguments, *ros_arguments]
        words += ['-r', f'__node:={name}'] if name else []
        words += ['-r', f'__ns:=/{namespace.lstrip("/")}']
        for path in parameters:
            if isinstance(path, str):
                words += ['--params-file', path]
        for old, new in remappings:
            words += ['-r', f'{old}:={new}']
        assert respawn_delay >= 0.0
        values = {
            name: value
            for item in parameters
            if isinstance(item, dict)
            for name, value in item.items()
        }
        return lambda: started.append(
            (executable, words, environment.get(PROFILE), values, respawn)
        )

    modules = {
        'launch': {'LaunchDescription': list},
        'launch.actions': {
            'DeclareLaunchArgument': declare,
            'SetEnvironmentVariable': set_variable,
            'LogInfo': lambda msg: lambda: logged.append(msg),
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
    return {'declared': declared, 'started': started, 'logged': logged}
