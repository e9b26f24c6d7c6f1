"""Compilation of inner loops with numba."""

from __future__ import annotations

import contextlib
import gc
import logging
import subprocess
import sys
from collections.abc import Callable
from typing import Any, Final, TypeVar, cast

import numba
from numba.core import event
from numpy.typing import NDArray

_log = logging.getLogger(__name__)

Array = NDArray[Any]  # the docstring of a compiled function gives shape and type
Scalar = Any  # a float32 or float64, like the arrays of the caller

Function = TypeVar("Function", bound=Callable[..., Any])


def compiled(**options: Any) -> Callable[[Function], Function]:
    """Return a decorator that compiles a function with numba and further ``options`` of njit.

    Compiled functions release the GIL and are single-threaded, because data loaders fork. Division
    by zero follows IEEE 754, as in numpy; a check would prevent vectorised loops. Plain loops
    compile many times faster than slice assignments, array expressions and calls with constants.

    The machine code is cached next to the package, or in the user's cache folder if the package is
    read-only; ``NUMBA_CACHE_DIR`` overrides both. The code of a function is not renewed when a
    function that it calls in another file changes: delete the cache (``*.nbc``).
    """
    compiler = numba.njit(cache=True, nogil=True, error_model="numpy", **options)
    return cast("Callable[[Function], Function]", compiler)


_warm_ups: Final[list[str]] = []


def compile_in_background(function: str) -> None:
    """Register a function (``module:function``) whose call compiles loops that are needed later.

    When this process compiles for the first time, as on a new machine, it starts a process for each
    registered function. All processes use the same cache, so several cores share the compilation.
    """
    if function not in _warm_ups:
        _warm_ups.append(function)


class _Compilation(event.Listener):  # type: ignore[misc]  # numba has no types
    """Starts the registered functions at numba's first compilation, and logs the delay's reason.

    Garbage collection is paused during a compilation, as it would take a quarter of the time.
    """

    is_first, depth, collects = True, 0, False

    def on_start(self, event: event.Event) -> None:
        """Pause garbage collection; at the first compilation, start the registered functions."""
        if self.depth == 0:
            self.collects = gc.isenabled()
            gc.disable()
        self.depth += 1
        if self.is_first:
            self.is_first = False
            _log.info("compiling inner loops, once on this machine: about ten seconds")
            for function in _warm_ups:
                _call_in_process(*function.split(":"))

    def on_end(self, event: event.Event) -> None:
        """Resume garbage collection after the outermost compilation."""
        self.depth -= 1
        if self.depth == 0 and self.collects:
            gc.enable()


def _call_in_process(module: str, function: str) -> None:
    """Call a function in a new process without waiting; ignore a failure to start the process."""
    code = f"import sys; sys.path[:] = {sys.path!r}; from {module} import {function} as f; f()"
    with contextlib.suppress(OSError):
        null = subprocess.DEVNULL
        subprocess.Popen([sys.executable, "-c", code], stdin=null, stdout=null, stderr=null)


event.register("numba:compile", _Compilation())
