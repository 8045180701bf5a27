# SPDX-License-Identifier: Apache-2.0
"""
What an outbox, or a folder that received its files, holds, as an HTML page: a card per ship, a map.

The page links to the chips: it is small, and has to stay where it is relative to them. Only what
browsers do not show, JPEG 2000 and 16 bits, is converted and embedded. Needs Jinja2, the extra
`plots`; converting needs Pillow, the extra `images`.
"""

from __future__ import annotations

import base64
import io
import os
from collections import Counter
from datetime import datetime
from datetime import timezone
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np

from obbhbb_ros.downlink.chips import to_8_bits
from obbhbb_ros.geometry.boxes import OrientedBoxes
from obbhbb_ros.ground.received import Received
from obbhbb_ros.ground.received import ReceivedChip
from obbhbb_ros.ground.ship_files import course_text
from obbhbb_ros.ground.ship_files import described
from obbhbb_ros.ground.ship_files import motion_text
from obbhbb_ros.ground.ship_map import ship_map
from obbhbb_ros.ground.ship_rows import ship_rows
from obbhbb_ros.labels.image_files import opened_image
from obbhbb_ros.pages import rendered
from obbhbb_ros.progress import printable
from obbhbb_ros.progress import track
from obbhbb_ros.reports.ship_report import ShipReport
from obbhbb_ros.wire.stamp import Stamp
from obbhbb_ros.wire.stamp import stamp_text

# Pixels of a chip that is converted: one picture at a time, and a few copies of it.
_MAX_PIXELS = 2**25
# Longer side of an embedded picture, pixels.
_EMBEDDED = 256
# Where the header of a PNG states the bits per channel.
_PNG_DEPTH = 24


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
        Maximum number of cards to show, 0 for all.
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
    ships = received.by_ship()
    shown = ships[:limit] if limit else ships
    classes = Counter(printable(views[0].facts['class_id']) for views in ships)
    numbers = {class_id: number for number, (class_id, _) in enumerate(classes.most_common())}
    cards = [_card(views, numbers, beside, received.problems) for views in track(shown, 'drawing')]
    rows = {row.facts.id or row.files[0]: row.facts for row in ship_rows([received], Counter())}
    for card, views in zip(cards, shown, strict=True):
        card['place'] = _place(rows.get(views[0].facts['object'] or views[0].path))
    times = sorted(chip.time for chip in received.chips)
    return rendered(
        'ground',
        'gallery.html',
        printable(title),
        command,
        total=len(received.chips),
        ships=received.ship_count,
        all_cards=len(ships),
        classes=classes.most_common(),
        span=[_utc(time) for time in (times[0], times[-1])] if times else [],
        latencies=_latencies(received),
        size=sum(chip.size or 0 for chip in received.chips),
        problems=received.problems,
        cards=cards,
        map=_map(rows, shown),
    )


# Cards ----------------------------------------------------------------------------------------


def _card(
    views: list[ReceivedChip], numbers: dict[str, int], beside: Path, problems: list[str]
) -> dict[str, Any]:
    """Collect what the template shows of a ship, or of a chip of none."""
    times = [view.time // 10**6 for view in views]
    shown = [_view(view, beside, problems) for view in views]
    return {
        'views': shown,
        'class_number': numbers[shown[0]['class_id']],
        'first': min(times),
        'last': max(times),
    }


def _place(ship: ShipReport | None) -> dict[str, str] | None:
    """Write where a ship is, its size and course; None if that is not known."""
    if ship is None:
        return None
    sides = 'S' if ship.latitude < 0.0 else 'N', 'W' if ship.longitude < 0.0 else 'E'
    degrees = f'{abs(ship.latitude):.5f}° {sides[0]}, {abs(ship.longitude):.5f}° {sides[1]}'
    within = '' if ship.sigma_m is None else f' ± {ship.sigma_m[0]:.1f} m'
    return {
        'where': degrees + within,
        'size': f'{ship.length_m:.0f} × {ship.width_m:.0f} m',
        'course': course_text(ship),
        'motion': motion_text(ship),
    }


def _map(
    rows: dict[str | Path, ShipReport], shown: list[list[ReceivedChip]]
) -> dict[str, Any] | None:
    """Collect what the template shows of the map; None if no place is known."""
    if not rows:
        return None
    numbers = {views[0].facts['object'] or views[0].path: n for n, views in enumerate(shown, 1)}
    drawn = ship_map(list(rows.values()))
    marks = [
        {'x': x, 'y': y, 'card': numbers.get(key), 'text': _mark_text(ship)}
        for (key, ship), (x, y) in zip(rows.items(), drawn.places, strict=True)
    ]
    return {'drawn': drawn, 'marks': marks, 'listed': sum(not mark['card'] for mark in marks)}


def _mark_text(ship: ShipReport) -> str:
    """Describe a ship on the map."""
    return ': '.join(filter(None, (printable(ship.id), described(ship))))


def _view(chip: ReceivedChip, beside: Path, problems: list[str]) -> dict[str, Any]:
    """Collect what the template shows of a chip."""
    names = ('id', 'class_id', 'frame_id', 'object')
    link = quote(os.fsencode(os.path.relpath(chip.path, beside)))
    return {
        **chip.facts,
        **{name: printable(chip.facts[name]) for name in names if chip.facts[name] is not None},
        'time': _utc(chip.time),
        'latency': None if chip.latency is None else _duration(chip.latency),
        'stamp': _stamp(chip.stamp),
        'corners': _corners(chip.facts['obb']),
        'damage': chip.damage,
        'link': link,
        'picture': _picture(chip, link, problems),
    }


def _latencies(received: Received) -> list[str]:
    """Write the median of the latencies, and what nine tenths of them do not exceed."""
    known = sorted(chip.latency for chip in received.chips if chip.latency is not None)
    return [_duration(known[int(share * (len(known) - 1))]) for share in (0.5, 0.9) if known]


def _corners(obb: list[float] | None) -> list[list[float]]:
    """Compute the corners of an oriented box; none if it has no area."""
    boxes = OrientedBoxes.from_xywhr([] if obb is None else [obb])
    return boxes.corners[boxes.valid].reshape(-1, 2).tolist()


def _picture(chip: ReceivedChip, link: str, problems: list[str]) -> str | None:
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


def _needs_conversion(chip: ReceivedChip) -> bool:
    """Check whether browsers do not show a chip, or show its 16 bits too dark."""
    if chip.facts['codec'] != 'png':
        return bool(chip.facts['codec'] == 'jpeg2000')
    with chip.path.open('rb') as stream:
        return stream.read(_PNG_DEPTH + 1)[_PNG_DEPTH:] == b'\x10'


def _converted(chip: ReceivedChip) -> str:
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


def _duration(nanoseconds: int) -> str:
    """
    Write a time span in the unit that suits it.

    Examples
    --------
    >>> [_duration(seconds * 10**9) for seconds in (5, 300, 50_000, 500_000)]
    ['5.0 s', '5.0 min', '13.9 h', '5.8 days']
    """
    number, unit = nanoseconds / 1e9, 's'
    for count, larger in ((60.0, 'min'), (60.0, 'h'), (24.0, 'days')):
        if number < 2.0 * count:
            break
        number, unit = number / count, larger
    return f'{number:.1f} {unit}'
