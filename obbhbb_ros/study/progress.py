# SPDX-License-Identifier: Apache-2.0
"""Progress on the terminal, where there is one."""

from __future__ import annotations

import sys
from collections.abc import Iterable
from collections.abc import Iterator
from typing import TypeVar

Item = TypeVar('Item')


def track(
    items: Iterable[Item], label: str, total: int | None = None, unit: str = ' images'
) -> Iterator[Item]:
    """
    Pass items on, with a progress bar on stderr.

    The bar is there only if stderr is a terminal and tqdm (extra `progress`) is installed.

    Parameters
    ----------
    items : iterable
        Any items.
    label : str
        What is being done.
    total : int, optional
        How many items there are, where known.
    unit : str
        What they are.

    Yields
    ------
    item
        Each of them.
    """
    if sys.stderr.isatty():
        try:
            from tqdm import tqdm
        except ModuleNotFoundError:
            pass
        else:
            items = tqdm(items, desc=label, total=total, unit=unit, leave=False)
    yield from items


def note(message: str) -> None:
    """Print a line to stderr, above a progress bar if there is one."""
    tqdm = sys.modules.get('tqdm')
    if tqdm is None:
        print(message, file=sys.stderr)
    else:
        tqdm.tqdm.write(message, file=sys.stderr)
