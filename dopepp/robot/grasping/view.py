"""What the wrist's camera sees: by the project's renderer, as networks learn, or by MuJoCo's."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from functools import cache
from typing import Any, Final

import mujoco
import numpy as np
from numpy.random import Generator

from dopepp.core.errors import UserError
from dopepp.drawing.pictures import Picture
from dopepp.geometry.camera import Transform, invert_transform, make_transform
from dopepp.geometry.rotation import matrix_to_quaternion
from dopepp.robot.grasping.cell import CAMERA, JOINTS, Cell, Thing
from dopepp.robot.grasping.rehearsal import SIZE, TRUE_K
from dopepp.virtual.backgrounds import ProceduralBackgrounds
from dopepp.virtual.body import Body
from dopepp.virtual.presets import PRESETS
from dopepp.virtual.presets.table import Table, plane_of
from dopepp.virtual.renderers import find_renderer
from dopepp.virtual.scene import Scene, SceneObject
from dopepp.virtual.sensor import capture

RENDERERS: Final = ("raster", "raster-shadows", "mujoco")
"""Of the camera's pictures: the project's as the released networks learned, on a bench without
shadows; the same with the shadows that parts throw on it; and MuJoCo's."""

LOOK: Final = PRESETS["wide"]
"""Whose light, materials and camera errors the scenes have: the released networks'."""

_log = logging.getLogger(__name__)

UPRIGHT: Final = np.radians([90.0, -90.0, 0.0, -90.0, 0.0, 0.0])
"""Joints of an arm that points at the ceiling."""


class RasterView:
    """The project's renderer: random materials and light, over a picture that lies on the bench."""

    def __init__(self, shadows: bool) -> None:
        self._shadows = shadows
        self._render = find_renderer("raster")
        self._backgrounds = ProceduralBackgrounds()
        # Blur and motion belong to the preset's pictures, which are as wide as they are high.
        self._sensors = LOOK.sensors.resized(SIZE[1] / LOOK.height)

    def take(
        self, bodies: Sequence[Body], poses: Sequence[Transform], T_base_cam: Transform,
        rng: Generator,
    ) -> Picture:  # fmt: skip
        """Return what the camera at T_base_cam sees of bodies at T_base_obj on the bench."""
        T_cam_base = invert_transform(T_base_cam)
        objects = []
        materials: dict[str, Any] = {}
        for body, pose in zip(bodies, poses, strict=True):
            material = LOOK.materials.draw(rng, body.surface)
            if body.part is not None:  # copies of a part are made of the same
                material = materials.setdefault(body.part.name, material)
            objects.append(SceneObject(body.surface, T_cam_base @ pose, material, body.part))
        T_cam_table = table_seen(T_base_cam)
        lights, ambient = LOOK.lighting.draw(rng, T_cam_table[:3, 3], T_cam_table[:3, 2])
        picture = Table().draw_picture(rng, self._backgrounds, TRUE_K, SIZE, T_cam_table)
        scene = Scene(
            TRUE_K, picture.seen(TRUE_K, SIZE, T_cam_table), tuple(objects), lights, ambient,
            plane_of(T_cam_table) if self._shadows else None, self._sensors.draw(rng),
        )  # fmt: skip
        return capture(self._render(scene).image, scene.sensor)


class MujocoView:
    """MuJoCo's renderer, which needs OpenGL: its light, one colour a thing, an even bench."""

    def __init__(self, things: Sequence[Thing]) -> None:
        self._cell = Cell(things, shown="things")
        self._state = self._cell.data()
        self._renderer = open_gl(self._cell.model, SIZE)
        self._sensors = LOOK.sensors.resized(SIZE[1] / LOOK.height)
        self._cell.model.cam_fovy[:] = np.degrees(2 * np.arctan(SIZE[1] / 2 / TRUE_K[1, 1]))

    def take(
        self, bodies: Sequence[Body], poses: Sequence[Transform], T_base_cam: Transform,
        rng: Generator,
    ) -> Picture:  # fmt: skip
        """Return a picture; see :meth:`RasterView.take`."""
        model, state = self._cell.model, self._state
        for number, pose in enumerate(poses):
            self._cell.put(state, number, pose)
        # OpenGL's cameras look along −z with y upwards.
        model.cam_pos[:] = T_base_cam[:3, 3]
        model.cam_quat[:] = matrix_to_quaternion(T_base_cam[:3, :3] @ np.diag([1.0, -1.0, -1.0]))
        state.qpos[:JOINTS] = UPRIGHT  # out of sight, as the hand is
        mujoco.mj_forward(model, state)
        self._renderer.update_scene(state, camera=CAMERA)
        picture: Picture = np.ascontiguousarray(self._renderer.render())
        return capture(picture, self._sensors.draw(rng))


def table_seen(T_base_cam: Transform) -> Transform:
    """Return T_cam_table: the bench's plane, its origin where the camera looks at it."""
    ahead = T_base_cam[:3, 2]
    origin = T_base_cam[:3, 3] - T_base_cam[2, 3] / ahead[2] * ahead
    return np.asarray(invert_transform(T_base_cam) @ make_transform(np.eye(3), origin))


@cache
def has_gl() -> bool:
    """Tell whether MuJoCo can draw; the log says so where it cannot."""
    try:
        open_gl(Cell(shown="things").model, (64, 64)).close()
    except UserError as error:
        _log.warning("failures are shown by the camera's picture alone: %s", error.got)
        return False
    return True


def open_gl(model: Any, size: tuple[int, int]) -> Any:
    """Return MuJoCo's renderer; a :class:`UserError` where there is no OpenGL."""
    try:
        return mujoco.Renderer(model, size[1], size[0])
    except Exception as error:  # whatever the driver raises
        raise UserError(
            f"pictures by MuJoCo without OpenGL ({type(error).__name__}: {error!s:.100})",
            "a display, or EGL (libegl1 and a driver)",
            "install it, or leave out --video and --renderer mujoco",
        ) from error
