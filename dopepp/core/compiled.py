"""How this package compiles its inner loops."""

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

Array = NDArray[Any]
"""An argument of a compiled function; its docstring gives shape and type."""

Scalar = Any
"""A number of a compiled function that is float32 or float64, as its caller's arrays are."""

Function = TypeVar("Function", bound=Callable[..., Any])


def compiled(**options: Any) -> Callable[[Function], Function]:
    """Compile with numba, without the GIL and single-threaded, because data loaders fork.

    A division by zero gives what IEEE 754 says, as in numpy; a check for it would also keep loops
    from becoming vector loops.

    The machine code is kept on disk beside the package, or in the user's cache folder where that
    is read-only; ``NUMBA_CACHE_DIR`` moves it. Plain loops compile many times faster than slices
    that are assigned, array expressions, and calls with constants, each of which numba compiles
    anew.
    """
    compiler = numba.njit(cache=True, nogil=True, error_model="numpy", **options)
    return cast("Callable[[Function], Function]", compiler)


_beside: Final[list[str]] = []
"""Functions that a process of its own calls once this process has to compile anything."""


def compile_beside(function: str) -> None:
    """Name a function, ``module:function``, that calls inner loops which will be needed later.

    As soon as this process has to compile anything, as on a new machine, another one calls the
    function. Both keep their machine code in the same place, so that two cores share the work.
    """
    if function not in _beside:
        _beside.append(function)


class _Compilation(event.Listener):  # type: ignore[misc]  # numba has no types
    """Shares the first compilation among processes, and says once why the first call takes long.

    What is on disk already is not compiled. A compiler's many objects all live to its end, so
    that searching them for garbage in between would take a quarter of the time.
    """

    is_first, depth, collects = True, 0, False

    def on_start(self, event: event.Event) -> None:
        if self.depth == 0:
            self.collects = gc.isenabled()
            gc.disable()
        self.depth += 1
        if self.is_first:
            self.is_first = False
            _log.info("compiling inner loops, once on this machine: ten seconds or so")
            for function in _beside:
                _call_beside(*function.split(":"))

    def on_end(self, event: event.Event) -> None:
        self.depth -= 1
        if self.depth == 0 and self.collects:
            gc.enable()


def _call_beside(module: str, function: str) -> None:
    """Call a function in a process of its own; where there can be none, nothing happens."""
    code = f"import sys; sys.path[:] = {sys.path!r}; from {module} import {function} as f; f()"
    with contextlib.suppress(OSError):
        subprocess.Popen(
            [sys.executable, "-c", code], stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )  # fmt: skip


event.register("numba:compile", _Compilation())
