"""Trials to look at: a video, a strip of pictures, a Rerun recording, what failures looked like."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import cv2
import mujoco
import numpy as np

from dopepp.core.errors import require
from dopepp.core.files import draft, write_picture
from dopepp.drawing.overlay import Wireframe, overlay
from dopepp.drawing.pictures import Picture, VideoFile
from dopepp.drawing.sheet import Tile, contact_sheet
from dopepp.geometry.camera import invert_transform, project_keypoints
from dopepp.robot.grasping.cell import TRAY, Cell
from dopepp.robot.grasping.execution import FRAME_S
from dopepp.robot.grasping.rehearsal import MOUNT, TRUE_K
from dopepp.robot.grasping.task import Record, Task
from dopepp.robot.grasping.trial import Attempt, Scene, Trials
from dopepp.robot.grasping.view import has_gl, open_gl

VIDEO_SIZE: Final = (640, 480)
EVERY: Final = 2  # recorded states from frame to frame of a video
STRIP: Final = (0.0, 0.3, 0.42, 0.53, 0.72, 1.0)
"""Times of a strip's pictures, as shares of the motion: look, come, reach, close, lift, hold."""


def show(
    task: Task, records: Sequence[Record], folder: Path, video: Path | None, rerun: Path | None
) -> None:
    """Write a picture of each kind of failure, and what is asked for of the first trial.

    Trials are made again: they depend on the seed alone.
    """
    first = task.sources[0]
    kinds = {
        one.failure: one.number for one in reversed(records)
        if one.failure and one.source == first.name
    }  # fmt: skip
    if not kinds and video is None and rerun is None:
        return
    trials = Trials(task)
    for failure, number in kinds.items():
        scene = trials.scene(number)
        picture = strip(trials, scene, trials.attempt(scene, first))
        write_picture(folder / f"{failure.replace(' ', '_')}.jpg", picture)
    if video is not None or rerun is not None:
        scene = trials.scene(0)
        attempt = trials.attempt(scene, first)
        if video is not None and video.suffix == ".jpg":
            write_picture(video, strip(trials, scene, attempt))
        elif video is not None:
            write_video(video, trials, scene, attempt)
        if rerun is not None:
            write_rerun(rerun, trials, scene, attempt)


class Stage:
    """Draws a scene's robot and things from beside; needs OpenGL (see :func:`open_gl`)."""

    def __init__(self, scene: Scene) -> None:
        things = [one.thing for one in scene.lying]
        self._cell = Cell(things, "all", T_flange_cam=MOUNT)
        self._state = self._cell.data()
        self._renderer = open_gl(self._cell.model, VIDEO_SIZE)
        self._camera = mujoco.MjvCamera()
        self._camera.lookat[:] = TRAY + np.array([0.0, 0.0, 0.1])
        self._camera.distance, self._camera.azimuth, self._camera.elevation = 0.66, 155.0, -18.0

    def draw(self, positions: Any) -> Picture:
        """Draw a recorded state."""
        self._state.qpos[:] = positions
        mujoco.mj_forward(self._cell.model, self._state)
        self._renderer.update_scene(self._state, self._camera)
        return np.ascontiguousarray(self._renderer.render())


def seen(trials: Trials, scene: Scene, attempt: Attempt) -> Picture:
    """Return the camera's picture with where the part was believed to be."""
    if attempt.believed is None:
        return scene.picture
    flange = trials.arm.flange(scene.joints)
    T_base_cam = flange @ scene.calibrated.knowledge.T_flange_cam
    T_cam_obj = invert_transform(T_base_cam) @ attempt.believed
    keypoints = project_keypoints(trials.part.cuboid, T_cam_obj, TRUE_K)
    return overlay(scene.picture, [Wireframe(keypoints)])


def strip(trials: Trials, scene: Scene, attempt: Attempt) -> Picture:
    """Return six pictures of a trial, the first as the camera saw it; without OpenGL that only."""
    states = attempt.outcome.states
    tiles = [Tile(seen(trials, scene, attempt))]
    if states and has_gl():
        stage = Stage(scene)
        tiles += [Tile(stage.draw(states[round(at * (len(states) - 1))])) for at in STRIP[1:]]
    return contact_sheet(tiles, columns=3, tile_width=320)


def write_video(path: Path, trials: Trials, scene: Scene, attempt: Attempt) -> None:
    """Write a trial as it went, with the camera's picture in a corner."""
    stage = Stage(scene)
    inset = cv2.resize(seen(trials, scene, attempt), (213, 160), interpolation=cv2.INTER_AREA)
    with VideoFile(path, 1 / (EVERY * FRAME_S)) as video:
        for time, state in list(
            zip(attempt.outcome.times, attempt.outcome.states, strict=True)
        )[::EVERY]:  # fmt: skip
            picture = stage.draw(state)
            picture[8:168, 8:221] = inset
            video.write(picture, time)


def write_rerun(path: Path, trials: Trials, scene: Scene, attempt: Attempt) -> None:
    """Write a trial as a Rerun recording: the robot's and the things' shapes over time."""
    require("rerun", "--rerun", "rerun")
    import rerun as rr

    recording = rr.RecordingStream("dopepp grasp")
    with draft(path) as place:
        recording.save(place)
        recording.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        recording.log("picture", rr.Image(seen(trials, scene, attempt)), static=True)
        model = Cell([one.thing for one in scene.lying], "all", T_flange_cam=MOUNT).model
        state = mujoco.MjData(model)
        bodies = _log_shapes(recording, model)
        for time, positions in zip(attempt.outcome.times, attempt.outcome.states, strict=True):
            recording.set_time("time", duration=time)
            state.qpos[:] = positions
            mujoco.mj_kinematics(model, state)
            for body in bodies:
                pose = rr.Transform3D(
                    translation=state.xpos[body], mat3x3=state.xmat[body].reshape(3, 3)
                )
                recording.log(f"world/{body}", pose)
        recording.disconnect()


def _log_shapes(recording: Any, model: Any) -> list[int]:
    """Log every body's meshes and boxes that are to be seen; return the bodies."""
    import rerun as rr

    bodies = set()
    for geom in np.flatnonzero(model.geom_group <= 2).tolist():
        body, kind = int(model.geom_bodyid[geom]), model.geom_type[geom]
        colour = model.geom_rgba[geom]
        if model.geom_matid[geom] >= 0:
            colour = model.mat_rgba[model.geom_matid[geom]]
        name = f"world/{body}/{geom}"
        if kind == mujoco.mjtGeom.mjGEOM_MESH:
            mesh = model.geom_dataid[geom]
            vertices, faces = (
                getattr(model, f"mesh_{what}")[start : start + count]
                for what, start, count in (
                    ("vert", model.mesh_vertadr[mesh], model.mesh_vertnum[mesh]),
                    ("face", model.mesh_faceadr[mesh], model.mesh_facenum[mesh]),
                )
            )
            shape = rr.Mesh3D(
                vertex_positions=vertices, triangle_indices=faces, albedo_factor=colour
            )
        elif kind == mujoco.mjtGeom.mjGEOM_BOX:
            shape = rr.Boxes3D(
                half_sizes=[model.geom_size[geom]], colors=[colour],
                fill_mode=rr.components.FillMode.Solid,
            )  # fmt: skip
        else:
            continue
        rotation = np.zeros(9)
        mujoco.mju_quat2Mat(rotation, model.geom_quat[geom])
        pose = rr.Transform3D(translation=model.geom_pos[geom], mat3x3=rotation.reshape(3, 3))
        recording.log(name, pose, shape, static=True)
        bodies.add(body)
    return sorted(bodies)
