# SPDX-License-Identifier: Apache-2.0
"""The command line `obbhbb`: runs a command, and turns its errors and signals into exit codes."""

from __future__ import annotations

import io
import os
import signal
import sys
import threading
from collections.abc import Sequence

from obbhbb_ros.errors import ObbhbbError

# Shells add the number of the signal that ended a command to this.
_BY_SIGNAL = 128
# The extra that brings a module.
_EXTRAS = {
    'PIL': 'images',
    'geopandas': 'geo',
    'jinja2': 'plots',
    'lz4': 'bags',
    'matplotlib': 'plots',
    'mcap': 'bags',
    'pyarrow': 'arrow',
    'pyogrio': 'geo',
    'pyproj': 'geo',
    'rasterio': 'geo',
    'rosbags': 'bags',
    'ruamel': 'bags',
    'tqdm': 'progress',
    'yaml': 'bags',
    'zstandard': 'bags',
}


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
    _prepare_output()
    if threading.current_thread() is threading.main_thread():
        # The default handler would leave unfinished files behind.
        signal.signal(signal.SIGTERM, _exit_by_signal)
    try:
        # Imported here so that Ctrl-C while NumPy and shapely are loading prints no traceback.
        from obbhbb_ros.commands import run

        code = run(sys.argv[1:] if arguments is None else arguments)
        # Flushed here, because an error while Python exits cannot be reported.
        sys.stdout.flush()
    except KeyboardInterrupt:
        return _BY_SIGNAL + signal.SIGINT
    except BrokenPipeError:
        # The reader of the output, such as `head`, has closed it.
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
        return _BY_SIGNAL + signal.SIGPIPE
    except (MemoryError, RecursionError) as error:
        is_memory = isinstance(error, MemoryError)
        what = 'not enough memory' if is_memory else 'the input is nested too deeply'
        print(f'obbhbb: {what}', file=sys.stderr)
        return 1
    except (ObbhbbError, ImportError, OSError, ValueError) as error:
        advice = _advice(error) if isinstance(error, ImportError) else ''
        print(f'obbhbb: {error}{advice}', file=sys.stderr)
        return 1
    return code


def _advice(error: ImportError) -> str:
    """Say what to install if a module is missing."""
    module = (error.name or '').partition('.')[0]
    if extra := _EXTRAS.get(module):
        return f"; install the extra {extra}: pip install '.[{extra}]' in the checkout"
    if module.startswith('rcl') or module.endswith(('_msgs', '_interfaces')):
        return '; this needs ROS 2 Jazzy, or the extra jazzy'
    return '; see the extras in the README'


def _prepare_output() -> None:
    """Accept closed output streams, and letters that the terminal lacks."""
    for name in ('stdout', 'stderr'):
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, 'w', encoding='utf-8'))  # noqa: SIM115
        stream = getattr(sys, name)
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors='backslashreplace')


def _exit_by_signal(number: int, frame: object) -> None:
    """Exit with the code that shells use for a signal."""
    raise SystemExit(_BY_SIGNAL + number)


if __name__ == '__main__':
    sys.exit(main())
