"""Mitsuba, imported once per process in the fastest variant that runs on this machine.

``llvm_ad_rgb`` compiles its kernels with the system's libLLVM and is several times faster than
``scalar_rgb``, which needs no library. An incompatible libLLVM (15 and older, as in Debian 12) ends
the whole process. Each library is therefore first tried in a separate process; the outcome is
cached in the user's cache folder until the library or Mitsuba changes.

Environment variables:
    ``DOPEPP_MITSUBA_VARIANT``: ``llvm_ad_rgb`` or ``scalar_rgb`` instead of the automatic choice.
    ``DRJIT_LIBLLVM_PATH``: Path of the only library to try.
    ``DOPEPP_RENDER_THREADS``: Number of render threads; by default one per available core, and a
    single one in a worker process.
"""

from __future__ import annotations

import logging
import multiprocessing
import os
import re
import subprocess
import sys
from functools import cache
from importlib import import_module
from importlib.metadata import version
from pathlib import Path
from typing import Any, Final

from dopepp.core.errors import UserError, require
from dopepp.core.json import cached
from dopepp.core.pool import available_cores

_log = logging.getLogger(__name__)

VARIANTS: Final = ("llvm_ad_rgb", "scalar_rgb")
VARIANT_SETTING: Final = "DOPEPP_MITSUBA_VARIANT"
LIBRARY_SETTING: Final = "DRJIT_LIBLLVM_PATH"
THREADS_SETTING: Final = "DOPEPP_RENDER_THREADS"

LIBRARY_PATTERNS: Final = (
    "/usr/lib/*-linux-gnu/libLLVM*.so.*",
    "/usr/lib64/libLLVM*.so.*",
    "/usr/lib/libLLVM*.so.*",
    "/opt/homebrew/opt/llvm/lib/libLLVM.dylib",
)
"""Paths of libLLVM on Debian, Fedora, Arch and Homebrew."""

_TRIAL: Final = """
import mitsuba as mi
mi.set_variant("llvm_ad_rgb")
scene = mi.cornell_box()
scene["small-box"]["bsdf"] = {"type": "principled", "roughness": 0.3, "metallic": 0.5}
print("mean", float(mi.TensorXf(mi.render(mi.load_dict(scene), spp=1)).array[0]))
"""
"""A small scene that uses most features of Mitsuba."""


def mitsuba() -> Any:
    """Return the ``mitsuba`` module with its variant and threads set.

    Raises:
        UserError: Mitsuba is not installed, an environment variable is invalid, or this process was
            forked after rendering and lacks the render threads.
    """
    require("mitsuba", "renderer 'photoreal'", "photoreal")
    pid = _start()
    if pid != os.getpid():
        raise UserError(
            f"a process forked from process {pid}, which has rendered with Mitsuba",
            "workers that were spawned, or forked before the first image",
            "start workers with multiprocessing.get_context('spawn')",
        )
    return import_module("mitsuba")


def num_threads() -> int:
    """Return the number of render threads of this process.

    Raises:
        UserError: ``DOPEPP_RENDER_THREADS`` is not a positive integer.
    """
    setting = os.environ.get(THREADS_SETTING)
    if setting is not None:
        if not setting.isdecimal() or int(setting) < 1:
            fix = f"set {THREADS_SETTING}=1, or unset it"
            raise UserError(f"{THREADS_SETTING}={setting!r}", "a number of at least 1", fix)
        return int(setting)
    return 1 if multiprocessing.parent_process() is not None else available_cores()


@cache
def _start() -> int:
    """Import Mitsuba in the chosen variant once, and return the id of the process that did."""
    library = _chosen_library()
    if library is not None and os.environ.get(LIBRARY_SETTING) != str(library):
        if "drjit" in sys.modules:
            message = "Dr.Jit was imported before dopepp chose its libLLVM: rendering with %s"
            _log.warning(message, "scalar_rgb")
            library = None
        else:
            os.environ[LIBRARY_SETTING] = str(library)
    module, drjit = import_module("mitsuba"), import_module("drjit")
    module.set_variant(_variant(library))
    drjit.set_thread_count(num_threads())
    _log.info("Mitsuba %s, %s, libLLVM %s", module.__version__, module.variant(), library)
    return os.getpid()


def usable_variant() -> str:
    """Return the variant that renders use, without starting Mitsuba."""
    require("mitsuba", "renderer 'photoreal'", "photoreal")
    return _variant(_chosen_library())


def _variant(library: Path | None) -> str:
    return "scalar_rgb" if library is None else "llvm_ad_rgb"


def _chosen_library() -> Path | None:
    """Return the libLLVM to use; None for the scalar variant."""
    variant = os.environ.get(VARIANT_SETTING)
    if variant not in (None, *VARIANTS):
        fix = f"set {VARIANT_SETTING} to one of these names, or unset it"
        raise UserError(f"{VARIANT_SETTING}={variant!r}", ", ".join(VARIANTS), fix)
    if variant == "scalar_rgb":
        return None
    libraries = candidates()
    library = next((path for path in libraries if is_usable(path)), None)
    if library is None and variant == "llvm_ad_rgb":
        raise UserError(
            f"{VARIANT_SETTING}={variant} with {', '.join(map(str, libraries)) or 'no libLLVM'}",
            "a libLLVM that Mitsuba can work with",
            f"install a newer LLVM, set {LIBRARY_SETTING}, or unset {VARIANT_SETTING}",
        )
    return library


def candidates() -> list[Path]:
    """Return the libLLVM files to try: ``DRJIT_LIBLLVM_PATH``, or all installed, newest first."""
    setting = os.environ.get(LIBRARY_SETTING)
    if setting:
        return [Path(setting)]
    root = Path("/")
    libraries = {path.resolve() for pattern in LIBRARY_PATTERNS for path in root.glob(pattern[1:])}

    def version_of(path: Path) -> tuple[list[int], Path]:
        # The name contains the version: libLLVM-17.so.1, libLLVM.so.19.1.
        return [int(digits) for digits in re.findall(r"\d+", path.name)], path

    return sorted(libraries, key=version_of, reverse=True)


def is_usable(library: Path) -> bool:
    """Return whether a trial process could render with a libLLVM; the outcome is cached."""

    def works() -> bool:
        trial = subprocess.run(
            [sys.executable, "-c", _TRIAL],
            env={**os.environ, LIBRARY_SETTING: str(library)},
            capture_output=True,
            text=True,
            timeout=60.0,
        )
        usable = trial.returncode == 0 and "mean" in trial.stdout
        _log.info("%s %s with Mitsuba", library, "works" if usable else "does not work")
        return usable

    try:
        stat = library.stat()
        versions = version("mitsuba"), version("drjit")
        key = (str(library), stat.st_mtime_ns, stat.st_size, *versions)
        return cached("libllvm", key, bool, works)
    except (OSError, subprocess.TimeoutExpired) as error:
        _log.warning("%s could not be tested: %s", library, error)
        return False
