"""Mitsuba, imported once a process in the fastest variant that runs on this machine.

``llvm_ad_rgb`` compiles its kernels with the system's libLLVM and is several times faster than
``scalar_rgb``, which needs nothing. A libLLVM that Mitsuba cannot work with (15 and older, as in
Debian 12) ends the whole process, so each is first tried in a process of its own, and the outcome
is kept in the user's cache folder for as long as library and Mitsuba stay the same.

Environment variables:
    ``DOPEPP_MITSUBA_VARIANT``: ``llvm_ad_rgb`` or ``scalar_rgb`` instead of the automatic choice.
    ``DRJIT_LIBLLVM_PATH``: Mitsuba's own; the only library that is tried where it is set.
    ``DOPEPP_RENDER_THREADS``: Threads to render with; by default one for each core that this
    process may run on, and a single one in a worker that another Python process started.
"""

from __future__ import annotations

import hashlib
import logging
import multiprocessing
import os
import re
import subprocess
import sys
from contextlib import suppress
from functools import cache
from importlib import import_module
from importlib.metadata import version
from pathlib import Path
from typing import Any, Final

from dopepp.core.errors import UserError, require
from dopepp.core.files import cache_folder
from dopepp.core.pool import available_cores

_log = logging.getLogger(__name__)

VARIANTS: Final = ("llvm_ad_rgb", "scalar_rgb")
VARIANT_SETTING: Final = "DOPEPP_MITSUBA_VARIANT"
LIBRARY_SETTING: Final = "DRJIT_LIBLLVM_PATH"
THREADS_SETTING: Final = "DOPEPP_RENDER_THREADS"

PLACES: Final = (
    "/usr/lib/*-linux-gnu/libLLVM*.so.*",
    "/usr/lib64/libLLVM*.so.*",
    "/usr/lib/libLLVM*.so.*",
    "/opt/homebrew/opt/llvm/lib/libLLVM.dylib",
)
"""Where Debian, Fedora, Arch and Homebrew put libLLVM; the environment names one elsewhere."""

_TRIAL: Final = """
import mitsuba as mi
mi.set_variant("llvm_ad_rgb")
scene = mi.cornell_box()
scene["small-box"]["bsdf"] = {"type": "principled", "roughness": 0.3, "metallic": 0.5}
print("mean", float(mi.TensorXf(mi.render(mi.load_dict(scene), spp=1)).array[0]))
"""
"""A small scene with most of what compiles in a real one."""


def mitsuba() -> Any:
    """Return the ``mitsuba`` module with its variant and threads set.

    Raises:
        UserError: It is not installed, a setting is wrong, or this process was forked from one that
            has rendered, whose threads it lacks.
    """
    require("mitsuba", "renderer 'photoreal'", "photoreal")
    pid = _start()
    if pid != os.getpid():
        raise UserError(
            f"a process forked from one ({pid}) that has rendered with Mitsuba",
            "workers that were spawned, or forked before the first image",
            "start workers with multiprocessing.get_context('spawn')",
        )
    return import_module("mitsuba")


def num_threads() -> int:
    """Return the threads to render with; a UserError, if the environment states no such number."""
    setting = os.environ.get(THREADS_SETTING)
    if setting is not None:
        if not setting.isdecimal() or int(setting) < 1:
            raise UserError(f"{THREADS_SETTING}={setting!r}", "a number of at least 1", "change it")
        return int(setting)
    return 1 if multiprocessing.parent_process() is not None else available_cores()


@cache
def _start() -> int:
    """Import Mitsuba in the chosen variant; return the process that did."""
    library = _chosen_library()
    if library is not None and os.environ.get(LIBRARY_SETTING) != str(library):
        if "drjit" in sys.modules:
            _log.warning("Dr.Jit was imported before dopepp could choose its libLLVM: scalar_rgb")
            library = None
        else:
            os.environ[LIBRARY_SETTING] = str(library)
    module, drjit = import_module("mitsuba"), import_module("drjit")
    module.set_variant("scalar_rgb" if library is None else "llvm_ad_rgb")
    drjit.set_thread_count(num_threads())
    _log.info("Mitsuba %s, %s, libLLVM %s", module.__version__, module.variant(), library)
    return os.getpid()


def _chosen_library() -> Path | None:
    """Return the libLLVM to use; None for the scalar variant."""
    wish = os.environ.get(VARIANT_SETTING)
    if wish not in (None, *VARIANTS):
        raise UserError(f"{VARIANT_SETTING}={wish!r}", ", ".join(VARIANTS), "change or unset it")
    if wish == "scalar_rgb":
        return None
    libraries = candidates()
    library = next((path for path in libraries if is_usable(path)), None)
    if library is None and wish == "llvm_ad_rgb":
        raise UserError(
            f"{VARIANT_SETTING}={wish} with {', '.join(map(str, libraries)) or 'no libLLVM'}",
            "a libLLVM that Mitsuba can work with",
            f"install a newer LLVM, set {LIBRARY_SETTING}, or unset {VARIANT_SETTING}",
        )
    return library


def candidates() -> list[Path]:
    """Return the libLLVM files to try, the newest version first."""
    setting = os.environ.get(LIBRARY_SETTING)
    if setting:
        return [Path(setting)]
    libraries = {path.resolve() for place in PLACES for path in Path("/").glob(place[1:])}
    # Their names give the version: libLLVM-17.so.1, libLLVM.so.19.1.
    numbers = {
        path: [int(digits) for digits in re.findall(r"\d+", path.name)] for path in libraries
    }
    return sorted(libraries, key=lambda path: (numbers[path], path), reverse=True)


def is_usable(library: Path) -> bool:
    """Tell whether Mitsuba renders with a libLLVM, from memory on disk or by trying it."""
    try:
        stat = library.stat()
    except OSError:
        return False
    key = f"{library} {stat.st_mtime_ns} {stat.st_size} {version('mitsuba')} {version('drjit')}"
    memory = cache_folder() / f"libllvm_{hashlib.sha256(key.encode()).hexdigest()[:16]}"
    with suppress(OSError, ValueError, KeyError):  # not tried yet, or the file is damaged
        return {"works": True, "fails": False}[memory.read_text("utf-8")]
    environment = {**os.environ, LIBRARY_SETTING: str(library)}
    try:
        done = subprocess.run(
            [sys.executable, "-c", _TRIAL], env=environment, capture_output=True, text=True,
            timeout=60.0, check=False,
        )  # fmt: skip
    except (OSError, subprocess.TimeoutExpired) as error:
        _log.warning("%s could not be tried: %s", library, error)
        return False
    usable = done.returncode == 0 and "mean" in done.stdout
    _log.info("%s %s with Mitsuba", library, "works" if usable else "does not work")
    try:
        memory.parent.mkdir(parents=True, exist_ok=True)
        memory.write_text("works" if usable else "fails", "utf-8")
    except OSError as error:
        _log.warning("%s cannot be written, libLLVM will be tried again: %s", memory, error)
    return usable
