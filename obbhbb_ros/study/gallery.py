# SPDX-License-Identifier: Apache-2.0
"""
The chips of an outbox, or of a folder that received its files, as an HTML page.

The page links to the chips: it is small, and has to stay where it is relative to them. Only what
browsers do not show, JPEG 2000 and 16 bits, is converted and embedded. Needs Jinja2, the extra
`plots`; converting needs Pillow, the extra `images`.
"""

from __future__ import annotations

import base64
import io
import json
import os
import sys
from collections import Counter
from collections.abc import Callable
from collections.abc import Iterator
from dataclasses import dataclass
from dataclasses import field
from datetime import datetime
from datetime import timezone
from hashlib import sha256
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np

from obbhbb_ros.downlink.chips import CODECS
from obbhbb_ros.downlink.chips import to_8_bits
from obbhbb_ros.files import read_bounded
from obbhbb_ros.geometry.boxes import OrientedBoxes
from obbhbb_ros.labels.image_files import opened_image
from obbhbb_ros.spool.seals import is_sealed
from obbhbb_ros.study.pages import rendered
from obbhbb_ros.study.progress import printable
from obbhbb_ros.study.progress import track
from obbhbb_ros.wire.stamp import Stamp
from obbhbb_ros.wire.stamp import nanoseconds_of
from obbhbb_ros.wire.stamp import stamp_text

_SUFFIXES = {f'.{codec.suffix}' for codec in CODECS.values()}
_MAX_JSON_BYTES, _MAX_CHIP_BYTES = 2**22, 2**28
# Pixels of a chip that is converted: one picture at a time, and a few copies of it.
_MAX_PIXELS = 2**25
# Bytes of a chip file that are read at once.
_PIECE = 2**20
# Longer side of an embedded picture, pixels.
_EMBEDDED = 256
# Where the header of a PNG states the bits per channel.
_PNG_DEPTH = 24


@dataclass(frozen=True)
class GalleryChip:
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
    """

    path: Path
    facts: dict[str, Any]
    damage: str
    size: int | None

    @property
    def stamp(self) -> Stamp:
        """Stamp of the image."""
        return self.facts['stamp']['sec'], self.facts['stamp']['nanosec']

    @property
    def time(self) -> int:
        """Stamp of the image, nanoseconds."""
        return nanoseconds_of(self.stamp)


@dataclass
class Received:
    """
    What a folder holds.

    Attributes
    ----------
    chips : list of GalleryChip
        The chips that have a usable JSON, the most valuable first, then the oldest.
    problems : list of str
        What is wrong, a line each; starts with the name of the file.
    """

    chips: list[GalleryChip] = field(default_factory=list)
    problems: list[str] = field(default_factory=list)


def read_received(folder: Path) -> Received:
    """
    Read the chips of an outbox, or of any folder that received one, and check their files.

    All folders in it are searched, those behind symbolic links as well; names that begin with a
    dot are left out, as files are not complete under such names. Raises NotADirectoryError if
    there is no such folder.
    """
    if not folder.is_dir():
        raise NotADirectoryError(f'{folder}: no such folder')
    received = Received()
    files = sorted(_files(folder, received.problems))
    named = set()
    for path in track([path for path in files if path.suffix == '.json'], 'reading'):
        shown = printable(str(path.relative_to(folder)))
        try:
            chip = _checked(path)
        except (OSError, ValueError, RecursionError, MemoryError) as error:
            problem = printable(str(error)) or 'not enough memory'
            received.problems.append(f'{shown}: {problem}')
            continue
        named.add(chip.path)
        received.chips.append(chip)
        if chip.damage:
            name = printable(str(chip.path.relative_to(folder)))
            received.problems.append(f'{name}: {chip.damage}')
    received.chips.sort(key=lambda chip: (-chip.facts['value'], chip.time, chip.facts['id']))
    orphans = [path for path in files if path.suffix in _SUFFIXES and path not in named]
    if orphans:
        first = printable(str(orphans[0].relative_to(folder)))
        received.problems.append(f'{first}: no usable JSON; {len(orphans)} such files in all')
    return received


def gallery_page(
    received: Received, beside: Path, title: str, *, limit: int = 0, command: str = ''
) -> str:
    """
    Return the page, as HTML; pictures that cannot be converted join `received.problems`.

    Parameters
    ----------
    received : Received
        The chips.
    beside : Path
        Folder that the page will be in.
    title : str
        Name of the data.
    limit : int
        Maximum number of chips to show, 0 for all.
    command : str
        Command line to name on the page.

    Raises
    ------
    ValueError
        If `limit` is negative.
    ModuleNotFoundError
        If a chip must be converted and Pillow is not installed.
    """
    if limit < 0:
        raise ValueError(f'limit must be 0 or more, not {limit}')
    chips = received.chips[:limit] if limit else received.chips
    classes = Counter(printable(chip.facts['class_id']) for chip in received.chips)
    numbers = {class_id: number for number, (class_id, _) in enumerate(classes.most_common())}
    cards = [_card(chip, numbers, beside, received.problems) for chip in track(chips, 'drawing')]
    times = sorted(chip.time for chip in received.chips)
    return rendered(
        'gallery.html',
        printable(title),
        command,
        total=len(received.chips),
        classes=classes.most_common(),
        span=[_utc(time) for time in (times[0], times[-1])] if times else [],
        size=sum(chip.size or 0 for chip in received.chips),
        problems=received.problems,
        cards=cards,
    )


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


def _checked(path: Path) -> GalleryChip:
    """Read a JSON and check its chip file; ValueError if the JSON cannot be used."""
    content = read_bounded(path, _MAX_JSON_BYTES)
    facts = json.loads(content.decode())
    if not isinstance(facts, dict):
        raise ValueError('not a JSON object')
    for key, (meaning, is_right) in _KEYS.items():
        if key not in facts:
            raise ValueError(f"key '{key}' is missing")
        if not is_right(facts[key]):
            raise ValueError(f"key '{key}' is not {meaning}")
    chip = path.with_suffix(f'.{CODECS[facts["codec"]].suffix}')
    damage, size = _damage(chip, facts)
    if not is_sealed(content):
        damage = damage or 'damaged: the digest of its JSON differs or is missing'
    return GalleryChip(chip, {key: facts[key] for key in _KEYS}, damage, size)


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


_CAMERA: dict[str, Callable[[Any], bool]] = {
    'size': _is_list(2, _is_whole),
    'k': _or_null(_is_list(9, _is_number)),
    'model': _is_text,
    'd': _or_null(_is_list(None, _is_number)),
    'roi': _is_list(4, _is_whole),
    'binning': _is_list(2, _is_whole),
}


def _is_camera(value: Any) -> bool:
    """Return whether a value describes a camera."""
    return isinstance(value, dict) and all(
        name in value and is_right(value[name]) for name, is_right in _CAMERA.items()
    )


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
    'camera': ('an object with size, k, model, d, roi and binning, or null', _or_null(_is_camera)),
}


# Cards ----------------------------------------------------------------------------------------


def _card(
    chip: GalleryChip, numbers: dict[str, int], beside: Path, problems: list[str]
) -> dict[str, Any]:
    """Collect what the template shows of a chip."""
    texts = {name: printable(chip.facts[name]) for name in ('id', 'class_id', 'frame_id')}
    link = quote(os.fsencode(os.path.relpath(chip.path, beside)))
    return {
        **chip.facts,
        **texts,
        'class_number': numbers[texts['class_id']],
        'time': _utc(chip.time),
        'stamp': _stamp(chip.stamp),
        'corners': _corners(chip.facts['obb']),
        'damage': chip.damage,
        'link': link,
        'picture': _picture(chip, link, problems),
    }


def _corners(obb: list[float] | None) -> list[list[float]]:
    """Compute the corners of an oriented box; none if it has no area."""
    boxes = OrientedBoxes.from_xywhr([] if obb is None else [obb])
    return boxes.corners[boxes.valid].reshape(-1, 2).tolist()


def _picture(chip: GalleryChip, link: str, problems: list[str]) -> str | None:
    """Return the source of a chip's picture: the file, or its content if it must be converted."""
    if chip.size is None:
        return None
    try:
        return _converted(chip) if _needs_conversion(chip) else link
    except ImportError:
        raise
    except Exception as error:
        # Any exception: Pillow's readers raise whatever a damaged file leads them to.
        reason = printable(str(error)) or type(error).__name__
        problems.append(f'{printable(chip.path.name)}: no picture ({reason})')
        return None


def _needs_conversion(chip: GalleryChip) -> bool:
    """Check whether browsers do not show a chip, or show its 16 bits too dark."""
    if chip.facts['codec'] != 'png':
        return bool(chip.facts['codec'] == 'jpeg2000')
    with chip.path.open('rb') as stream:
        return stream.read(_PNG_DEPTH + 1)[_PNG_DEPTH:] == b'\x10'


def _converted(chip: GalleryChip) -> str:
    """Convert a chip to a small JPEG in a data URL; ValueError if its size is wrong."""
    from PIL import Image

    formats = (chip.facts['codec'].upper(),)
    with opened_image(chip.path, formats, _MAX_PIXELS) as stored:
        if list(stored.size) != chip.facts['roi'][2:]:
            raise ValueError(
                'not {} x {} pixels, but {} x {}'.format(*chip.facts['roi'][2:], *stored.size)
            )
        pixels = np.asarray(stored)
    picture = Image.fromarray(pixels if pixels.dtype == np.uint8 else to_8_bits(pixels))
    picture = picture.convert('L' if pixels.ndim == 2 else 'RGB')
    picture.thumbnail((_EMBEDDED, _EMBEDDED))
    file = io.BytesIO()
    picture.save(file, 'jpeg', quality=80)
    return f'data:image/jpeg;base64,{base64.b64encode(file.getvalue()).decode()}'


# Texts ----------------------------------------------------------------------------------------


def _stamp(stamp: Stamp) -> str:
    """Write a stamp as it is; as a decimal number if that cannot be misread."""
    seconds, nanoseconds = stamp
    plain = seconds >= 0 and nanoseconds < 10**9
    return stamp_text(stamp) if plain else f'{seconds} s + {nanoseconds} ns'


def _utc(time: int) -> str:
    """Write a time, nanoseconds, as date and time of day, to the millisecond."""
    seconds, rest = divmod(time, 10**9)
    whole = datetime.fromtimestamp(seconds, timezone.utc)
    return f'{whole:%Y-%m-%d %H:%M:%S}.{rest // 10**6:03d} UTC'
