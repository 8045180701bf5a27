# SPDX-License-Identifier: Apache-2.0
"""The command line `obbhbb`: errors and signals of the commands in `obbhbb_ros.commands`."""

from __future__ import annotations

import io
import os
import signal
import sys
import threading
from collections.abc import Sequence

# Shells add this to the number of the signal that ended a command.
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
            # Closed by the caller: output is discarded.
            setattr(sys, name, open(os.devnull, 'w', encoding='utf-8'))  # noqa: SIM115
        stream = getattr(sys, name)
        if isinstance(stream, io.TextIOWrapper):
            # A terminal may lack letters of a class or a path.
            stream.reconfigure(errors='backslashreplace')
    given = list(sys.argv[1:] if arguments is None else arguments)
    if threading.current_thread() is threading.main_thread():
        # By default the process would leave unfinished files behind.
        signal.signal(signal.SIGTERM, _end_by)
    try:
        # Imported here so that Ctrl-C while NumPy and shapely load prints no traceback.
        from obbhbb_ros.commands import run

        code = run(given)
        # Flushed here, because errors when Python exits cannot be reported.
        sys.stdout.flush()
    except KeyboardInterrupt:
        return _BY_SIGNAL + signal.SIGINT
    except BrokenPipeError:
        # The reader of the output, such as `head`, has closed it.
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
        return _BY_SIGNAL + signal.SIGPIPE
    except (ImportError, OSError, ValueError) as error:
        advice = '; see the extras in the README' if isinstance(error, ImportError) else ''
        print(f'obbhbb: {error}{advice}', file=sys.stderr)
        return 1
    return code


def _end_by(number: int, frame: object) -> None:
    """End the process with the exit code that stands for a signal."""
    raise SystemExit(_BY_SIGNAL + number)


if __name__ == '__main__':
    sys.exit(main())
