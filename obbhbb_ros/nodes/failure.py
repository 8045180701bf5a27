# SPDX-License-Identifier: Apache-2.0
"""What a process says if its node cannot start. It imports nothing else of the package."""

from __future__ import annotations

import sys

REASONS = (ImportError, MemoryError, OSError, RuntimeError, ValueError)
"""What stops a start for a reason outside the code; RCLError and StartError are RuntimeErrors."""


def cannot_start(error: BaseException) -> int:
    """
    Print in one line why a node cannot start.

    Parameters
    ----------
    error : BaseException
        The reason.

    Returns
    -------
    int
        Exit code of the process: 1.
    """
    print(f'cannot start: {" ".join(_text(error).split())}', file=sys.stderr)
    return 1


def _text(error: BaseException) -> str:
    """Describe an error; some say nothing, or nothing that helps."""
    if isinstance(error, MemoryError):
        return 'too little memory'
    if isinstance(error, UnicodeEncodeError):
        return f'{error.object!a} is not UTF-8 text here; LANG=C.UTF-8 helps if it looks right'
    text = str(error) or type(error).__name__
    if "type 'INTEGER', expecting type 'DOUBLE'" in text:
        text += '; write 2.0 instead of 2'
    return text
