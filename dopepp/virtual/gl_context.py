"""An OpenGL context without a window, on hardware only.

A software renderer would do what the rasteriser does, several times slower; so one is refused.
Neither a context nor the driver behind it survives a fork, so it is made only in a process that
imported this module itself: the first one, or a worker that was spawned.

Environment variables:
    ``DOPEPP_GL_SOFTWARE``: ``1`` admits a software renderer (Mesa's llvmpipe), for tests.
"""

from __future__ import annotations

import logging
import os
from importlib import import_module
from importlib.util import find_spec
from typing import Any, Final

from dopepp.errors import UserError

_log = logging.getLogger(__name__)

SOFTWARE_SETTING: Final = "DOPEPP_GL_SOFTWARE"

_VERSION: Final = 430
"""OpenGL 4.3: the first with storage buffers, which hold lights and baked occlusion."""

_SOFTWARE: Final = ("llvmpipe", "softpipe", "swrast", "software")
"""In the names of renderers that run on the processor, in lower case."""

_MOST_DEVICES: Final = 16
"""EGL devices that are tried; a machine lists its GPUs and then Mesa's software renderer."""

_PROCESS: Final = os.getpid()


def require_moderngl() -> None:
    """Check, without importing it, that the extra is installed.

    Raises:
        UserError: It is not.
    """
    if find_spec("moderngl") is None:
        raise UserError(
            "renderer 'gl' without the package moderngl",
            "an installation with the extra gl",
            "pip install 'dopepp[gl]'",
        )


def check_process() -> None:
    """Refuse a process that was forked.

    Raises:
        UserError: This module was imported by another process, so this one is forked from it.
    """
    if os.getpid() != _PROCESS:
        raise UserError(
            f"renderer 'gl' in a process that was forked from process {_PROCESS}",
            "the first process, or workers that were spawned",
            "set data.num_workers=0, start workers with multiprocessing.get_context('spawn'), "
            "or write the images first (dopepp render spawns its workers)",
        )


def open_context(admit_software: bool | None = None) -> Any:
    """Return a ``moderngl.Context`` on the first EGL device that is hardware, and current.

    Args:
        admit_software: Take a software renderer as well; ``DOPEPP_GL_SOFTWARE`` decides if None.

    Raises:
        UserError: moderngl is not installed, the process was forked, EGL gives no context, or
            only a software renderer was found.
    """
    require_moderngl()
    check_process()
    if admit_software is None:
        admit_software = _software_admitted()
    moderngl = import_module("moderngl")
    found, failure = [], "no EGL device"
    for device in range(_MOST_DEVICES):
        try:
            context = moderngl.create_context(
                require=_VERSION, standalone=True, backend="egl", device_index=device,
                libgl="libGL.so.1", libegl="libEGL.so.1",
            )  # fmt: skip
        except Exception as error:  # glcontext raises Exception itself
            failure = str(error) or failure
            break
        name = str(context.info["GL_RENDERER"])
        if admit_software or not is_software(name):
            _log.info("OpenGL %s on %s", context.version_code, name)
            return context
        found.append(name)
        context.release()
    raise _no_hardware(found, failure)


def is_software(name: str) -> bool:
    """Tell whether a renderer, by its ``GL_RENDERER``, runs on the processor."""
    return any(word in name.lower() for word in _SOFTWARE)


def _software_admitted() -> bool:
    setting = os.environ.get(SOFTWARE_SETTING, "")
    if setting not in ("", "0", "1"):
        raise UserError(f"{SOFTWARE_SETTING}={setting!r}", "0 or 1", "change or unset it")
    return setting == "1"


def _no_hardware(found: list[str], failure: str) -> UserError:
    fix = "use renderer=raster, which needs no GPU"
    if found:
        return UserError(
            f"software renderer found for renderer 'gl': {', '.join(found)}",
            "a GPU with its EGL driver",
            f"{fix}, or install the GPU's driver",
        )
    return UserError(
        f"no OpenGL context for renderer 'gl': {failure}",
        f"a GPU whose EGL driver gives OpenGL {_VERSION // 100}.{_VERSION // 10 % 10}",
        f"{fix}, or install the GPU's driver",
    )
