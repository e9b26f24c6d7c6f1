"""The photoreal renderer: path tracing by Mitsuba 3, denoised by Intel's Open Image Denoise.

Objects stand in the light that the rasteriser gives them, but lamps have a size, light goes from
object to object, and surfaces mirror their surroundings. The picture is laid over the background
in linear light; what objects do to the light on a supporting plane is in ``table``.

The same scene gives the same bytes on the same machine, whatever the number of threads. Workers
must be spawned, or forked before the first image. ``variant`` lists the environment variables that
choose Mitsuba's variant and the number of threads.

Importing this needs the extra ``photoreal``. pyoidn's C interface is called directly: the package
itself imports torch wherever that is installed, which takes seconds and memory that rendering does
without.
"""

from __future__ import annotations

import zlib
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from runpy import run_path
from types import SimpleNamespace
from typing import Any, Final

import numpy as np
from jaxtyping import Float32

from dopepp.core.errors import require
from dopepp.drawing.pictures import Picture
from dopepp.virtual.renderers.photoreal import mitsuba, num_threads
from dopepp.virtual.renderers.photoreal.scene import bounding_sphere, make_shapes, make_surroundings
from dopepp.virtual.renderers.photoreal.table import (
    Area,
    TableTop,
    View,
    cast,
    make_view,
    pixel_rays,
    shadowed,
    split_light,
)
from dopepp.virtual.renderers.raster import visible_fractions
from dopepp.virtual.renderers.raster.visibility import Box, backdrop, box_around, project_object
from dopepp.virtual.scene import Rendered, Scene
from dopepp.virtual.sensor import CODE_STEPS, TONE_CURVE

require("mitsuba", "renderer 'photoreal'", "photoreal")
require("pyoidn", "renderer 'photoreal'", "photoreal")

SAMPLES_PER_PIXEL: Final = 16

_PATHS: Final = {"type": "path", "max_depth": 6, "hide_emitters": True}
"""Light that bounces off at most five surfaces; lamps are seen in reflections only."""

_GUIDES: Final = {"type": "aov", "aovs": "albedo:albedo,normal:sh_normal"}
"""What the denoiser is told of the surfaces; in one pass with the light it takes far longer."""

_MARGIN_PX: Final = 1
"""Around the objects' pixels: what covers a pixel's rim, and what the denoiser looks at."""

_RADIANCE_OF_CODE: Final = np.interp(
    np.arange(256), TONE_CURVE, np.arange(len(TONE_CURVE)) / CODE_STEPS
).astype(np.float32)
"""The radiance that the tone curve shows as a code of 0–255."""

_FLOAT3: Final = 3
"""``OIDN_FORMAT_FLOAT3``."""


def render(scene: Scene) -> Rendered:
    """Render a scene; one without objects is its background.

    A UserError, where Mitsuba cannot run in this process (see ``variant``).
    """
    image, depth, instances = backdrop(scene)
    fractions = visible_fractions(scene)
    window = _objects_window(scene)
    if window is None and (scene.plane is None or not scene.objects):
        return Rendered(image, depth, instances, fractions, scene)
    mi = mitsuba()
    shapes = make_shapes(mi, scene)
    if scene.plane is not None:
        _paint_on_table(mi, scene, shapes, window, depth, image)
    if window is not None:
        _label(mi, scene, shapes, window, depth, instances)
        if scene.plane is None:
            view = make_view(scene.K, window)
            film = view.resampled(_trace(mi, scene, _world(shapes), view))
            area = _slices(window)
            image[area] = _over(film[..., :3], film[..., 3], image[area])
    return Rendered(image, depth, instances, fractions, scene)


def _objects_window(scene: Scene) -> Box | None:
    """Return the part of the image that objects may touch; None if they touch none."""
    box = box_around(project_object(item, scene.K).box(scene.size) for item in scene.objects)
    if box is None:
        return None
    left, top, right, bottom = box
    return (
        max(left - _MARGIN_PX, 0), max(top - _MARGIN_PX, 0),
        min(right + _MARGIN_PX, scene.size[0]), min(bottom + _MARGIN_PX, scene.size[1]),
    )  # fmt: skip


def _label(
    mi: Any,
    scene: Scene,
    shapes: list[Any],
    window: Box,
    depth: Float32[np.ndarray, "height width"],
    instances: np.ndarray,
) -> None:
    """Write what the pixels' centres see over the plane's depth."""
    world = mi.load_dict(_world(shapes), parallel=False)
    seen, numbers = cast(mi, world, shapes, pixel_rays(scene.K, window))
    area = _slices(window)
    nearer = (numbers >= 0) & ((depth[area] == 0) | (seen < depth[area]))
    depth[area] = np.where(nearer, seen, depth[area])
    instances[area] = np.where(nearer, numbers, -1)


def _paint_on_table(
    mi: Any,
    scene: Scene,
    shapes: list[Any],
    window: Box | None,
    plane: Float32[np.ndarray, "height width"],
    image: Picture,
) -> None:
    """Paint objects and their shadows; ``plane`` is the plane's depth."""
    table = TableTop(scene, plane)
    window = table.window(window)
    if window is None:
        return
    area, view = _slices(window), make_view(scene.K, window)
    film = _trace(mi, scene, {**_world(shapes), "table": table.shape(mi)}, view)
    # Whether light comes from an object or from the table is a second, cheap picture: the fourth
    # channel of any integrator is the share of rays that hit something.
    depth = {"type": "depth"}
    hit = _picture(mi, _world(shapes), view, depth, SAMPLES_PER_PIXEL, _seed(scene))
    film[..., 3] = hit[..., 3]
    film = view.resampled(film)
    alpha = np.clip(film[..., 3], 0.0, 1.0)
    light, kept = split_light(film[..., :3], alpha, table.unshadowed(area))
    image[area] = shadowed(image[area], table.faded(kept, area))
    image[area] = _over(light, alpha, image[area])


def _world(shapes: list[Any]) -> dict[str, Any]:
    return {"type": "scene"} | {f"object{number}": shape for number, shape in enumerate(shapes)}


def _trace(
    mi: Any, scene: Scene, world: dict[str, Any], view: View
) -> Float32[np.ndarray, "height width 4"]:
    """Return the light that reaches the view's pixels, denoised, and their coverage."""
    surroundings = make_surroundings(mi, scene, bounding_sphere(scene))
    lit = {**world, **surroundings}
    film = _picture(mi, lit, view, _PATHS, SAMPLES_PER_PIXEL, _seed(scene))
    # Four samples a pixel, as it is far less noisy than light.
    guides = _picture(mi, world, view, _GUIDES, 4, _seed(scene))
    film[..., :3] = denoise(film[..., :3], guides[..., :3], guides[..., 3:6])
    return film


def _picture(
    mi: Any, world: dict[str, Any], view: View, integrator: dict[str, Any], samples: int, seed: int
) -> Float32[np.ndarray, "height width channels"]:
    """Return what an integrator measures in every pixel of a view."""
    # Loaded in parallel, objects come in random order, and every order is compiled anew.
    loaded = mi.load_dict(
        {**world, "sensor": view.sensor(mi, samples), "integrator": integrator}, parallel=False
    )
    return np.array(mi.render(loaded, seed=seed), np.float32)


def _seed(scene: Scene) -> int:
    """Return a seed that is the scene's own, so that no two images share their noise."""
    poses = b"".join(np.asarray(item.T_cam_obj, np.float64).tobytes() for item in scene.objects)
    return zlib.crc32(poses + scene.sensor.noise_seed.to_bytes(16, "little", signed=True))


def _over(
    light: Float32[np.ndarray, "height width 3"],
    alpha: Float32[np.ndarray, "height width"],
    behind: Picture,
) -> Picture:
    """Lay light that covers a share of each pixel over a picture, in linear light."""
    alpha = np.clip(alpha, 0.0, 1.0)[..., None]
    total = light + (1 - alpha) * _RADIANCE_OF_CODE[behind]
    steps = np.minimum(total * CODE_STEPS + 0.5, len(TONE_CURVE) - 1).astype(np.int32)
    return np.where(alpha > 0, (TONE_CURVE[steps] + 0.5).astype(np.uint8), behind)


def _slices(window: Box) -> Area:
    left, top, right, bottom = window
    return slice(top, bottom), slice(left, right)


def denoise(
    colour: Float32[np.ndarray, "height width 3"],
    albedo: Float32[np.ndarray, "height width 3"],
    normal: Float32[np.ndarray, "height width 3"],
) -> Float32[np.ndarray, "height width 3"]:
    """Return a picture in linear light without its noise; a RuntimeError where the library fails.

    ``albedo`` is the share of light that the surface scatters, in [0, 1]; ``normal`` a unit vector
    in any frame, 0 on the background.
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
    origin = getattr(find_spec("pyoidn"), "origin", "")
    interface = SimpleNamespace(**run_path(str(Path(origin).with_name("capi.py"))))
    library = interface.oidn_Capi
    device = library.oidnNewDevice(1)  # OIDN_DEVICE_TYPE_CPU
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
