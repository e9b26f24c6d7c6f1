"""The bench of a grasp trial: the solids on it, and the camera's image of them.

To add a layout, write a method of :class:`Layout` and add its name to :data:`LAYOUTS`.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache, partial
from typing import Any, Final, NamedTuple

import mujoco
import numpy as np
from numpy.random import Generator
from scipy.spatial.transform import Rotation

from dopepp.core.errors import UserError
from dopepp.drawing.pictures import RGBImage
from dopepp.geometry.camera import Transform, invert_transform, make_transform, transform
from dopepp.geometry.rotation import matrix_to_quaternion
from dopepp.parts.part import Part
from dopepp.robot.grasping.cell import CAMERA, JOINTS, TRAY, Cell
from dopepp.robot.grasping.rehearsal import SIZE, TRUE_K
from dopepp.virtual.backgrounds import ProceduralBackgrounds
from dopepp.virtual.body import Body, distractor_shapes, make_body
from dopepp.virtual.physics import settle
from dopepp.virtual.presets import PRESETS
from dopepp.virtual.presets.table import Table, plane_of
from dopepp.virtual.renderers import find_renderer
from dopepp.virtual.scene import Scene, SceneObject
from dopepp.virtual.sensor import capture

LAYOUTS: Final = ("single", "distractors", "heap")  # methods of `Layout`
SPREAD: Final = 0.025  # radius of the circle in which a part's centre is sampled, metres
DROP_HEIGHT: Final = 0.0005  # initial height of objects above the bench, metres
HEAP: Final = (3, 5)  # minimum and maximum number of parts in a heap
HEAP_SPREAD: Final = 0.05  # radius within which parts of a heap fall, metres
HEAP_TRIALS: Final = 8  # number of heaps that are dropped until one comes to rest
HEAP_TILT: Final = 15.0  # largest initial tilt of a falling part, degrees
DISTRACTORS: Final = (2, 4)  # smallest and largest number of distractors
DISTRACTOR_RADIUS: Final = (0.012, 0.025)  # range of a distractor's radius, metres
DISTRACTOR_AREA: Final = 0.11  # radius within which distractors are placed, metres
RENDERERS: Final = ("raster", "raster-shadows", "mujoco")  # training was with `raster`
STYLE: Final = PRESETS["wide"]  # preset of the released networks: light, materials, camera errors
UPRIGHT: Final = np.radians([90.0, -90.0, 0.0, -90.0, 0.0, 0.0])  # joints of an arm out of view

Photographer = Callable[[Transform, Generator], RGBImage]
"""Renders the objects at rest for a camera at T_base_cam, with sampled sensor noise and blur."""

_log = logging.getLogger(__name__)


class PlacedBody(NamedTuple):
    """An object on the bench and its pose before the simulation starts."""

    body: Body
    T_base_obj: Transform


class Layout:
    """Sampler of random arrangements of objects on the bench.

    Args:
        part: The part to grasp.
        name: One of :data:`LAYOUTS`.
        yaw_deg: Largest yaw to either side. At 0, a part's x axis points to the camera's right.
        rest: ``front`` lays the part's +z axis upwards; ``any`` selects a random resting face.
    """

    def __init__(self, part: Part, name: str, yaw_deg: float, rest: str) -> None:
        self._name = name
        self.part, self.body = part, make_body(part, is_target=True)
        self._yaw, self._rest = np.radians(yaw_deg), rest

    def draw(self, rng: Generator) -> list[PlacedBody]:
        """Sample the objects of this layout and their poses; the parts come first."""
        return list(getattr(self, self._name)(rng))

    def draw_pose(self, rng: Generator) -> Transform:
        """Sample the pose T_base_obj of a single part in the tray."""
        return self._draw_part(rng, SPREAD, DROP_HEIGHT, 0.0).T_base_obj

    def _draw_part(
        self, rng: Generator, spread: float, height: float, tilt_deg: float
    ) -> PlacedBody:
        """Sample a part's pose ≤ ``spread`` from the tray's centre, ``height`` over it, metres."""
        up = np.array([0.0, 0.0, 1.0])
        if self._rest == "any":
            normals, shares = self.body.hull.rests
            up = -normals[rng.choice(len(shares), p=shares)]
        upright = Rotation.align_vectors([[0.0, 0.0, 1.0]], [up])[0]
        yaw, azimuth = rng.uniform(-self._yaw, self._yaw), rng.uniform(0, 2 * np.pi)
        tilt = np.radians(rng.uniform(0, tilt_deg)) * np.array([np.cos(azimuth), np.sin(azimuth)])
        turn = Rotation.from_rotvec([*tilt, 0.0]) * Rotation.from_rotvec([0.0, 0.0, yaw])
        rotation = (turn * upright).as_matrix()
        lowest = float((self.body.hull.vertices @ rotation[2]).min())
        centre = rotation @ self.part.cuboid[-1]
        offset = np.array([*_draw_in_disc(rng, spread), height - lowest])
        position = TRAY + offset - [*centre[:2], 0.0]
        return PlacedBody(self.body, make_transform(rotation, position))

    def single(self, rng: Generator) -> list[PlacedBody]:
        """Sample the pose of a single part."""
        return [self._draw_part(rng, SPREAD, DROP_HEIGHT, 0.0)]

    def distractors(self, rng: Generator) -> list[PlacedBody]:
        """Sample a part and 2 to 4 distractors whose bounding circles do not overlap."""
        solids = self.single(rng)
        centre = transform(solids[0].T_base_obj, self.part.cuboid[-1])
        occupied = [(centre, self.part.diameter / 2)]
        shapes = distractor_shapes()
        for _ in range(int(rng.integers(DISTRACTORS[0], DISTRACTORS[1] + 1))):
            radius = rng.uniform(*DISTRACTOR_RADIUS)
            shape = shapes[int(rng.integers(len(shapes)))]
            body = shape.stretched(radius * rng.uniform(0.6, 1.0, 3))
            for _ in range(20):
                position = TRAY + np.array([*_draw_in_disc(rng, DISTRACTOR_AREA), 0.0])
                gaps = (
                    np.linalg.norm((position - centre)[:2]) - other for centre, other in occupied
                )
                if min(gaps) > radius:
                    occupied.append((position, radius))
                    solids.append(_standing(body, position, rng))
                    break
        return solids

    def heap(self, rng: Generator) -> list[PlacedBody]:
        """Sample 3 to 5 parts above each other, and let them fall onto each other.

        Raises:
            UserError: The parts do not come to rest.
        """
        count = int(rng.integers(HEAP[0], HEAP[1] + 1))
        for _ in range(HEAP_TRIALS):
            falling: list[PlacedBody] = []
            height = DROP_HEIGHT
            for _ in range(count):
                falling.append(self._draw_part(rng, HEAP_SPREAD, height, HEAP_TILT))
                corners = transform(falling[-1].T_base_obj, self.body.hull.vertices)
                height = float(corners[:, 2].max()) + DROP_HEIGHT
            starts = np.stack([item.T_base_obj for item in falling])
            poses = settle([self.body.pieces] * count, starts, (), self.part.diameter)
            if poses is not None:
                return [PlacedBody(self.body, pose) for pose in poses]
        problem = f"a heap of part {self.part.name}, which does not come to rest"
        allowed = "parts that do not roll on the bench"
        raise UserError(problem, allowed, "pass --layout single or distractors")


def _standing(body: Body, position: np.ndarray, rng: Generator) -> PlacedBody:
    """Place a distractor upright on the bench at ``position``, metres, with a random yaw."""
    rotation = Rotation.from_rotvec([0.0, 0.0, rng.uniform(0, 2 * np.pi)]).as_matrix()
    height = DROP_HEIGHT - float(body.surface.vertices[:, 2].min())
    return PlacedBody(body, make_transform(rotation, position + np.array([0.0, 0.0, height])))


def _draw_in_disc(rng: Generator, radius: float) -> tuple[float, float]:
    """Sample a point (x, y) uniformly from a disc around the origin."""
    distance, angle = radius * np.sqrt(rng.random()), rng.uniform(0, 2 * np.pi)
    return float(distance * np.cos(angle)), float(distance * np.sin(angle))


class RasterView:
    """View of the bench by this project's rasteriser, with or without shadows on the bench."""

    def __init__(self, shadows: bool) -> None:
        self._shadows = shadows
        self._render = find_renderer("raster")
        self._backgrounds = ProceduralBackgrounds()
        # The preset's blur and motion are for images of the preset's height.
        self._sensors = STYLE.sensors.resized(SIZE[1] / STYLE.height)

    def arrange(
        self,
        bodies: Sequence[Body],
        poses: Sequence[Transform],
        T_base_cam: Transform,
        rng: Generator,
    ) -> Photographer:
        """Sample the materials of bodies at T_base_obj, the lights and the bench's texture.

        The optical axis of the first image's camera, at ``T_base_cam``, hits the lit point.
        """
        T_cam_base = invert_transform(T_base_cam)
        objects = []
        materials: dict[str, Any] = {}
        for body, pose in zip(bodies, poses, strict=True):
            material = STYLE.materials.draw(rng, body.surface)
            if body.part is not None:  # copies of a part have the same material
                material = materials.setdefault(body.part.name, material)
            objects.append(SceneObject(body.surface, T_cam_base @ pose, material, body.part))
        # The table's frame has the base's axes, and its origin where the optical axis meets it.
        ahead = T_base_cam[:3, 2]
        origin = T_base_cam[:3, 3] - T_base_cam[2, 3] / ahead[2] * ahead
        T_cam_table = T_cam_base @ make_transform(np.eye(3), origin)
        lights, ambient = STYLE.lighting.draw(rng, T_cam_table[:3, 3], T_cam_table[:3, 2])
        table_image = Table().draw_image(rng, self._backgrounds, TRUE_K, SIZE, T_cam_table)
        background = table_image.project(TRUE_K, SIZE, T_cam_table)
        plane = plane_of(T_cam_table)
        scene = Scene(TRUE_K, background, tuple(objects), lights, ambient, plane)
        return partial(self._take, scene, T_base_cam)

    def _take(
        self, scene: Scene, T_base_first: Transform, T_base_cam: Transform, rng: Generator
    ) -> RGBImage:
        """Render a scene in the first camera's frame from another camera, with sensor errors."""
        scene = scene.seen_from(invert_transform(T_base_cam) @ T_base_first)
        scene = scene if self._shadows else replace(scene, plane=None)
        return capture(self._render(scene).image, self._sensors.draw(rng))


class MujocoView:
    """View of the bench by MuJoCo's renderer, with fixed materials; requires OpenGL."""

    def __init__(self, solids: Sequence[Body]) -> None:
        self._cell = Cell(solids, shown="solids")
        self._state = self._cell.data()
        self._renderer = open_gl(self._cell.model, SIZE)
        self._sensors = STYLE.sensors.resized(SIZE[1] / STYLE.height)
        self._cell.model.cam_fovy[:] = np.degrees(2 * np.arctan(SIZE[1] / 2 / TRUE_K[1, 1]))

    def arrange(
        self,
        bodies: Sequence[Body],
        poses: Sequence[Transform],
        T_base_cam: Transform,
        rng: Generator,
    ) -> Photographer:
        """Like :meth:`RasterView.arrange`, but only ``poses`` are used."""
        return partial(self._take, poses)

    def _take(self, poses: Sequence[Transform], T_base_cam: Transform, rng: Generator) -> RGBImage:
        """Render the solids at ``poses``, T_base_obj, from a camera pose, with sensor errors."""
        model, state = self._cell.model, self._state
        for number, pose in enumerate(poses):
            self._cell.put(state, number, pose)
        # The frame of an OpenGL camera has z backwards and y upwards.
        model.cam_pos[:] = T_base_cam[:3, 3]
        model.cam_quat[:] = matrix_to_quaternion(T_base_cam[:3, :3] @ np.diag([1.0, -1.0, -1.0]))
        state.qpos[:JOINTS] = UPRIGHT
        mujoco.mj_forward(model, state)
        self._renderer.update_scene(state, camera=CAMERA)
        image: RGBImage = np.ascontiguousarray(self._renderer.render())
        return capture(image, self._sensors.draw(rng))


@cache
def has_gl() -> bool:
    """Return whether MuJoCo can render images; log a warning if not."""
    try:
        open_gl(Cell(shown="solids").model, (64, 64)).close()
    except UserError as error:
        _log.warning("images of failures show the camera's view only: %s", error.got)
        return False
    return True


def open_gl(model: Any, size: tuple[int, int]) -> Any:
    """Return a MuJoCo renderer for images of ``size``, (width, height) in pixels.

    Raises:
        UserError: OpenGL is not available.
    """
    try:
        return mujoco.Renderer(model, size[1], size[0])
    except Exception as error:  # drivers raise many types
        raise UserError(
            f"MuJoCo images without OpenGL ({type(error).__name__}: {error!s:.100})",
            "a display, or EGL (libegl1 and a driver)",
            "install EGL (apt install libegl1), or leave out --video and --renderer mujoco",
        ) from error
