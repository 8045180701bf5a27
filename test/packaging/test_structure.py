# SPDX-License-Identifier: Apache-2.0
"""How the package is built: imports as in CONTRIBUTING, unique names, no private names in tests."""

import ast
import re
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import pytest

pytestmark = pytest.mark.once

ROOT = Path(__file__).parents[2]
PACKAGE = ROOT / 'obbhbb_ros'
MODULES = sorted(PACKAGE.rglob('*.py'))
TREES = {path: ast.parse(path.read_text(encoding='utf-8')) for path in MODULES}


def room_of(path: Path) -> str:
    """Return the folder or module of the package, as the table names it."""
    place = path.relative_to(PACKAGE)
    return place.name if place.parent == Path() else f'{place.parent}/'


def imported(tree: ast.AST) -> Iterator[str]:
    """Return the modules of the package that a module imports, anywhere in it."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module == PACKAGE.name:
            yield from (f'{node.module}.{alias.name}' for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            yield node.module or ''


def imported_rooms() -> dict[str, set[str]]:
    """Return the rooms that each room imports."""
    rooms: dict[str, set[str]] = {room_of(path): set() for path in MODULES}
    for path, tree in TREES.items():
        for module in imported(tree):
            package, *names = module.split('.')
            place = PACKAGE.joinpath(*names)
            if package == PACKAGE.name and names:
                target = room_of(
                    place / '__init__.py' if place.is_dir() else place.with_suffix('.py')
                )
                rooms[room_of(path)] |= {target} & rooms.keys() - {room_of(path)}
    return rooms


def table() -> dict[str, set[str]]:
    """Return the table of CONTRIBUTING: what each room may import, in its order."""
    text = (ROOT / 'CONTRIBUTING.md').read_text(encoding='utf-8')
    rows = re.search(r'^\| room .*\n\| ---.*\n((?:\|.*\n)+)', text, re.M)[1].splitlines()
    cells = [row.split('|') for row in rows]
    return {
        room: set(re.findall('`([^`]+)`', row[3]))
        for row in cells
        for room in re.findall('`([^`]+)`', row[1])
    }


def test_the_table_has_a_row_for_every_room() -> None:
    assert table().keys() == {room_of(path) for path in MODULES} - {'__init__.py'}


@pytest.mark.parametrize('room', table())
def test_a_room_imports_what_the_table_says_and_no_other(room: str) -> None:
    assert imported_rooms()[room] == table()[room]


def test_a_room_imports_only_rooms_above_it() -> None:
    above: set[str] = set()
    for room, allowed in table().items():
        assert allowed <= above, room
        above.add(room)


def test_only_nodes_and_launch_files_import_ros() -> None:
    ros = {'rclpy', 'launch', 'launch_ros', 'ament_index_python', 'vision_msgs', 'sensor_msgs'}
    users = {
        room_of(path)
        for path, tree in TREES.items()
        if ros & {module.partition('.')[0] for module in imported(tree)}
    }
    assert users == {'nodes/', 'nodes/lifecycle/', 'nodes/running/', 'launching.py'}


def test_no_two_classes_have_one_name() -> None:
    names = Counter(
        node.name
        for tree in TREES.values()
        for node in ast.walk(tree)
        if isinstance(node, ast.ClassDef)
    )
    assert [name for name, count in names.items() if count > 1] == []


def test_no_two_modules_have_one_name_but_a_node_and_its_settings() -> None:
    names = Counter(
        path.stem
        for path in MODULES
        if path.stem not in ('__init__', '__main__')
        and not (path.parent.name == 'settings' and (PACKAGE / 'nodes' / path.name).exists())
    )
    assert [name for name, count in names.items() if count > 1] == []


# Public by their documentation, or of other packages.
NOT_PRIVATE = {'_asdict', '_exit', '_fields', '_replace', '_AckedModeParams'}


def private_names(tree: ast.AST) -> Iterator[str]:
    """Return the private names of others that a module uses, or patches."""
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.Attribute) and ast.unparse(node.value) not in ('self', 'cls'):
            names = [node.attr]
        elif isinstance(node, ast.Call) and ast.unparse(node.func).endswith('setattr'):
            names = [str(a.value).split('.')[-1] for a in node.args if isinstance(a, ast.Constant)]
        else:
            continue
        yield from (name for name in names if re.match('_[^_]', name))


@pytest.mark.parametrize(
    'path', sorted((ROOT / 'test').rglob('*.py')), ids=lambda path: str(path.relative_to(ROOT))
)
def test_tests_use_public_names_only(path: Path) -> None:
    tree = ast.parse(path.read_text(encoding='utf-8'))
    assert set(private_names(tree)) <= NOT_PRIVATE
