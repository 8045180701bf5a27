# SPDX-License-Identifier: Apache-2.0
"""What an outbox, or a folder that received its files, holds: chips, ship lists, what is wrong."""

from __future__ import annotations

import json
import os
import sys
from collections import Counter
from collections.abc import Callable
from collections.abc import Iterator
from collections.abc import Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from dataclasses import field
from hashlib import sha256
from pathlib import Path
from typing import Any

from obbhbb_ros.downlink.chips import CODECS
from obbhbb_ros.files import read_bounded
from obbhbb_ros.progress import printable
from obbhbb_ros.progress import track
from obbhbb_ros.reports.ship_list import LIST_KIND
from obbhbb_ros.reports.ship_list import LIST_SUFFIXES
from obbhbb_ros.reports.ship_list import read_ship_list
from obbhbb_ros.reports.ship_report import MAX_LIST_BYTES
from obbhbb_ros.reports.ship_report import ShipReport
from obbhbb_ros.spool.compact_json import CAMERA_KIND
from obbhbb_ros.spool.compact_json import camera_id
from obbhbb_ros.spool.compact_json import with_camera
from obbhbb_ros.spool.ranking import worth_of
from obbhbb_ros.spool.seals import is_sealed
from obbhbb_ros.wire.stamp import Stamp
from obbhbb_ros.wire.stamp import nanoseconds_of

_SUFFIXES = {f'.{codec.suffix}' for codec in CODECS.values()}
_LIST_SUFFIXES = tuple(f'.{suffix}' for suffix in LIST_SUFFIXES.values())
_MAX_JSON_BYTES, _MAX_CHIP_BYTES = 2**22, 2**28
# Ten years, in nanoseconds: stamps of a simulation begin near 1970.
_MAX_LATENCY = 10 * 365 * 24 * 3600 * 10**9
# Bytes of a chip file that are read at once.
_PIECE = 2**20


@dataclass(frozen=True)
class ReceivedChip:
    """
    A chip and the facts in its JSON.

    Attributes
    ----------
    path : Path
        The chip file, whether it is there or not.
    facts : dict
        Content of the JSON: the keys that are known, each of the right type.
    damage : str
        What is wrong with the chip file, empty if nothing is.
    size : int or None
        Bytes of the chip file, None if it is missing.
    arrival : int
        When the JSON was written here, nanoseconds since 1970; a copy may have changed that.
    is_sealed : bool
        Whether the JSON has its digest; else its facts may be wrong.
    """

    path: Path
    facts: dict[str, Any]
    damage: str
    size: int | None
    arrival: int
    is_sealed: bool

    @property
    def stamp(self) -> Stamp:
        """Stamp of the image."""
        return self.facts['stamp']['sec'], self.facts['stamp']['nanosec']

    @property
    def time(self) -> int:
        """Stamp of the image, nanoseconds."""
        return nanoseconds_of(self.stamp)

    @property
    def worth(self) -> float:
        """Value, times the share of the ship that the image shows."""
        return worth_of(self.facts['value'], self.facts['obb'], self.facts['image_size'])

    @property
    def latency(self) -> int | None:
        """Nanoseconds from stamp to arrival; None if the stamp is of another clock."""
        latency = self.arrival - self.time
        return latency if 0 <= latency < _MAX_LATENCY else None


@dataclass(frozen=True)
class ReceivedList:
    """
    A ship list.

    Attributes
    ----------
    path : Path
        The file.
    digest : str
        Its SHA-256: a list that was received twice counts once.
    ships : list of ShipReport
        What it says.
    """

    path: Path
    digest: str
    ships: list[ShipReport]


@dataclass
class Received:
    """
    What a folder holds.

    Attributes
    ----------
    chips : list of ReceivedChip
        The chips that have a usable JSON, the most valuable first, then the oldest.
    cameras : dict of str to dict
        Content of the files of cameras, by their ids.
    lists : list of ReceivedList
        The ship lists, by the names of their files.
    problems : list of str
        What is wrong, a line each; starts with the name of the file.
    """

    chips: list[ReceivedChip] = field(default_factory=list)
    cameras: dict[str, dict[str, Any]] = field(default_factory=dict)
    lists: list[ReceivedList] = field(default_factory=list)
    problems: list[str] = field(default_factory=list)

    @property
    def ship_count(self) -> int:
        """Number of ships; chips that name none do not count."""
        return len({chip.facts['object'] for chip in self.chips if chip.facts['object']})

    def by_ship(self) -> list[list[ReceivedChip]]:
        """
        Group the chips by the ship that they show, the best ship first, its best view first.

        A chip that names no ship is alone. Views without a file come last; a view that the border
        of the image cuts counts less, as in the spool.
        """
        ships: dict[str | int, list[ReceivedChip]] = {}
        for number, chip in enumerate(self.chips):
            ships.setdefault(chip.facts['object'] or number, []).append(chip)
        return [
            sorted(views, key=lambda view: (view.size is None, -view.worth))
            for views in ships.values()
        ]


def read_received(folder: Path) -> Received:
    """
    Read the chips and lists of an outbox, or of any folder that received one; check their files.

    All folders in it are searched, those behind symbolic links as well; names that begin with a
    dot are left out, as files are not complete under such names. Raises NotADirectoryError if
    there is no such folder.
    """
    if not folder.is_dir():
        raise NotADirectoryError(f'{folder}: no such folder')
    received = Received()
    files = sorted(_files(folder, received.problems))
    # Before the chips, which name them.
    for path in files:
        if path.suffix == f'.{CAMERA_KIND}':
            with _noted(path, folder, received.problems):
                received.cameras[path.stem] = _camera(path)
        elif path.name.endswith(_LIST_SUFFIXES):
            with _noted(path, folder, received.problems):
                received.lists.append(_ship_list(path))
    named = set()
    missing: Counter[str] = Counter()
    for path in track([path for path in files if path.suffix == '.json'], 'reading'):
        with _noted(path, folder, received.problems):
            chip = _checked(path, received.cameras, missing)
            if chip is None:
                continue
            named.add(chip.path)
            received.chips.append(chip)
            if chip.damage:
                name = printable(str(chip.path.relative_to(folder)))
                received.problems.append(f'{name}: {chip.damage}')
    received.chips.sort(key=lambda chip: (-chip.facts['value'], chip.time, chip.facts['id']))
    for camera, count in sorted(missing.items()):
        received.problems.append(f'{printable(camera)}: missing; chips of this camera: {count}')
    orphans = [path for path in files if path.suffix in _SUFFIXES and path not in named]
    if orphans:
        first = printable(str(orphans[0].relative_to(folder)))
        received.problems.append(f'{first}: no usable JSON; {len(orphans)} such files in all')
    return received


@contextmanager
def _noted(path: Path, folder: Path, problems: list[str]) -> Iterator[None]:
    """Note what makes a file unusable in a `with` block."""
    try:
        yield
    except (OSError, ValueError, RecursionError, MemoryError) as error:
        problem = printable(str(error)) or 'not enough memory'
        problems.append(f'{printable(str(path.relative_to(folder)))}: {problem}')


def _files(folder: Path, problems: list[str]) -> Iterator[Path]:
    """Find the regular files in a folder and all below it, each folder once."""

    def report(error: OSError) -> None:
        problems.append(printable(str(error)))

    # A link that leads up leads to nothing new.
    searched = set(folder.resolve().parents)
    for place, folders, names in os.walk(folder, onerror=report, followlinks=True):
        if (real := Path(place).resolve()) in searched:
            folders.clear()
            continue
        searched.add(real)
        folders[:] = [name for name in folders if not name.startswith('.')]
        for name in names:
            path = Path(place, name)
            # Reading a pipe would block.
            if not name.startswith('.') and path.is_file():
                yield path


def _camera(path: Path) -> dict[str, Any]:
    """Read the file of a camera; ValueError if it cannot be used."""
    content = read_bounded(path, _MAX_JSON_BYTES)
    if path.stem != camera_id(content):
        raise ValueError('damaged: its name is not that of its content')
    return _object(content)


def _ship_list(path: Path) -> ReceivedList:
    """Read a ship list, which checks itself; ValueError if it cannot be used."""
    content = read_bounded(path, MAX_LIST_BYTES)
    return ReceivedList(path, sha256(content).hexdigest(), read_ship_list(content))


def _object(content: bytes) -> dict[str, Any]:
    """Read a JSON object; ValueError if it is none."""
    facts = json.loads(content.decode())
    if not isinstance(facts, dict):
        raise ValueError('not a JSON object')
    return facts


def _checked(
    path: Path, cameras: Mapping[str, Mapping[str, Any]], missing: Counter[str]
) -> ReceivedChip | None:
    """
    Read a JSON and check its chip file; ValueError if the JSON cannot be used.

    Returns None if it is that of a camera or a ship list. If the camera of the chip is not there,
    the chip has none, and `missing` counts it.
    """
    content = read_bounded(path, _MAX_JSON_BYTES)
    facts = _OPTIONAL | _object(content)
    if facts['kind'] == CAMERA_KIND:
        return None
    if facts['kind'] == LIST_KIND:
        if not any(path.with_suffix(suffix).is_file() for suffix in _LIST_SUFFIXES):
            raise ValueError('its ship list is missing')
        return None
    if isinstance(facts.get('camera'), dict) and isinstance(name := facts['camera'].get('id'), str):
        if name not in cameras:
            missing[name] += 1
        facts['camera'] = with_camera(facts['camera'], cameras[name]) if name in cameras else None
    for key, (meaning, is_right) in _KEYS.items():
        if key not in facts:
            raise ValueError(f"key '{key}' is missing")
        if not is_right(facts[key]):
            raise ValueError(f"key '{key}' is not {meaning}")
    chip = path.with_suffix(f'.{CODECS[facts["codec"]].suffix}')
    damage, size = _damage(chip, facts)
    if not (sealed := is_sealed(content)):
        damage = damage or 'damaged: the digest of its JSON differs or is missing'
    arrival = path.stat().st_mtime_ns
    return ReceivedChip(chip, {key: facts[key] for key in _KEYS}, damage, size, arrival, sealed)


def _damage(chip: Path, facts: dict[str, Any]) -> tuple[str, int | None]:
    """Return what is wrong with a chip file, empty if nothing is, and its size."""
    if not chip.is_file():
        return 'missing', None
    size = chip.stat().st_size
    if size != facts['bytes']:
        return f'damaged: {size} bytes instead of {facts["bytes"]}', size
    if size > _MAX_CHIP_BYTES:
        return f'damaged: {size} bytes, the maximum is {_MAX_CHIP_BYTES}', size
    if _digest(chip) != facts['sha256'].lower():
        return 'damaged: sha256 differs', size
    return '', size


def _digest(path: Path) -> str:
    """Compute the sha256 of a file, piece by piece."""
    digest = sha256()
    with path.open('rb') as stream:
        while piece := stream.read(_PIECE):
            digest.update(piece)
    return digest.hexdigest()


# Checks of the keys ---------------------------------------------------------------------------


def _is_text(value: Any) -> bool:
    return isinstance(value, str)


def _is_whole(value: Any, low: int = 0, high: int = 2**32 - 1) -> bool:
    return type(value) is int and low <= value <= high


def _is_number(value: Any) -> bool:
    # Any finite number, as in a spool.
    return type(value) in (int, float) and abs(value) <= sys.float_info.max


def _is_list(count: int | None, is_right: Callable[[Any], bool]) -> Callable[[Any], bool]:
    """Return a check for a list of `count` values, None for any number."""
    return lambda value: (
        isinstance(value, list) and count in (None, len(value)) and all(map(is_right, value))
    )


def _or_null(is_right: Callable[[Any], bool]) -> Callable[[Any], bool]:
    return lambda value: value is None or is_right(value)


def _is_stamp(value: Any) -> bool:
    # Whatever fits into builtin_interfaces/msg/Time.
    return (
        isinstance(value, dict)
        and _is_whole(value.get('sec'), -(2**31), 2**31 - 1)
        and _is_whole(value.get('nanosec'))
    )


def _ends_in_size(count: int) -> Callable[[Any], bool]:
    """Return a check for `count` whole numbers, the last two a width and a height."""
    return lambda value: _is_list(count, _is_whole)(value) and min(value[-2:]) > 0


def _is_within(low: float, high: float) -> Callable[[Any], bool]:
    """Return a check for a number in a range."""
    return lambda value: _is_number(value) and low <= value <= high


def _is_object(checks: Mapping[str, Callable[[Any], bool]]) -> Callable[[Any], bool]:
    """Return a check for an object with some keys."""
    return lambda value: (
        isinstance(value, dict)
        and all(name in value and is_right(value[name]) for name, is_right in checks.items())
    )


_is_size = _is_within(0.0, sys.float_info.max)
_CAMERA: dict[str, Callable[[Any], bool]] = {
    'size': _is_list(2, _is_whole),
    'k': _or_null(_is_list(9, _is_number)),
    'model': _is_text,
    'd': _or_null(_is_list(None, _is_number)),
    'roi': _is_list(4, _is_whole),
    'binning': _is_list(2, _is_whole),
}
_POSITION: dict[str, Callable[[Any], bool]] = {
    'lat': _is_within(-90.0, 90.0),
    'lon': _is_within(-180.0, 180.0),
    'course': _is_within(0.0, 360.0),
    'course_ambiguous': lambda value: isinstance(value, bool),
    'length_m': _is_size,
    'width_m': _is_size,
    'sigma_m': _or_null(_is_list(3, _is_size)),
}


_KEYS: dict[str, tuple[str, Callable[[Any], bool]]] = {
    'id': ('a text', _is_text),
    'stamp': ('sec and nanosec', _is_stamp),
    'frame_id': ('a text', _is_text),
    'roi': ('x, y, width and height in whole pixels', _ends_in_size(4)),
    'image_size': ('width and height in whole pixels', _ends_in_size(2)),
    'class_id': ('a text', _is_text),
    'score': ('a number or null', _or_null(_is_number)),
    'value': ('a number', _is_number),
    'detection_ids': ('a list of texts', _is_list(None, _is_text)),
    'obb': ('five numbers or null', _or_null(_is_list(5, _is_number))),
    'codec': (f'one of {", ".join(CODECS)}', lambda value: value in list(CODECS)),
    'bytes': ('a whole number', _is_whole),
    'sha256': ('a text', _is_text),
    'camera': (
        'an object with size, k, model, d, roi and binning, or null',
        _or_null(_is_object(_CAMERA)),
    ),
    'object': ('a text or null', _or_null(_is_text)),
    # Files of kinds to come are none of a chip.
    'kind': ('known', lambda value: value is None),
    'view': ('a whole number or null', _or_null(_is_whole)),
    'rank': ('a number or null', _or_null(_is_number)),
    'position': ('a place on Earth or null', _or_null(_is_object(_POSITION))),
}
# Not in the JSON of chips that show no known ship, or have no place; chips have no kind.
_OPTIONAL: dict[str, Any] = dict.fromkeys(('object', 'view', 'rank', 'kind', 'position'))
