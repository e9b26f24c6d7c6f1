"""The factory: renders image ``(epoch, index)`` of an unlimited, reproducible sequence.

``scale`` renders the same scene from closer or farther away (paper Fig. 11). The camera moves along
the ray to the middle of the targets and keeps its orientation and lens. Objects, lamps and the
plane do not move; ambient light and the background of floating objects are infinitely far away.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Final

import numpy as np
from numpy.random import Generator

from dopepp.core.errors import UserError, require
from dopepp.geometry.camera import Transform, make_transform, orbited_camera, transform
from dopepp.geometry.cuboid import CENTROID
from dopepp.geometry.rotation import Vector
from dopepp.parts.catalogue import BUILTIN
from dopepp.parts.part import Part
from dopepp.virtual.arrangement import Composition, arrange_floating
from dopepp.virtual.backgrounds import Backgrounds, ProceduralBackgrounds
from dopepp.virtual.backgrounds.procedural import ClutteredBackgrounds
from dopepp.virtual.body import make_body
from dopepp.virtual.heap import arrange_heap
from dopepp.virtual.presets import Preset
from dopepp.virtual.presets.table import plane_of
from dopepp.virtual.renderers import find_renderer
from dopepp.virtual.scene import NEAR, Rendered, Scene, SceneObject, triple
from dopepp.virtual.sensor import capture
from dopepp.virtual.tabletop import arrange_on_table

BESIDE_DEG: Final = (20.0, 40.0)  # angle between the preset's and a further camera of a scene

_PACKAGE: Final = Path(__file__).parents[1]
# The code that decides pixels and labels, including the decoding of background photos.
_CODE: Final = ("virtual/**/*.py", "parts/**/*.py", "geometry/**/*.py", "drawing/pictures.py")


class Factory:
    """Renders labelled images of parts; image (epoch, index) depends only on the arguments.

    A factory can be pickled and forked: it holds no generator, so any process renders the same
    bytes for the same (seed, epoch, index), in any order.

    Args:
        parts: Targets, with distinct names.
        preset: Distribution of the scenes.
        seed: Seed of all images.
        backgrounds: Source of background images (default: procedural textures).
        renderer: Name of a renderer (:mod:`dopepp.virtual.renderers`).
        negatives: Parts to show among the distractors, so that a network learns to reject them;
            built-in parts that are not targets are always added.

    Raises:
        UserError: There is no part, a part has no mesh, two parts share a name, a negative has the
            name or mesh of a target, or the seed is negative.
    """

    def __init__(
        self,
        parts: Sequence[Part],
        preset: Preset,
        seed: int,
        backgrounds: Backgrounds | None = None,
        renderer: str = "raster",
        negatives: Sequence[Part] = (),
    ) -> None:
        names = [part.name for part in parts]
        if not parts or len(set(names)) != len(names):
            allowed = "at least one part, each with its own name"
            fix = "pass at least one part, and write NAME=FILE for parts that would share a name"
            raise UserError(f"parts {names} to render", allowed, fix)
        if seed < 0:
            raise UserError(f"seed {seed}", "an integer >= 0", "set a seed such as 0")
        self.parts, self.preset, self.seed = tuple(parts), preset, seed
        self.negatives = _collect_negatives(parts, negatives)
        self.backgrounds = ProceduralBackgrounds() if backgrounds is None else backgrounds
        self.renderer, self._render = renderer, find_renderer(renderer)
        self._targets = [make_body(part, is_target=True) for part in parts]
        self._others = [make_body(part, is_target=False) for part in self.negatives]
        if preset.table is not None and preset.table.pile is not None:
            require("mujoco", "table.pile (preset heap)", "robot")
            for body in self._targets:
                body.pieces  # noqa: B018 (cached for all processes: a new mesh takes a minute)

    def render(self, epoch: int, index: int, scale: float = 1.0, view: int = 0) -> Rendered:
        """Render an image with its ground truth, including the sensor's effects.

        The targets are magnified by ``scale``. Camera ``view`` 0 of the static scene is the
        preset's; others are turned by :data:`BESIDE_DEG` about the middle of the targets and stay
        above the table.

        Raises:
            UserError: The preset cannot show the part, or the camera would be below the table.
        """
        scene = self.scene(epoch, index, scale)
        if view:
            sensor = replace(scene.sensor, noise_seed=scene.sensor.noise_seed + view)
            rng = np.random.default_rng([self.seed, epoch, index, view])
            seen = scene.seen_from(_draw_camera(scene, rng))
            scene = replace(seen, objects=_in_front(seen.objects), sensor=sensor)
        rendered = self._render(scene)
        return replace(rendered, image=capture(rendered.image, rendered.scene.sensor))

    def scene(self, epoch: int, index: int, scale: float = 1.0) -> Scene:
        """Return the scene of an image without rendering it; arguments as in :meth:`render`.

        Raises:
            UserError: No target fits into a scene, or the camera is below the parts at this scale.
        """
        preset, backgrounds = self.preset, self.backgrounds
        rng = np.random.default_rng([self.seed, epoch, index])
        if any(preset.clutter) or preset.background_contrast != (1.0, 1.0):
            contrast = preset.background_contrast
            backgrounds = ClutteredBackgrounds(backgrounds, preset.clutter, contrast)
        pile = None if preset.table is None else preset.table.pile
        # Several images show a heap from several sides.
        drawing = rng if pile is None else np.random.default_rng([self.seed, pile.number(index), 1])
        order = drawing.permutation(len(self._targets))
        low, high = preset.targets_per_image
        count = int(drawing.integers(low, high + 1))
        if pile is not None and drawing.random() >= pile.mixed_share:
            order = order[:1]
        targets = [self._targets[order[number % len(order)]] for number in range(count)]
        composition = Composition(preset, rng, self._others)
        K, size, plane = composition.K, composition.size, None
        if preset.table is None:
            # An image without targets has its distractors where a target's would be.
            depth = arrange_floating(composition, targets, self._targets[order[0]])
            shift = approach(composition.objects, scale)
            lights, ambient = preset.lighting.draw(rng, np.array([0.0, 0.0, depth]))
            background = backgrounds.draw(rng, *size)
        else:
            if pile is None:
                T_cam_table = arrange_on_table(composition, preset.table, targets)
            else:
                T_cam_table = arrange_heap(composition, preset.table, pile, targets, drawing)
            shift = approach(composition.objects, scale)
            lights, ambient = preset.lighting.draw(rng, T_cam_table[:3, 3], T_cam_table[:3, 2])
            table_image = preset.table.draw_image(rng, backgrounds, K, size, T_cam_table)
            table_image = replace(table_image, end=table_image.end + float(shift[2]))
            T_cam_table = _shift(T_cam_table, shift)
            plane = plane_of(T_cam_table)
            if plane.offset >= 0:
                problem = f"scale {scale:g} of a scene whose parts reach higher than the camera"
                allowed = "a scale at which the camera is above the table"
                raise UserError(problem, allowed, "set a larger scale")
            background = table_image.project(K, size, T_cam_table)
        if targets and not any(item.is_target for item in composition.objects):
            part = targets[0].part
            assert part is not None
            raise UserError(
                f"part {part.name} of diameter {part.diameter:.3g} m, which fitted into no "
                f"scene of preset {preset.name}",
                "a part that the preset's distances and field of view can show",
                "set the unit of the mesh file, or the preset's distances or field of view",
            )
        placed = composition.objects
        objects = [replace(item, T_cam_obj=_shift(item.T_cam_obj, shift)) for item in placed]
        # ``reach`` stays, so the lamps light the scene as before.
        lights = tuple(replace(light, position=triple(light.position + shift)) for light in lights)
        sensor = preset.sensors.draw(rng)
        return Scene(K, background, _in_front(objects), lights, ambient, plane, sensor)


def approach(objects: Sequence[SceneObject], scale: float) -> Vector:
    """Return the shift of the world that magnifies the targets, in metres in the camera frame.

    The shift divides the distance of the targets' mean centre from the camera by ``scale``. It is
    zero without targets.
    """
    middle = _middle(objects)
    return np.zeros(3) if middle is None or scale == 1 else np.asarray((1 / scale - 1) * middle)


def _draw_camera(scene: Scene, rng: Generator) -> Transform:
    """Sample T_new_cam of a further camera, turned by :data:`BESIDE_DEG` about the targets."""
    angle, first = np.radians(rng.uniform(*BESIDE_DEG)), rng.uniform(0.0, 2 * np.pi)
    middle = _middle(scene.objects)
    point = np.array([0.0, 0.0, 1.0]) if middle is None else middle
    cameras = [orbited_camera(point, angle, first + turn) for turn in np.pi / 4 * np.arange(8)]
    if scene.plane is None:
        return cameras[0]
    normal, offset = np.array(scene.plane.normal), scene.plane.offset
    # The camera's centre is −Rᵀt in the preset's camera.
    heights = [-float(normal @ (T[:3, :3].T @ T[:3, 3])) - offset for T in cameras]
    high = [T for T, height in zip(cameras, heights, strict=True) if height > -offset / 2]
    return high[0] if high else cameras[int(np.argmax(heights))]


def _middle(objects: Sequence[SceneObject]) -> Vector | None:
    """Return the targets' mean cuboid centre (camera frame, metres), or None without targets."""
    pairs = [(item.T_cam_obj, item.part) for item in objects if item.part is not None]
    centres = [transform(T_cam_obj, part.cuboid[CENTROID]) for T_cam_obj, part in pairs]
    return np.mean(centres, axis=0) if centres else None


def _in_front(objects: Sequence[SceneObject]) -> tuple[SceneObject, ...]:
    """Return the objects that lie entirely beyond ``NEAR`` in front of the camera."""
    hulls = (transform(item.T_cam_obj, item.surface.hull) for item in objects)
    return tuple(item for item, hull in zip(objects, hulls, strict=True) if hull[:, 2].min() > NEAR)


def _shift(T_cam: Transform, shift: Vector) -> Transform:
    """Return a pose shifted by a vector in the camera frame, metres."""
    return make_transform(T_cam[:3, :3], T_cam[:3, 3] + shift)


@cache
def code_hash() -> str:
    """Return a SHA-256 of the rendering code; a cache of renders from other code is not reused."""
    digest = hashlib.sha256()
    for pattern in _CODE:
        for path in sorted(_PACKAGE.glob(pattern)):
            digest.update(f"{path.relative_to(_PACKAGE).as_posix()}\n".encode() + path.read_bytes())
    return digest.hexdigest()


def _collect_negatives(parts: Sequence[Part], given: Sequence[Part]) -> tuple[Part, ...]:
    """Return ``given`` and the built-in parts whose names and meshes are not in either argument."""
    names, hashes = {part.name for part in parts}, {part.mesh_hash for part in parts}
    for part in given:
        if part.name in names or part.mesh_hash in hashes:
            raise UserError(
                f"negative {part.name}, which is one of the targets {', '.join(sorted(names))}",
                "parts that share neither name nor mesh with a target",
                f"leave {part.name} out of the negatives",
            )
    names |= {part.name for part in given}
    hashes |= {part.mesh_hash for part in given}
    built_in = (make() for make in BUILTIN.values())
    others = (part for part in built_in if part.name not in names)
    return (*given, *(part for part in others if part.mesh_hash not in hashes))
