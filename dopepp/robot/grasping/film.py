"""Films of grasp trials: a video, a strip of images, a Rerun recording, and images of failures."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from itertools import islice
from pathlib import Path
from typing import Any, Final

import cv2
import mujoco
import numpy as np

from dopepp.core.files import draft, write_image
from dopepp.drawing.overlay import Wireframe, overlay
from dopepp.drawing.pictures import RGBImage, VideoFile
from dopepp.drawing.sheet import Tile, contact_sheet
from dopepp.geometry.camera import invert_transform, project_keypoints
from dopepp.robot.grasping.cell import TRAY, Cell
from dopepp.robot.grasping.execution import FRAME_S
from dopepp.robot.grasping.grasp_trial import Attempt, GraspTask, Record, Trials, TrialScene
from dopepp.robot.grasping.rehearsal import MOUNT, TRUE_K
from dopepp.robot.grasping.workbench import has_gl, open_gl

_log = logging.getLogger(__name__)

VIDEO_SIZE: Final = (640, 480)
STRIDE: Final = 2  # recorded states per frame of a video
STRIP: Final = (0.0, 0.3, 0.42, 0.53, 0.72, 1.0)
"""Times of a strip's images, as shares of the motion's duration."""


def show(
    task: GraspTask, records: Sequence[Record], folder: Path, video: Path | None, rerun: Path | None
) -> None:
    """Repeat trials with the task's first pose source, and write images and films of them.

    ``folder`` receives a strip of images of the first trial with each kind of failure; a warning
    states a failure that did not happen again. ``video`` (.jpg: a strip) and ``rerun`` are films of
    the first trial.
    """
    first = task.sources[0]
    failed = [record for record in records if record.failure and record.source == first.name]
    examples = {record.failure: record for record in reversed(failed)}
    if not examples and video is None and rerun is None:
        return
    trials = Trials(task)
    for failure, record in examples.items():
        attempts = trials.attempts(trials.scene(record.number), first)
        attempt = next(islice(attempts, record.attempt - 1, None), None)
        if attempt is None:  # with other threads, poses of a network may differ slightly
            failed_attempt = f"attempt {record.attempt} of trial {record.number}"
            _log.warning("no image of %r: %s did not happen again", failure, failed_attempt)
            continue
        write_image(folder / f"{failure.replace(' ', '_')}.jpg", strip(trials, attempt))
    if video is not None or rerun is not None:
        attempt = trials.attempt(trials.scene(0), first)
        if video is not None and video.suffix.lower() == ".jpg":
            write_image(video, strip(trials, attempt))
        elif video is not None:
            write_video(video, trials, attempt)
        if rerun is not None:
            write_rerun(rerun, trials, attempt)


class SideView:
    """Renderer of the robot and the objects of a scene from the side; needs OpenGL."""

    def __init__(self, scene: TrialScene) -> None:
        self._cell = Cell([item.body for item in scene.placed], "all", T_flange_cam=MOUNT)
        self._state = self._cell.data()
        self._renderer = open_gl(self._cell.model, VIDEO_SIZE)
        self._camera = mujoco.MjvCamera()
        self._camera.lookat[:] = TRAY + np.array([0.0, 0.0, 0.1])
        self._camera.distance, self._camera.azimuth, self._camera.elevation = 0.66, 155.0, -18.0

    def draw(self, positions: Any) -> RGBImage:
        """Render a recorded state from ``positions``, MuJoCo's ``qpos``."""
        self._state.qpos[:] = positions
        mujoco.mj_forward(self._cell.model, self._state)
        self._renderer.update_scene(self._state, self._camera)
        return np.ascontiguousarray(self._renderer.render())


def draw_estimate(trials: Trials, attempt: Attempt) -> RGBImage:
    """Return the scene's camera image with a wireframe of the grasped part's estimated cuboid."""
    scene = attempt.scene
    if attempt.estimate is None:
        return scene.image
    flange = trials.arm.flange(scene.joints)
    T_base_cam = flange @ scene.calibrated.knowledge.T_flange_cam
    T_cam_obj = invert_transform(T_base_cam) @ attempt.estimate
    keypoints = project_keypoints(trials.part.cuboid, T_cam_obj, TRUE_K)
    return overlay(scene.image, [Wireframe(keypoints)])


def strip(trials: Trials, attempt: Attempt) -> RGBImage:
    """Return the camera image and, with OpenGL, five side views of the motion, side by side."""
    states = attempt.outcome.states
    tiles = [Tile(draw_estimate(trials, attempt))]
    if states and has_gl():
        view = SideView(attempt.scene)
        chosen = [states[round(share * (len(states) - 1))] for share in STRIP[1:]]
        tiles += [Tile(view.draw(state)) for state in chosen]
    return contact_sheet(tiles, columns=3, tile_width=320)


def write_video(path: Path, trials: Trials, attempt: Attempt) -> None:
    """Write a video of a trial's motion from the side, with the camera image in a corner."""
    view, image = SideView(attempt.scene), draw_estimate(trials, attempt)
    inset = cv2.resize(image, (213, 160), interpolation=cv2.INTER_AREA)
    outcome = attempt.outcome
    states = list(zip(outcome.times, outcome.states, strict=True))[::STRIDE]
    with VideoFile(path, 1 / (STRIDE * FRAME_S)) as video:
        for time, state in states:
            frame = view.draw(state)
            frame[8:168, 8:221] = inset
            video.write(frame, time)


def write_rerun(path: Path, trials: Trials, attempt: Attempt) -> None:
    """Write a trial as a Rerun recording of the moving shapes of robot and solids."""
    import rerun as rr

    recording = rr.RecordingStream("dopepp grasp")
    with draft(path) as partial:
        recording.save(partial)
        recording.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        image = draw_estimate(trials, attempt)
        recording.log("image", rr.Image(image), static=True)
        model = Cell([item.body for item in attempt.scene.placed], "all", T_flange_cam=MOUNT).model
        state = mujoco.MjData(model)
        bodies = _log_shapes(recording, model)
        for time, positions in zip(attempt.outcome.times, attempt.outcome.states, strict=True):
            recording.set_time("time", duration=time)
            state.qpos[:] = positions
            mujoco.mj_kinematics(model, state)
            for body in bodies:
                position, rotation = state.xpos[body], state.xmat[body].reshape(3, 3)
                pose = rr.Transform3D(translation=position, mat3x3=rotation)
                recording.log(f"world/{body}", pose)
        recording.disconnect()


def _log_shapes(recording: Any, model: Any) -> list[int]:
    """Log the visible meshes and boxes of a MuJoCo model to Rerun; return their bodies' ids."""
    import rerun as rr

    bodies = set()
    for geom in np.flatnonzero(model.geom_group <= 2).tolist():
        body, kind = int(model.geom_bodyid[geom]), model.geom_type[geom]
        colour = model.geom_rgba[geom]
        if model.geom_matid[geom] >= 0:
            colour = model.mat_rgba[model.geom_matid[geom]]
        name = f"world/{body}/{geom}"
        if kind == mujoco.mjtGeom.mjGEOM_MESH:
            mesh = model.mesh(model.geom_dataid[geom])
            vertices = model.mesh_vert[mesh.vertadr[0] :][: mesh.vertnum[0]]
            faces = model.mesh_face[mesh.faceadr[0] :][: mesh.facenum[0]]
            shape: Any = rr.Mesh3D(
                vertex_positions=vertices, triangle_indices=faces, albedo_factor=colour
            )
        elif kind == mujoco.mjtGeom.mjGEOM_BOX:
            half_sizes, solid = [model.geom_size[geom]], rr.components.FillMode.Solid
            shape = rr.Boxes3D(half_sizes=half_sizes, colors=[colour], fill_mode=solid)
        else:
            continue
        rotation = np.zeros(9)
        mujoco.mju_quat2Mat(rotation, model.geom_quat[geom])
        pose = rr.Transform3D(translation=model.geom_pos[geom], mat3x3=rotation.reshape(3, 3))
        recording.log(name, pose, shape, static=True)
        bodies.add(body)
    return sorted(bodies)
