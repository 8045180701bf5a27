# SPDX-License-Identifier: Apache-2.0
"""Parameter files, read as ROS reads them, but without ROS."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterator
from collections.abc import Mapping
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any
from typing import TypeAlias

from obbhbb_ros.files import read_bounded

# The file of a node with a hundred classes has 50 kB.
_MAX_BYTES = 2**20

Value: TypeAlias = bool | int | float | str | list[str] | list[float]
Values: TypeAlias = dict[str, Value]


def read_values(path: Path, node: str) -> Values:
    """
    Read a ROS parameter file.

    Parameters
    ----------
    path : Path
        A YAML file as `--params-file` takes it.
    node : str
        Full name of the node, for example '/obb_to_hbb'; the first slash is optional.

    Returns
    -------
    dict of str to value
        Values by parameter name, from all sections whose name matches; `*` stands for one part of a
        name, `**` for any number of parts. A section may be nested in those of its namespaces. A
        later section wins.

    Raises
    ------
    ValueError
        If it is no parameter file, or has no parameters for the node; the message names the file.
    OSError
        If it cannot be read.

    Examples
    --------
    >>> read_values(Path('config/obb_to_hbb.yaml'), '/obb_to_hbb')['q']  # doctest: +SKIP
    3.0
    """
    values: Values = {}
    for _, section in _sections_for(path, node):
        values.update(section)
    if not values:
        raise ValueError(f'{path}: no parameters for /{node.lstrip("/")}')
    return values


def shared_names(path: Path, node: str) -> set[str]:
    """
    Collect the names of parameters that a file has for a node in sections for nodes of any name.

    Such a section is `/**` or `/payload/*`. Raises the errors of `read_values`, except for a file
    that has none.
    """
    sections = _sections_for(path, node)
    return {name for pattern, section in sections if pattern.endswith('*') for name in section}


def parameter_files(arguments: Sequence[str]) -> list[Path]:
    """
    List the parameter files on a command line.

    Examples
    --------
    >>> parameter_files(['node', '--ros-args', '--params-file', 'a.yaml', '--', '--params-file'])
    [PosixPath('a.yaml')]
    """
    files, is_for_ros = [], False
    for argument, following in pairwise((*arguments, '')):
        is_for_ros = argument == '--ros-args' or (is_for_ros and argument != '--')
        if is_for_ros and argument == '--params-file':
            files.append(Path(following))
    return files


def yaml_value(value: Any) -> str:
    """
    Write a value so that ROS reads it back with its type.

    Examples
    --------
    >>> [yaml_value(value) for value in (3.0, float('inf'), True, 'boxes', [0.5])]
    ['3.0', '.inf', 'true', '"boxes"', '[0.5]']
    """
    if isinstance(value, list):
        return f'[{", ".join(map(yaml_value, value))}]'
    if isinstance(value, float) and not math.isfinite(value):
        return '.nan' if math.isnan(value) else f'{"-" if value < 0 else ""}.inf'
    return json.dumps(value)


def _document(path: Path) -> Any:
    """Read a YAML file, with numbers as ROS reads them."""
    # Part of ROS; without ROS only this function needs it.
    import yaml

    class Loader(yaml.SafeLoader):  # type: ignore[misc]
        """Reads 1e1 as a number and refuses aliases, as ROS does."""

        def compose_node(self, parent: Any, index: Any) -> Any:
            """Compose the next node, or refuse an alias."""
            if self.check_event(yaml.AliasEvent):
                mark = self.peek_event().start_mark
                raise yaml.composer.ComposerError(None, None, 'ROS does not support aliases', mark)
            return super().compose_node(parent, index)

    Loader.add_implicit_resolver(
        'tag:yaml.org,2002:float',
        re.compile(r'[-+]?(\d+\.?\d*|\.\d+)[eE][-+]?\d+$'),
        list('-+.0123456789'),
    )
    try:
        return yaml.load(read_bounded(path, _MAX_BYTES).decode(), Loader)
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        raise ValueError(f'{path}: {error}') from None


def _sections_for(path: Path, node: str) -> Iterator[tuple[str, Values]]:
    """Yield the pattern and the values of every section of a file whose pattern matches a node."""
    for name, section in _sections(_document(path)):
        pattern = re.escape(name).replace(r'/\*\*', '(/[^/]+)*').replace(r'\*', '[^/]+')
        if re.fullmatch(pattern, '/' + node.lstrip('/')):
            yield name, dict(_flattened(_parameters(path, name, section)))


def _sections(content: Any, name: str = '') -> Iterator[tuple[str, Any]]:
    """Yield the sections of a parameter file by full name, including those in namespaces."""
    yield name, content
    for key, inner in content.items() if isinstance(content, dict) else ():
        if key != 'ros__parameters':
            yield from _sections(inner, re.sub('/+', '/', f'{name}/{key}'))


def _parameters(path: Path, name: str, section: Any) -> Mapping[str, Any]:
    """Return the parameters of a section; none if it only holds other sections, or is empty."""
    inner = section if isinstance(section, dict) else {name: section}
    nested = all(isinstance(item, dict) for item in inner.values())
    if not nested and 'ros__parameters' not in inner:
        raise ValueError(f'{path}: no ros__parameters in {name}')
    parameters = inner.get('ros__parameters')
    if not isinstance(parameters, dict | None):
        raise ValueError(
            f'{path}: ros__parameters in {name} must be names and values, not {parameters!r}'
        )
    return parameters or {}


def _flattened(section: Mapping[str, Any], prefix: str = '') -> Iterator[tuple[str, Any]]:
    """Yield the values of nested sections by their names with dots."""
    for name, value in section.items():
        if isinstance(value, dict):
            yield from _flattened(value, f'{prefix}{name}.')
        else:
            yield f'{prefix}{name}', value
