# SPDX-License-Identifier: Apache-2.0
"""The library that kills a process before a call, or has calls fail: made and preloaded."""

from __future__ import annotations

import ctypes
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

SOURCE = Path(__file__).with_name('faults.cc')


def build(folder: Path) -> Path:
    """Compile the library."""
    compiler = next(filter(None, map(shutil.which, ('c++', 'g++', 'clang++'))))
    made = folder / 'faults.so'
    subprocess.run(
        [compiler, '-O1', '-shared', '-fPIC', '-o', str(made), str(SOURCE), '-ldl'], check=True
    )
    return made


def loaded() -> ctypes.CDLL:
    """Give the functions of the library; if it is not preloaded, start this process again."""
    if not hasattr(ctypes.CDLL(None), 'faults_arm'):
        library = build(Path(tempfile.mkdtemp(prefix='faults')))
        os.environ['LD_PRELOAD'] = str(library)
        os.execv(sys.executable, [sys.executable, *sys.argv])
    found = ctypes.CDLL(None)
    found.faults_arm.argtypes = (ctypes.c_char_p, ctypes.c_long)
    found.faults_fail.argtypes = (ctypes.c_char_p, ctypes.c_long, ctypes.c_long, ctypes.c_int)
    found.faults_calls.restype = ctypes.c_long
    return found
