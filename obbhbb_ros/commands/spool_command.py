# SPDX-License-Identifier: Apache-2.0
"""The command `obbhbb spool`."""

from __future__ import annotations

import json
import math
from argparse import ArgumentParser
from argparse import Namespace
from collections.abc import Callable
from collections.abc import Iterable
from collections.abc import Mapping
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

from obbhbb_ros.ground import spools
from obbhbb_ros.spool.books import Status
from obbhbb_ros.spool.chip_rows import StoredChip
from obbhbb_ros.spool.console import ANY_CHIP
from obbhbb_ros.spool.console import ChipFilter
from obbhbb_ros.spool.console import ObjectSummary
from obbhbb_ros.spool.console import SpoolConsole
from obbhbb_ros.spool.list_rows import ShipListFile
from obbhbb_ros.spool.salvage import holds_lists
from obbhbb_ros.spool.salvage import intact_chips
from obbhbb_ros.spool.salvage import intact_lists

_CHIPS_LISTED, _EXPORTED = 20, Path('out/chips')
_ALL = 2**63 - 1
# Options of `obbhbb spool` that one action takes.
_OF_ONE_ACTION = {
    'limit': 'list',
    'json': 'list',
    'by_object': 'list',
    'to': 'revalue',
    'by': 'revalue',
    'output': 'export',
}


def add_spool_options(parser: ArgumentParser) -> None:
    """Add the options of `obbhbb spool`."""
    add = parser.add_argument
    add(
        'spool',
        type=Path,
        metavar='PATH',
        help='folder of the spool; for export also a damaged catalogue, chips_*.sqlite3 or '
        'lists/ships_*.sqlite3',
    )
    add(
        'action',
        nargs='?',
        default='list',
        choices=tuple(SPOOL_ACTIONS),
        help=' '.join(f'{name}: {act.__doc__}' for name, act in SPOOL_ACTIONS.items())
        + ' Default: %(default)s',
    )
    add(
        '--class',
        dest='class_ids',
        nargs='+',
        default=(),
        metavar='CLASS',
        help='only chips of these classes',
    )
    add('--id', dest='ids', nargs='+', default=(), metavar='ID', help='only these chips')
    add(
        '--object',
        dest='objects',
        nargs='+',
        default=(),
        metavar='OBJECT',
        help='only chips of these ships, by the key object of their JSON',
    )
    for bound, default, others in (('min', -math.inf, 'more'), ('max', math.inf, 'less')):
        meaning = f'only chips of this value or {others}'
        add(f'--{bound}-value', type=float, default=default, metavar='V', help=meaning)
    add('--all', action='store_true', help='delete, revalue: all chips, without a condition')
    add(
        '--limit',
        type=int,
        metavar='N',
        help=f'list: maximum number of chips (0: all); default: {_CHIPS_LISTED}',
    )
    add('--json', action='store_true', help='list: print JSON')
    add(
        '--objects',
        dest='by_object',
        action='store_true',
        help='list: one line for each known ship whose chips wait',
    )
    add('--to', type=float, metavar='V', help='revalue: the new value')
    add('--by', type=float, metavar='F', help='revalue: factor on the value, 0 or more')
    add('-o', '--output', type=Path, help=f'export: folder to write to; default: {_EXPORTED}')


def run_spool(options: Namespace) -> int:
    """List, check, revalue, delete or export the chips of a spool."""
    for name, action in _OF_ONE_ACTION.items():
        value = getattr(options, name)
        if action != options.action and value is not None and value is not False:
            option = 'objects' if name == 'by_object' else name
            raise ValueError(f'{options.action}: takes no --{option}, it is for {action}')
    if (options.limit or 0) < 0:
        raise ValueError(f'--limit must be 0 or more, not {options.limit}')
    if math.isnan(options.min_value) or math.isnan(options.max_value):
        raise ValueError('--min-value and --max-value must be numbers')
    chips = ChipFilter(
        options.class_ids, options.ids, options.min_value, options.max_value, options.objects
    )
    if options.spool.is_file() and options.action == 'export':
        _export_intact(chips, options)
        return 0
    if options.action in ('delete', 'revalue') and chips == ANY_CHIP and not options.all:
        raise ValueError(f'{options.action}: which chips? Give a condition, or --all')
    if options.action in ('check', 'forget-outbox') and chips != ANY_CHIP:
        raise ValueError(f'{options.action}: takes no condition, it is for the whole spool')
    with closing(spools.open_spool(options.spool)) as console:
        return SPOOL_ACTIONS[options.action](console, chips, options) or 0


def _list_spool(console: SpoolConsole, chips: ChipFilter, options: Namespace) -> None:
    """Show the books, and the chips that are released next."""
    # Larger numbers do not fit into SQL.
    limit = _CHIPS_LISTED if options.limit is None else min(options.limit or _ALL, _ALL)
    status = console.status()
    if options.by_object:
        _list_objects(console.objects(chips, limit), status, options)
        return
    shown = console.select(chips, limit)
    if options.json:
        _print_json(spools.as_json(status, shown), options)
    else:
        print(f'{_books_text(status, options)}\n\n{spools.chip_table(shown, status.fade)}')


def _list_objects(objects: Sequence[ObjectSummary], status: Status, options: Namespace) -> None:
    """Show the books, and the ships whose chips are released next."""
    if options.json:
        listed = spools.objects_as_json(objects, status.fade)
        _print_json({**spools.as_json(status, ()), 'objects': listed}, options)
    else:
        print(f'{_books_text(status, options)}\n\n{spools.object_table(objects, status.fade)}')


def _books_text(status: Status, options: Namespace) -> str:
    """Write the books of chips and of ship lists."""
    text = spools.status_text(status)
    if lists := spools.open_lists(options.spool):
        with closing(lists):
            text += '\n' + spools.list_text(lists.status())
    return text


def _print_json(books: Mapping[str, Any], options: Namespace) -> None:
    """Print books of chips, and with them those of ship lists."""
    if lists := spools.open_lists(options.spool):
        with closing(lists):
            books = {**books, 'lists': spools.list_books(lists.status())}
    print(json.dumps(books, indent=1, ensure_ascii=False))


def _check_spool(console: SpoolConsole, chips: ChipFilter, options: Namespace) -> int:
    """Check catalogues, books and files."""
    wrong = list(spools.wrong_with(console))
    if lists := spools.open_lists(options.spool):
        with closing(lists):
            wrong += spools.wrong_with_lists(lists)
    print('\n'.join(wrong) or f'{options.spool} is in order')
    return 1 if wrong else 0


def _revalue_spool(console: SpoolConsole, chips: ChipFilter, options: Namespace) -> None:
    """Give waiting chips another value, and so another place in the order."""
    if (options.to is None) == (options.by is None):
        raise ValueError('revalue: give either --to or --by')
    factor, addend = (0.0, options.to) if options.by is None else (options.by, 0.0)
    if not math.isfinite(factor + addend):
        raise ValueError('revalue: the value must be finite')
    if factor < 0.0:
        raise ValueError('revalue: --by must be 0 or more: less would reverse the order')
    print(f'{console.revalue(chips, factor, addend)} chips revalued')


def _delete_from_spool(console: SpoolConsole, chips: ChipFilter, options: Namespace) -> None:
    """Delete waiting chips."""
    print(f'{console.delete(chips)} chips deleted')


def _export_spool(console: SpoolConsole, chips: ChipFilter, options: Namespace) -> None:
    """Write chips, ship lists and their JSON to a folder, and leave them in the spool."""
    fade = console.status().fade
    _export(console.files(console.select(chips)), options, fade)
    # Conditions are on chips.
    if chips == ANY_CHIP and (lists := spools.open_lists(options.spool)):
        with closing(lists):
            _export_lists(lists.files(), options)


def _export(
    chips: Iterable[tuple[StoredChip, bytes]], options: Namespace, fade: float | None = None
) -> None:
    """Write chips to a folder, and say how many."""
    print(f'{spools.export(chips, options.output or _EXPORTED, fade)} chips exported')


def _export_lists(lists: Iterable[ShipListFile], options: Namespace) -> None:
    """Write ship lists to a folder, and say how many."""
    print(f'{spools.export_lists(lists, options.output or _EXPORTED)} ship lists exported')


def _export_intact(chips: ChipFilter, options: Namespace) -> None:
    """Write what is intact in a catalogue of chips or of ship lists."""
    if holds_lists(options.spool):
        if chips != ANY_CHIP:
            raise ValueError('export: a catalogue of ship lists takes no condition')
        _export_lists(intact_lists(options.spool), options)
        return
    _export(((c, data) for c, data in intact_chips(options.spool) if chips.matches(c)), options)


def _forget_outbox(console: SpoolConsole, chips: ChipFilter, options: Namespace) -> None:
    """Count the chips in a lost outbox as evicted, so that another one is used."""
    print(f'{console.forget_outbox()} chips counted as evicted')


# The docstring of the function that carries out an action is its help. It may return an exit code.
SPOOL_ACTIONS: dict[str, Callable[[SpoolConsole, ChipFilter, Namespace], int | None]] = {
    'list': _list_spool,
    'check': _check_spool,
    'revalue': _revalue_spool,
    'delete': _delete_from_spool,
    'export': _export_spool,
    'forget-outbox': _forget_outbox,
}
