# SPDX-License-Identifier: Apache-2.0
"""Progress on the terminal, if there is one and tqdm (extra `progress`) is installed."""

from __future__ import annotations

import sys
from collections.abc import Iterable
from collections.abc import Iterator
from contextlib import suppress
from typing import TypeVar

Item = TypeVar('Item')


def track(
    items: Iterable[Item], label: str, total: int | None = None, unit: str = 'images'
) -> Iterator[Item]:
    """Yield items and show on stderr how many are done; `label` names the work."""
    if sys.stderr.isatty():
        with suppress(ModuleNotFoundError):
            from tqdm import tqdm

            items = tqdm(items, desc=label, total=total, unit=f' {unit}', leave=False)
    yield from items


def announce(step: str) -> None:
    """Say on the terminal what takes time now; nothing if stderr goes elsewhere."""
    if sys.stderr.isatty():
        note(f'{step} ...')


def note(message: str) -> None:
    """Print a line to stderr, above a progress bar if there is one."""
    tqdm = sys.modules.get('tqdm')
    if tqdm is None:
        print(message, file=sys.stderr)
    else:
        tqdm.tqdm.write(message, file=sys.stderr)


def printable(text: str) -> str:
    """Escape what a terminal or a UTF-8 file cannot show."""
    return ''.join(letter if letter.isprintable() else ascii(letter)[1:-1] for letter in text)
