# SPDX-License-Identifier: Apache-2.0
"""A spool for people: its books, its chips and ship lists, what is wrong with it."""

from __future__ import annotations

import os
from collections.abc import Iterable
from collections.abc import Iterator
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from obbhbb_ros.downlink.chips import CODECS
from obbhbb_ros.progress import note
from obbhbb_ros.progress import printable
from obbhbb_ros.progress import track
from obbhbb_ros.spool.books import Status
from obbhbb_ros.spool.catalogue import SpoolDamagedError
from obbhbb_ros.spool.catalogue import catalogue_files
from obbhbb_ros.spool.chip_rows import StoredChip
from obbhbb_ros.spool.chip_rows import describe_intact
from obbhbb_ros.spool.console import ObjectSummary
from obbhbb_ros.spool.console import SpoolConsole
from obbhbb_ros.spool.list_console import ListConsole
from obbhbb_ros.spool.list_rows import ShipListFile
from obbhbb_ros.spool.list_spool import ListStatus
from obbhbb_ros.spool.outbox import Outbox
from obbhbb_ros.text_tables import aligned

# What becomes of listed ships, besides waiting.
_FATES = ('released', 'merged', 'dropped', 'damaged')
# By `ChipState`.
STATES = ('waiting', 'being released', 'in outbox')


def open_spool(folder: Path) -> SpoolConsole:
    """Open a spool that exists; ValueError if there is none, OSError if it cannot be listed."""
    if folder.is_dir():
        # The search for files below would hide an error.
        os.listdir(folder)
    if not catalogue_files(folder) and open_lists(folder) is None:
        raise ValueError(f'{folder} is no spool: it has no file chips_*.sqlite3')
    return SpoolConsole(folder, note)


def open_lists(folder: Path) -> ListConsole | None:
    """Open the ship lists of a spool; None if it never had one."""
    lists = ListConsole(folder, note)
    return lists if lists.exists else None


def status_text(status: Status) -> str:
    """Write the books of a spool."""

    def reasons(kind: str) -> str:
        counts = [
            f'{name.partition(".")[2]} {count}'
            for name, count in sorted(status.counts.items())
            if name.startswith(f'{kind}.')
        ]
        return f'{status.total(kind)}' + (f' ({", ".join(counts)})' if counts else '')

    lines = [
        f'planned    {status.counts.get("planned", 0)}',
        f'waiting    {status.waiting} ({status.waiting_bytes / 1e6:.1f} MB)'
        + (f', of {status.objects_waiting} known ships' * bool(status.objects_waiting)),
        f'in outbox  {status.in_outbox}',
        f'delivered  {status.counts.get("delivered", 0)}',
        f'evicted    {reasons("evicted")}',
        f'refused    {reasons("refused")}',
    ]
    if status.in_work:
        lines.append(f'in work    {status.in_work}')
    if status.set_aside:
        lines.append(f'{status.set_aside} damaged catalogues set aside')
    if status.balance:
        lines.append(f'The books do not balance: {status.balance} chips are unaccounted for')
    return '\n'.join(lines)


def list_text(status: ListStatus) -> str:
    """Write the books of ship lists."""

    def counts(*parts: tuple[str, int]) -> str:
        return ', '.join(f'{name} {count}' for name, count in parts)

    ships = counts(
        ('waiting', status.ships_waiting + status.ships_claimed),
        *((name, status.counts.get(f'ships_{name}', 0)) for name in _FATES),
    )
    lists = counts(
        ('in outbox', status.in_outbox),
        ('delivered', status.counts.get('delivered', 0)),
        ('lost with an outbox', status.counts.get('outbox_lost', 0)),
    )
    lines = [
        f'ships      {status.counts.get("ships_added", 0)} listed ({ships})',
        f'lists      {status.counts.get("released", 0)} released ({lists})',
    ]
    if status.set_aside:
        lines.append(f'{status.set_aside} damaged catalogues of lists set aside')
    if status.balance:
        lines.append(f'The books do not balance: {status.balance} ships are unaccounted for')
    return '\n'.join(lines)


def list_books(status: ListStatus) -> dict[str, int]:
    """Return the books of ship lists for a JSON file."""
    books = {name: value for name, value in vars(status).items() if name != 'counts'}
    return books | dict(sorted(status.counts.items()))


def chip_table(chips: Iterable[StoredChip], fade: float) -> str:
    """Write chips as a table, in the order of their release."""
    rows = [('id', 'class', 'value', 'rank', 'kB', 'state')]
    for chip in chips:
        if chip.is_intact():
            numbers = f'{chip.value:.4g}', f'{chip.rank(fade):.4g}', f'{chip.bytes / 1e3:.1f}'
            rows.append((chip.id, printable(chip.class_id), *numbers, _state(chip)))
        else:
            rows.append((printable(str(chip.id)), 'damaged', '', '', '', _state(chip)))
    return '\n'.join(aligned(rows, left=(0, 1, 5)))


def object_table(objects: Iterable[ObjectSummary], fade: float) -> str:
    """Write ships as a table, in the order of the ranks of their best chips."""
    rows = [('ship', 'class', 'chips', 'released', 'best value', 'rank')]
    for ship in objects_as_json(objects, fade):
        numbers = f'{ship["views"]}', f'{ship["released"]}', f'{ship["value"]:.4g}'
        text = printable(str(ship['object']))
        rows.append((text, printable(ship['class_id']), *numbers, f'{ship["rank"]:.4g}'))
    return '\n'.join(aligned(rows, left=(0, 1)))


def objects_as_json(objects: Iterable[ObjectSummary], fade: float) -> list[dict[str, Any]]:
    """Return ships for a JSON file, but those whose best chip is damaged."""
    keys = ('object', 'id', 'class_id', 'value', 'rank')
    return [
        {key: described.get(key) for key in keys} | {'views': ship.views, 'released': ship.released}
        for ship in objects
        if 'damaged' not in (described := _described(ship.best, fade))
    ]


def as_json(status: Status, chips: Iterable[StoredChip]) -> Mapping[str, Any]:
    """Return books and chips for a JSON file."""
    books = {name: value for name, value in vars(status).items() if name != 'file_bytes'}
    return books | {
        'chips': [{**_described(chip, status.fade), 'state': _state(chip)} for chip in chips]
    }


def _described(chip: StoredChip, fade: float) -> Mapping[str, Any]:
    """Describe a chip, as far as its description is not damaged."""
    with suppress(ValueError, RecursionError):
        if chip.is_intact():
            return chip.describe(fade)
    return {'id': chip.id, 'value': chip.value, 'damaged': True}


def _state(chip: StoredChip) -> str:
    """Name the state of a chip."""
    return dict(enumerate(STATES)).get(chip.state, 'damaged')


def wrong_with(console: SpoolConsole) -> Iterator[str]:
    """Check structure, books and the file of every chip; yield what is wrong."""
    try:
        yield from console.integrity()
        for chip, data in console.files(track(console.select(), 'checking')):
            if describe_intact(chip, data, fade=None) is None:
                yield f'{chip.id}: its file or description is damaged'
    except SpoolDamagedError as error:
        note(str(error))
        yield 'the check has not come to its end'
    # Last: the checks may have set the catalogue aside.
    status = console.status()
    if status.balance:
        yield f'the books do not balance: {status.balance} chips are unaccounted for'
    if status.set_aside:
        yield (
            f'{status.set_aside} damaged catalogues are set aside, each with a file *.damaged '
            "beside it: 'obbhbb spool FILE export' writes their intact chips"
        )


def wrong_with_lists(lists: ListConsole) -> Iterator[str]:
    """Check structure, books and every ship list; yield what is wrong."""
    try:
        yield from lists.integrity()
    except SpoolDamagedError as error:
        note(str(error))
        yield 'the check of the ship lists has not come to its end'
    status = lists.status()
    if status.balance:
        yield f'the books of the lists do not balance: {status.balance} ships are unaccounted for'
    if status.set_aside:
        yield (
            f'{status.set_aside} damaged catalogues of ship lists are set aside, each with a file '
            "*.damaged beside it: 'obbhbb spool FILE export' writes their intact lists"
        )


def export_lists(lists: Iterable[ShipListFile], folder: Path) -> int:
    """Write ship lists with their JSON to a folder, as to an outbox; return how many."""
    outbox, count = Outbox(folder), 0
    for ships in lists:
        folder.mkdir(parents=True, exist_ok=True)
        outbox.add(ships.id, ships.suffix, ships.content, ships.json_bytes(), level=0)
        count += 1
    outbox.finish()
    return count


def export(
    chips: Iterable[tuple[StoredChip, bytes]], folder: Path, fade: float | None = None
) -> int:
    """Write chips with their JSON to a folder, as to an outbox; return how many."""
    outbox, count = Outbox(folder), 0
    for chip, data in chips:
        description = describe_intact(chip, data, fade)
        if description is None:
            note(f'obbhbb: left out: {chip.id} is damaged')
            continue
        folder.mkdir(parents=True, exist_ok=True)
        outbox.put(chip.id, CODECS[description['codec']].suffix, data, description, level=0)
        count += 1
    return count
