"""A trial: a picture of what lies on the bench, a pose, a motion, and what came of it."""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, field
from functools import cache, cached_property
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.random import Generator
from scipy.spatial.transform import Rotation

from dopepp.core.errors import UserError
from dopepp.drawing.pictures import Picture
from dopepp.geometry.camera import Transform, invert_transform, make_transform, transform
from dopepp.geometry.rotation import rotation_angle
from dopepp.geometry.symmetry import symmetry_group
from dopepp.parts.catalogue import load_part
from dopepp.robot.grasping.cell import HOME, TRAY, Cell
from dopepp.robot.grasping.execution import Execution, Outcome
from dopepp.robot.grasping.grasps import find_grasps
from dopepp.robot.grasping.layouts import Layout, Lying
from dopepp.robot.grasping.planner import Arm, Joints, Planner, measure_gripper, rested
from dopepp.robot.grasping.rehearsal import (
    MOUNT,
    Calibrated,
    Robot,
    calibrate,
    draw_robot,
    looking_at,
)
from dopepp.robot.grasping.task import BLOCK, Record, Source, Task
from dopepp.robot.grasping.view import MujocoView, RasterView

if TYPE_CHECKING:
    from dopepp.inference.estimator import PoseEstimator
    from dopepp.recovery.detection import Detection

NO_NETWORK_DISTANCE: Final = (0.18, 0.22)
"""From which the camera looks where no network says from where, metres."""

TILT: Final = np.radians(17.0)
"""Largest turn of the camera about its x and about its y from straight down, radians."""

SETTLE_S: Final = {"single": 0.2, "distractors": 0.4, "heap": 1.5}
MOST_BELIEVED: Final = 8  # parts of which a plan keeps clear
RECOGNISED: Final = 0.1  # ADD over the diameter below which a part counts as recognised


@dataclass(frozen=True, eq=False)
class Scene:
    """A trial's scene before anybody moves."""

    number: int
    cell: Cell
    lying: Sequence[Lying]  # what is on the bench, the parts first
    start: Any  # state of the simulation
    poses: list[Transform]  # of the things, T_base_obj, as they have come to lie
    robot: Robot
    calibrated: Calibrated
    joints: Joints  # where the arm's controller reads the joints while it looks, radians
    T_base_cam: Transform  # where the camera truly is
    picture: Picture  # what it sees

    @property
    def targets(self) -> list[Transform]:
        """Where the parts are, the highest first."""
        parts = [pose for one, pose in zip(self.lying, self.poses, strict=True) if one.body.part]
        return sorted(parts, key=_height, reverse=True)


@dataclass(eq=False)
class Attempt:
    """A record and what is shown of it."""

    record: Record
    outcome: Outcome = field(default_factory=Outcome)
    # Where the arm looked for the part, T_base_obj; None where nothing was seen.
    believed: Transform | None = None


class Trials:
    """Makes trials of a task; trial i depends on the task's seed and i alone."""

    def __init__(self, task: Task) -> None:
        self.task, self.part = task, load_part(task.part, task.unit)
        self.grasps = find_grasps(self.part, task.grasps)
        self.layout = Layout(self.part, task.layout, task.yaw_deg, task.rest)
        self.arm, self.gripper = Arm(), measure_gripper()
        self.tip = np.array([0.0, 0.0, self.gripper.reach(0.0)])
        self.distance = NO_NETWORK_DISTANCE
        if task.network is not None:
            self.distance = self._distances()
        self._symmetries = symmetry_group(
            self.part.symmetries_discrete, self.part.symmetries_continuous
        )
        self._raster = RasterView(task.renderer == "raster-shadows")
        self.robot = cache(self._robot)
        self._parts_cell = cache(lambda count: Cell([self.layout.thing] * count))
        self._parts_view = cache(lambda count: MujocoView([self.layout.thing] * count))

    @cached_property
    def estimator(self) -> PoseEstimator:
        """The network."""
        from dopepp.inference.estimator import PoseEstimator

        assert self.task.network is not None
        refine = "region" if self.task.refine else None
        return PoseEstimator.load(self.task.network, refine=refine)

    def _distances(self) -> tuple[float, float]:
        """Return distances within those that the network was trained for, metres."""
        names = [part.name for part in self.estimator.parts]
        if self.part.name not in names:
            raise UserError(
                f"--network {self.task.network}, which does not know {self.part.name}",
                f"a network of this part, not of {', '.join(names)}", "pass another one",
            )  # fmt: skip
        seen = self.estimator.checkpoint.seen.get(self.part.name)
        if seen is None:
            return NO_NETWORK_DISTANCE
        near, far = seen.nearest, seen.farthest
        return near + 0.4 * (far - near), near + 0.75 * (far - near)

    def _robot(self, block: int) -> tuple[Robot, Calibrated]:
        rng = np.random.default_rng([self.task.seed, block, 1])
        robot = draw_robot(rng, self.tip)
        return robot, calibrate(robot, self.arm, rng, float(np.mean(self.distance)))

    def scene(self, number: int) -> Scene:
        """Lay out a trial and take its picture."""
        rng = np.random.default_rng([self.task.seed, number])
        robot, calibrated = self.robot(number // BLOCK)
        lying = self.layout.draw(rng)
        cell = self._cell(lying)
        state = cell.data()
        for index, one in enumerate(lying):
            cell.put(state, index, one.T_base_obj)
        joints, T_base_cam = self._look(robot, rng)
        execution = Execution(cell, state, self.gripper, robot.zero)
        execution.stand(joints)
        execution.wait(SETTLE_S[self.task.layout])
        poses = [cell.pose(state, index) for index in range(len(lying))]
        bodies = [one.body for one in lying]
        picture = self._view(lying).take(bodies, poses, T_base_cam, rng)
        return Scene(
            number, cell, lying, state, poses, robot, calibrated, joints, T_base_cam, picture
        )

    def attempt(self, scene: Scene, source: Source) -> Attempt:
        """Grip a part of a scene by the poses of a source."""
        poses = self._poses(scene, source)
        if not poses:
            return Attempt(self._record(scene, source, None, None))
        bench, hull = scene.calibrated.knowledge.T_base_bench, self.layout.body.hull
        laid = [rested(pose, hull, bench) for pose in poses][:MOST_BELIEVED]
        planner, believed, outcome = self._planner(scene), poses[0], None
        for number, first in enumerate(laid):
            others = [*laid[:number], *laid[number + 1 :]]
            plan = planner.plan([first, *others], self.grasps, scene.joints)
            if plan is not None:
                believed, state = poses[number], copy(scene.start)
                execution = Execution(scene.cell, state, self.gripper, scene.robot.zero)
                outcome = execution.run(plan)
                break
        record = self._record(scene, source, believed, outcome)
        return Attempt(record, outcome or Outcome(), believed)

    def _poses(self, scene: Scene, source: Source) -> list[Transform]:
        """Return where the controller believes parts to be, T_base_obj, the highest first."""
        rng = np.random.default_rng([self.task.seed, scene.number, 2])
        if source.kind == "random":
            return [self.layout.drop(rng)]
        if source.kind == "exact":
            return [_off(pose, source.error, rng) for pose in scene.targets]
        if source.matrices == "true":
            T_base_cam = scene.T_base_cam
        else:
            T_base_flange = self.arm.flange(scene.joints)
            T_base_cam = T_base_flange @ scene.calibrated.knowledge.T_flange_cam
        poses = [T_base_cam @ one.T_cam_obj for one in self._detected(scene)]
        return sorted(poses, key=_height, reverse=True)

    def _detected(self, scene: Scene) -> list[Detection]:
        """Return the parts on the picture that are at least half as sure as the surest."""
        lens = scene.calibrated.camera
        detections = self.estimator.predict(scene.picture, lens.K, lens.coefficients)
        parts = [detection for detection in detections if detection.object == self.part.name]
        return [detection for detection in parts if detection.score >= parts[0].score / 2]

    def _record(
        self, scene: Scene, source: Source, believed: Transform | None, outcome: Outcome | None
    ) -> Record:
        matrices = (scene.calibrated.hand_eye_mm, scene.calibrated.hand_eye_deg)
        told = (scene.number, source.name, source.error[0])
        if believed is None:
            nan = float("nan")
            return Record(*told, False, False, nan, nan, nan, False, "not seen", *matrices)
        errors = [self._add(believed, true) for true in scene.targets]
        true = scene.targets[int(np.argmin(errors))]
        add = min(errors)
        shift = np.linalg.norm(believed[:3, 3] - true[:3, 3])
        turn = rotation_angle(believed[:3, :3].T @ true[:3, :3])
        recognised = add < RECOGNISED * self.part.diameter
        parts = [index for index, one in enumerate(scene.lying) if one.body.part]
        caught = outcome is not None and outcome.held in parts
        failure = ""
        if not caught:
            failure = (
                "wrong pose" if not recognised else "no plan" if outcome is None
                else "collided" if outcome.collided else "slipped"
            )  # fmt: skip
        return Record(
            *told, True, bool(recognised), 1000 * add, 1000 * float(shift),
            float(np.degrees(turn)), caught, failure, *matrices,
        )  # fmt: skip

    def _add(self, believed: Transform, true: Transform) -> float:
        """Return ADD, metres; of a symmetric part, to its nearest symmetric pose."""
        points = transform(believed, self.part.points)
        return min(
            float(np.linalg.norm(points - transform(true @ one, self.part.points), axis=1).mean())
            for one in self._symmetries
        )

    def _look(self, robot: Robot, rng: Generator) -> tuple[Joints, Transform]:
        """Stand the arm where its camera sees the tray; return its joints and the camera."""
        for _ in range(20):
            wanted = looking_at(
                TRAY + np.array([*rng.uniform(-0.01, 0.01, 2), 0.0]), rng.uniform(*self.distance),
                rng.uniform(-TILT, TILT, 2), rng.uniform(-0.2, 0.2),
            )  # fmt: skip
            flange = wanted @ invert_transform(MOUNT)
            joints = self.arm.joints(flange, HOME)
            if joints is not None:
                true = self.arm.flange(joints + robot.zero) @ robot.T_flange_cam
                return joints, true
        raise UserError(
            f"--network {self.task.network}, which has learned to look from "
            f"{self.distance[0]:.2f} to {self.distance[1]:.2f} m",
            "distances at which this arm can hold its camera over the tray, up to about 0.6 m",
            "train for nearer ones: working_distance=[0.2,0.4]",
        )

    def _cell(self, lying: Sequence[Lying]) -> Cell:
        """Return a model of what lies there; models of parts alone are kept."""
        if any(item.body.part is None for item in lying):
            return Cell([item.thing for item in lying])
        return self._parts_cell(len(lying))

    def _planner(self, scene: Scene) -> Planner:
        count = 1 if self.task.layout == "single" else MOST_BELIEVED
        return Planner(self.arm, self.gripper, self._parts_cell(count), scene.calibrated.knowledge)

    def _view(self, lying: Sequence[Lying]) -> RasterView | MujocoView:
        """Return the renderer; MuJoCo's renderers of parts alone are kept."""
        if self.task.renderer != "mujoco":
            return self._raster
        if any(item.body.part is None for item in lying):
            return MujocoView([item.thing for item in lying])
        return self._parts_view(len(lying))


def _height(T_base_obj: Transform) -> float:
    return float(T_base_obj[2, 3])


def _off(pose: Transform, error: tuple[float, float], rng: Generator) -> Transform:
    """Return a pose that is off by millimetres and degrees."""
    shift, axis = (one / np.linalg.norm(one) for one in rng.normal(size=(2, 3)))
    turn = Rotation.from_rotvec(np.radians(error[1]) * axis).as_matrix()
    return make_transform(turn @ pose[:3, :3], pose[:3, 3] + 0.001 * error[0] * shift)
