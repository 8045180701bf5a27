# SPDX-License-Identifier: Apache-2.0
"""The command line `obbhbb`: what happens around a command, see `obbhbb_ros.commands`."""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Sequence

# What a shell adds to the number of the signal that ended a command.
_BY_SIGNAL = 128


def main(arguments: Sequence[str] | None = None) -> int:
    """
    Run a command.

    Parameters
    ----------
    arguments : sequence of str, optional
        Command line without the program's name; `sys.argv` by default.

    Returns
    -------
    int
        Exit code.
    """
    for name in ('stdout', 'stderr'):
        if getattr(sys, name) is None:
            # Closed by whoever started the command; what it prints goes nowhere.
            setattr(sys, name, open(os.devnull, 'w', encoding='utf-8'))  # noqa: SIM115
    given = list(sys.argv[1:] if arguments is None else arguments)
    try:
        # Here, so that Ctrl-C ends the command in silence while NumPy and shapely are loading.
        from obbhbb_ros.commands import run

        code = run(given)
        # Here rather than when Python ends, where nothing can be said any more.
        sys.stdout.flush()
    except KeyboardInterrupt:
        return _BY_SIGNAL + signal.SIGINT
    except BrokenPipeError:
        # Whoever read the output, `head` for one, has seen enough.
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
        return _BY_SIGNAL + signal.SIGPIPE
    except (ImportError, OSError, ValueError) as error:
        advice = '; see the extras in the README' if isinstance(error, ImportError) else ''
        print(f'obbhbb: {error}{advice}', file=sys.stderr)
        return 1
    return code


if __name__ == '__main__':
    sys.exit(main())
