"""This machine, as a process may use it: its cores, and its user's cache folder."""

from __future__ import annotations

import os
from pathlib import Path


def available_cores() -> int:
    """Return the cores that this process may use, where the system tells (Linux), else all."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def cache_folder() -> Path:
    """Return where dopepp keeps what it can make again (``XDG_CACHE_HOME``); it may be missing."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache", "dopepp")
