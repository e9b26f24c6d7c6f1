"""Denoising of path-traced pictures by Intel's Open Image Denoise, as pyoidn packs it.

The library's C interface is called directly: the package itself imports torch wherever that is
installed, which takes seconds and memory that rendering does without.
"""

from __future__ import annotations

from functools import cache
from importlib.util import find_spec, module_from_spec, spec_from_file_location
from pathlib import Path
from typing import Any, Final

import numpy as np
from jaxtyping import Float32

from dopepp.virtual.photoreal_variant import num_threads, require

_CPU_DEVICE: Final = 1
_FLOAT3: Final = 3
"""Values of ``OIDN_DEVICE_TYPE_CPU`` and ``OIDN_FORMAT_FLOAT3``."""


def denoise(
    colour: Float32[np.ndarray, "height width 3"],
    albedo: Float32[np.ndarray, "height width 3"],
    normal: Float32[np.ndarray, "height width 3"],
) -> Float32[np.ndarray, "height width 3"]:
    """Return a picture in linear light without its noise.

    Args:
        colour: Noisy radiance, any range.
        albedo: Share of light that the surface scatters, [0, 1].
        normal: Unit normal, any frame; 0 on the background.

    Raises:
        RuntimeError: The library reports an error.
        UserError: pyoidn is not installed.
    """
    interface, device = _device()
    ffi, library = interface.oidn_ffi, interface.oidn_Capi
    height, width = colour.shape[:2]
    output = np.empty((height, width, 3), np.float32)
    images = {"color": colour, "albedo": albedo, "normal": normal, "output": output}
    held = {name: np.ascontiguousarray(image, np.float32) for name, image in images.items()}
    image_filter = library.oidnNewFilter(device, b"RT")
    for name, image in held.items():
        pointer = ffi.cast("void *", ffi.from_buffer(image))
        library.oidnSetSharedFilterImage(
            image_filter, name.encode(), pointer, _FLOAT3, width, height, 0, 0, 0
        )
    library.oidnSetFilterBool(image_filter, b"hdr", True)
    library.oidnCommitFilter(image_filter)
    library.oidnExecuteFilter(image_filter)
    library.oidnReleaseFilter(image_filter)
    _check(interface, device)
    return held["output"]


@cache
def _device() -> tuple[Any, Any]:
    """Return pyoidn's C interface and a device, made once a process."""
    require("pyoidn")
    package = find_spec("pyoidn")
    assert package is not None
    assert package.origin is not None
    spec = spec_from_file_location("pyoidn_capi", Path(package.origin).with_name("capi.py"))
    assert spec is not None
    assert spec.loader is not None
    interface = module_from_spec(spec)
    spec.loader.exec_module(interface)
    library = interface.oidn_Capi
    device = library.oidnNewDevice(_CPU_DEVICE)
    library.oidnSetDeviceInt(device, b"numThreads", num_threads())
    # Pinned threads of several workers would share cores while others idle.
    library.oidnSetDeviceBool(device, b"setAffinity", False)
    library.oidnCommitDevice(device)
    _check(interface, device)
    return interface, device


def _check(interface: Any, device: Any) -> None:
    message = interface.oidn_ffi.new("const char **")
    if interface.oidn_Capi.oidnGetDeviceError(device, message):
        text = interface.oidn_ffi.string(message[0]).decode(errors="replace")
        raise RuntimeError(f"Open Image Denoise: {text}")
