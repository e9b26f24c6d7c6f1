"""The photoreal renderer: path tracing by Mitsuba 3, denoised by Intel's Open Image Denoise.

Lights match the rasteriser's, but lamps have a size, objects light each other, and surfaces mirror
their surroundings. The traced image is composited over the background in linear light.

A matt disc represents the supporting plane, whose image is the background. The disc's radiance,
divided by its radiance without objects, multiplies the background (shadows, reflected light).

A scene renders to the same bytes on the same machine for any number of threads. Workers must be
spawned, or forked before the first image. The module needs the extra ``photoreal``, and calls
pyoidn's C interface directly, because the pyoidn package imports torch if installed.
"""

from __future__ import annotations

import zlib
from functools import cache
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path
from runpy import run_path
from types import SimpleNamespace
from typing import Any, Final

import cv2
import numpy as np
from jaxtyping import Float, Float32

from dopepp.core.errors import require
from dopepp.drawing.pictures import RGBImage
from dopepp.geometry.rotation import Vector
from dopepp.virtual.renderers.photoreal import mitsuba, num_threads, usable_variant
from dopepp.virtual.renderers.photoreal.mitsuba_scene import (
    Film,
    bounding_sphere,
    cast,
    make_film,
    make_shapes,
    make_surroundings,
    pixel_rays,
    rgb,
)
from dopepp.virtual.renderers.raster import visible_fractions
from dopepp.virtual.renderers.raster.visibility import Box, backdrop, box_around, project_object
from dopepp.virtual.scene import Rendered, Scene
from dopepp.virtual.sensor import CODE_STEPS, LINEAR_TO_SRGB, SRGB_TO_LINEAR, TONE_CURVE

require("mitsuba", "renderer 'photoreal'", "photoreal")
require("pyoidn", "renderer 'photoreal'", "photoreal")

Area = tuple[slice, slice]
Colours = Float[np.ndarray, "height width 3"]
Depth = Float32[np.ndarray, "height width"]

SAMPLES_PER_PIXEL: Final = 16

_PATHS: Final = {"type": "path", "max_depth": 6, "hide_emitters": True}
"""At most five bounces; lamps are visible in reflections only."""

_GUIDES: Final = {"type": "aov", "aovs": "albedo:albedo,normal:sh_normal"}
"""Surface features for the denoiser; rendering them in a separate pass is far faster."""

_MARGIN_PX: Final = 1  # margin around the objects, for partly covered pixels and the denoiser

_RADIANCE_OF_CODE: Final = np.interp(
    np.arange(256), TONE_CURVE, np.arange(len(TONE_CURVE)) / CODE_STEPS
).astype(np.float32)
"""Radiance of every code 0–255 under the tone curve."""

_ALBEDO: Final = (0.05, 0.8)  # bounds of the disc's albedo, estimated from its image and light
_MIN_LIGHT: Final = 1e-3  # radiance of a white table below which shadows are not estimated
_SPREAD_PX: Final = 2.0  # Gaussian width by which a shadow is extrapolated under an object's rim
_FLOAT3: Final = 3  # OIDN_FORMAT_FLOAT3


def render(scene: Scene) -> Rendered:
    """Render a scene; without objects, return its background.

    Raises:
        UserError: Mitsuba cannot run in this process (see the docstring of this package).
    """
    image, depth, instances = backdrop(scene)
    fractions = visible_fractions(scene)
    window = _objects_window(scene)
    if window is not None or (scene.plane is not None and scene.objects):
        tracer = Tracer(scene)
        if scene.plane is not None:
            tracer.paint_on_table(window, depth, image)
        if window is not None:
            area = _slices(window)
            distance, numbers = tracer.cast(window)
            nearer = (numbers >= 0) & ((depth[area] == 0) | (distance < depth[area]))
            depth[area] = np.where(nearer, distance, depth[area])
            instances[area] = np.where(nearer, numbers, -1)
            if scene.plane is None:
                film = make_film(scene.K, window)
                traced = film.resampled(tracer.trace(tracer.world, film))
                image[area] = _composite(traced[..., :3], traced[..., 3], image[area])
    return Rendered(image, depth, instances, fractions, scene)


def identity() -> str:
    """Return the versions of Mitsuba, with its variant, and of Open Image Denoise's package.

    Mitsuba is not started, because its threads would not survive the fork of a loader's workers.

    Raises:
        UserError: Mitsuba is not installed, or an environment variable is invalid.
    """
    return f"mitsuba {version('mitsuba')} {usable_variant()} pyoidn {version('pyoidn')}"


def _objects_window(scene: Scene) -> Box | None:
    """Return the box of pixels, with a margin, that objects may touch; None if out of view."""
    box = box_around(project_object(item, scene.K).box(scene.size) for item in scene.objects)
    if box is None:
        return None
    left, top = (max(start - _MARGIN_PX, 0) for start in box[:2])
    right, bottom = (min(*ends) for ends in zip((box[2] + 1, box[3] + 1), scene.size, strict=True))
    return left, top, right, bottom


class Tracer:
    """Path tracing of a scene by Mitsuba.

    Attributes:
        world: Mitsuba's description of the objects.
    """

    def __init__(self, scene: Scene) -> None:
        self._scene, self._mi = scene, mitsuba()
        self._shapes = make_shapes(self._mi, scene)
        objects = {f"object{number}": shape for number, shape in enumerate(self._shapes)}
        self.world: dict[str, Any] = {"type": "scene"} | objects
        # A seed from the scene, so that no two images share their noise.
        poses = b"".join(np.asarray(item.T_cam_obj, np.float64).tobytes() for item in scene.objects)
        noise_seed = scene.sensor.noise_seed.to_bytes(16, "little", signed=True)
        self._seed = zlib.crc32(poses + noise_seed)

    def cast(self, window: Box) -> tuple[Depth, np.ndarray]:
        """Return depth, metres, and object index at a window's pixel centres; see :func:`cast`."""
        world = self._mi.load_dict(self.world, parallel=False)
        return cast(self._mi, world, self._shapes, pixel_rays(self._scene.K, window))

    def trace(
        self, world: dict[str, Any], film: Film
    ) -> Float32[np.ndarray, "film_height film_width 4"]:
        """Render the scene by path tracing, and denoise it.

        Lights are added to ``world``, Mitsuba's description of the objects. The result is, per
        pixel, the linear radiance (RGB) and the share that objects cover.
        """
        lit = {**world, **make_surroundings(self._mi, self._scene)}
        traced = self._measure(lit, film, _PATHS, SAMPLES_PER_PIXEL)
        # Four samples per pixel suffice: surface features are far less noisy than light.
        guides = self._measure(world, film, _GUIDES, 4)
        traced[..., :3] = denoise(traced[..., :3], guides[..., :3], guides[..., 3:6])
        return traced

    def paint_on_table(self, window: Box | None, plane: Depth, image: RGBImage) -> None:
        """Paint objects and shadows onto ``image``; ``plane`` is the plane's depth, metres."""
        table = TableTop(self._scene, plane)
        window = table.window(window)
        if window is None:
            return
        area, film = _slices(window), make_film(self._scene.K, window)
        traced = self.trace({**self.world, "table": table.shape(self._mi)}, film)
        # A second, cheap pass without the table measures the objects' coverage: the fourth channel
        # of any integrator is the share of rays that hit something.
        hit = self._measure(self.world, film, {"type": "depth"}, SAMPLES_PER_PIXEL)
        traced[..., 3] = hit[..., 3]
        traced = film.resampled(traced)
        alpha = np.clip(traced[..., 3], 0.0, 1.0)
        light, light_share = split_light(traced[..., :3], alpha, table.unshadowed(area))
        image[area] = darken(image[area], table.fade(light_share, area))
        image[area] = _composite(light, alpha, image[area])

    def _measure(
        self, world: dict[str, Any], film: Film, integrator: dict[str, Any], samples: int
    ) -> Float32[np.ndarray, "film_height film_width channels"]:
        """Return the channels that a Mitsuba integrator computes for every pixel of a film."""
        whole = {**world, "sensor": film.sensor(self._mi, samples), "integrator": integrator}
        # Parallel loading would order objects randomly and recompile for every order.
        loaded = self._mi.load_dict(whole, parallel=False)
        return np.array(self._mi.render(loaded, seed=self._seed), np.float32)


def _composite(light: Colours, alpha: Depth, behind: RGBImage) -> RGBImage:
    """Composite linear radiance over an image; ``alpha`` is the share that objects cover."""
    alpha = np.clip(alpha, 0.0, 1.0)[..., None]
    total = light + (1 - alpha) * _RADIANCE_OF_CODE[behind]
    steps = np.minimum(total * CODE_STEPS + 0.5, len(TONE_CURVE) - 1).astype(np.int32)
    return np.where(alpha > 0, (TONE_CURVE[steps] + 0.5).astype(np.uint8), behind)


def _slices(window: Box) -> Area:
    left, top, right, bottom = window
    return slice(top, bottom), slice(left, right)


class TableTop:
    """The disc that represents a scene's plane.

    ``depth`` is the plane's depth at pixel centres, metres; 0 where it is not visible.
    """

    def __init__(self, scene: Scene, depth: Depth) -> None:
        assert scene.plane is not None
        self._scene, self._normal = scene, np.array(scene.plane.normal, np.float64)
        middle, radius = bounding_sphere(scene)
        self.centre = middle - (self._normal @ middle - scene.plane.offset) * self._normal
        self.radius = 6 * radius
        self._points = pixel_rays(scene.K, (0, 0, *scene.size)) * depth[..., None]
        away = np.linalg.norm(self._points - self.centre, axis=-1) / self.radius
        self._away = np.where(depth > 0, away, np.inf)
        self._light = np.where((self._away < 1)[..., None], self._full_light(), 0.0)
        self.albedo = self._estimated_albedo()

    def window(self, objects: Box | None) -> Box | None:
        """Return the box of pixels that show the plane's disc or lie in ``objects``, or None."""
        shown = self._away < 1
        if objects is not None:
            shown[_slices(objects)] = True
        rows, columns = np.flatnonzero(shown.any(axis=1)), np.flatnonzero(shown.any(axis=0))
        if not len(rows):
            return None
        return int(columns[0]), int(rows[0]), int(columns[-1]) + 1, int(rows[-1]) + 1

    def shape(self, mi: Any) -> dict[str, Any]:
        """Return Mitsuba's description of the disc that represents the plane."""
        up = np.eye(3)[np.abs(self._normal).argmin()]
        target = list(self.centre + self._normal)
        to_world = mi.ScalarTransform4f().look_at(list(self.centre), target, list(up))
        bsdf = {"type": "diffuse", "reflectance": rgb(self.albedo)}
        return {"type": "disk", "to_world": to_world.scale(self.radius), "bsdf": bsdf}

    def unshadowed(self, area: Area) -> Colours:
        """Return the radiance of an image area without objects, linear RGB; 0 outside the disc."""
        return np.asarray(self.albedo * self._light[area])

    def fade(self, light_share: Colours, area: Area) -> Colours:
        """Return the shares of light, faded to 1 from 60 % of the disc's radius to its rim."""
        share = np.clip((1 - self._away[area]) / (1 - 0.6), 0.0, 1.0)[..., None]
        # Smoothstep: no visible line at either end of the fading.
        return 1 + (light_share - 1) * share * share * (3 - 2 * share)

    def _full_light(self) -> Colours:
        """Return the linear radiance of a white plane without objects, in closed form."""
        sky = self._scene.ambient.light_on(self._normal)
        light = np.broadcast_to(sky, self._points.shape).copy()
        for lamp in self._scene.lights:
            towards = np.array(lamp.position) - self._points
            distance = np.maximum(np.linalg.norm(towards, axis=-1), 1e-9)
            facing = np.maximum(towards @ self._normal / distance, 0.0)
            strength = facing * (lamp.reach / distance) ** 2
            light += strength[..., None] * np.array(lamp.intensity)
        return light

    def _estimated_albedo(self) -> Vector:
        """Return the linear albedo at which the disc is as bright as the background, clipped."""
        disc = self._away < 1
        if not disc.any():
            return np.full(3, np.mean(_ALBEDO))
        shown = SRGB_TO_LINEAR[self._scene.background[disc]].mean(axis=0)
        light = np.maximum(self._light[disc].mean(axis=0), _MIN_LIGHT)
        return np.asarray(np.clip(shown / light, *_ALBEDO))


def split_light(light: Colours, alpha: Depth, unshadowed: Colours) -> tuple[Colours, Colours]:
    """Split radiance into the objects' radiance and the share of light that reaches the plane.

    ``alpha`` is the share of a pixel that objects cover. ``unshadowed`` is the radiance, without
    objects, of the disc that represents the supporting plane; 0 outside the disc.
    """
    is_disc = (alpha <= 0) & (unshadowed.min(axis=-1) > _MIN_LIGHT)
    light_share = np.where(is_disc[..., None], light / np.maximum(unshadowed, _MIN_LIGHT), 1.0)
    light_share = np.clip(light_share, 0.0, 4.0)  # above 1: objects reflect light onto a dark table
    # Pixels on an object's rim mix object and disc, so the shadow beside them is extrapolated.
    weight = cv2.GaussianBlur(is_disc.astype(np.float64), (0, 0), _SPREAD_PX)[..., None]
    spread = cv2.GaussianBlur(np.where(is_disc[..., None], light_share, 0.0), (0, 0), _SPREAD_PX)
    carried = np.where(weight > 1e-3, spread / np.maximum(weight, 1e-3), 1.0)
    light_share = np.where(is_disc[..., None], light_share, carried)
    objects = light - (1 - alpha[..., None]) * unshadowed * light_share
    return np.where(alpha[..., None] > 0, np.maximum(objects, 0), 0).astype(np.float32), light_share


def darken(image: RGBImage, light_share: Colours) -> RGBImage:
    """Return an image with its linear light multiplied by ``light_share``."""
    steps = np.minimum(SRGB_TO_LINEAR[image] * light_share * CODE_STEPS + 0.5, CODE_STEPS)
    changed = (LINEAR_TO_SRGB[steps.astype(np.int32)] + 0.5).astype(np.uint8)
    return np.where(light_share == 1.0, image, changed)


def denoise(colour: Colours, albedo: Colours, normal: Colours) -> Colours:
    """Denoise an image in linear light.

    The guides are ``albedo``, the share of light that the surface scatters, and ``normal``, unit
    vectors in any frame, 0 on the background. All images are float32.

    Raises:
        RuntimeError: The library fails.
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
    """Return pyoidn's C interface and a device, created once per process."""
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
    """Raise the error that Open Image Denoise has recorded, if any."""
    message = interface.oidn_ffi.new("const char **")
    if interface.oidn_Capi.oidnGetDeviceError(device, message):
        text = interface.oidn_ffi.string(message[0]).decode(errors="replace")
        raise RuntimeError(f"Open Image Denoise: {text}")
