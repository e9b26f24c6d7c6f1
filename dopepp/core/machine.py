"""This machine, as a process may use it: its cores and threads, and its user's cache folder."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Final

THREAD_LIMITS: Final = (
    "OMP_NUM_THREADS",
    "OPENBLAS_NUM_THREADS",
    "MKL_NUM_THREADS",
    "BLIS_NUM_THREADS",
    "VECLIB_MAXIMUM_THREADS",
    "NUMBA_NUM_THREADS",
)
"""Environment variables that limit the threads of libraries loaded after they are set."""


def available_cores() -> int:
    """Return the cores that this process may use, where the system tells (Linux), else all."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def cache_folder() -> Path:
    """Return where dopepp keeps what it can make again (``XDG_CACHE_HOME``); it may be missing."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache", "dopepp")
