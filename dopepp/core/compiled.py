"""How this package compiles its inner loops."""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import Any, TypeVar, cast

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
    is read-only; ``NUMBA_CACHE_DIR`` moves it.
    """
    compiler = numba.njit(cache=True, nogil=True, error_model="numpy", **options)
    return cast("Callable[[Function], Function]", compiler)


class _FirstTime(event.Listener):  # type: ignore[misc]  # numba has no types
    """Says once why the first call takes long; what is on disk already is not compiled."""

    told = False

    def on_start(self, event: event.Event) -> None:
        if not self.told:
            self.told = True
            _log.info("compiling inner loops, once on this machine: half a minute or so")

    def on_end(self, event: event.Event) -> None:
        pass


event.register("numba:compile", _FirstTime())
