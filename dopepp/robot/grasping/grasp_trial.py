"""A trial: an image of the bench, an estimated pose, a motion of the arm, and its outcome.

A task and the records of its trials can be pickled for worker processes.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from copy import copy, deepcopy
from dataclasses import dataclass, field, replace
from functools import cache, cached_property, lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, TypeVar

import numpy as np
from numpy.random import Generator
from scipy.spatial.transform import Rotation

from dopepp.core.errors import UserError
from dopepp.drawing.pictures import RGBImage
from dopepp.geometry.camera import Transform, invert_transform, make_transform, transform
from dopepp.geometry.rotation import rotation_angle
from dopepp.geometry.symmetry import symmetry_group
from dopepp.inference.refinement.outline import OutlineMesh, make_outline_mesh
from dopepp.parts.catalogue import load_part
from dopepp.parts.symmetry_finder import cached_symmetries
from dopepp.robot.grasping.cell import HOME, JOINTS, TRAY, Cell
from dopepp.robot.grasping.execution import Execution, Outcome
from dopepp.robot.grasping.grasps import TILTS, find_grasps
from dopepp.robot.grasping.planner import (
    MAX_HEIGHTS,
    Arm,
    Joints,
    Planner,
    align_with_bench,
    measure_gripper,
)
from dopepp.robot.grasping.rehearsal import (
    MOUNT,
    CalibratedRobot,
    TrueRobot,
    calibrate,
    downward_view,
    draw_robot,
)
from dopepp.robot.grasping.selection import EstimatedPart, choose_part, choose_viewpoint
from dopepp.robot.grasping.unexplained import Unexplained, find_unexplained
from dopepp.robot.grasping.workbench import Layout, MujocoView, Photographer, PlacedBody, RasterView

if TYPE_CHECKING:
    from dopepp.geometry.camera_file import Camera
    from dopepp.inference.estimator import PoseEstimator
    from dopepp.inference.several_views.views_result import WorldDetection
    from dopepp.recovery.detection import Detection

AnyDetection = TypeVar("AnyDetection", "Detection", "WorldDetection")

BLOCK: Final = 50  # number of successive trials with one calibration, as in the paper's Table 9
EXACT: Final = "exact poses"
FAILURES: Final = ("not seen", "wrong pose", "no plan", "collided", "slipped")

DEFAULT_DISTANCE: Final = (0.18, 0.22)  # distances of the camera without a trained range, metres
TILT: Final = np.radians(17.0)  # of the camera about its x and y axes from straight down
DISTANCE_MARGIN: Final = 1.2  # factor on camera distances, for parts off the tray's centre
FLAT_TILT_DEG: Final = 60.0  # of templates for flat parts: TILT plus the effect of perspective
SETTLE_S: Final = {"single": 0.2, "distractors": 0.4, "heap": 0.4}
MAX_OBSTACLES: Final = 8  # number of parts in the planner's model
EXTRA_ATTEMPTS: Final = 3  # number of attempts at a heap beyond its number of parts
RECOGNISED: Final = 0.1  # largest ADD of a recognised part, as a share of its diameter


@dataclass(frozen=True)
class PoseSource:
    """Method by which the controller obtains the poses of the parts to grasp."""

    kind: str = "network"  # `network`, `templates`, `exact` (the simulation's) or `random`
    matrices: str = "calibrated"  # `calibrated` or `true` camera matrices for the network's poses
    error: tuple[float, float] = (0.0, 0.0)  # of exact poses in random directions, mm and degrees

    @property
    def name(self) -> str:
        """Name of the source in reports, with its errors if any."""
        if any(self.error):
            return f"{EXACT}, off by {self.error[0]:g} mm and {self.error[1]:g}°"
        true = ", true matrices" if self.matrices == "true" else ""
        return {"exact": EXACT, "random": "random poses"}.get(self.kind, self.kind) + true


@dataclass(frozen=True)
class GraspTask:
    """Options of a grasp experiment."""

    part: str = "pivconnector"  # a built-in part or a mesh file
    unit: str | None = None  # length unit of the mesh file
    grasps: Path | None = None  # file of grasps (default: the built-in part's)
    network: str | None = None  # checkpoint, if a source of poses needs one
    refine: bool = True  # whether the network's poses are refined
    layout: str = "single"  # arrangement of parts, one of `LAYOUTS`
    renderer: str = "raster"  # one of `RENDERERS`
    yaw_deg: float = 180.0  # largest rotation of parts about the vertical, to either side
    rest: str = "front"  # face that points upwards, `front` or `any`; see `Layout`
    seed: int = 0
    views: int = 1  # number of images from which poses are estimated, 1 or 2
    sources: tuple[PoseSource, ...] = (PoseSource(),)


@dataclass(frozen=True)
class Record:
    """Result of an attempt to grasp a part in a trial with one pose source."""

    number: int  # index of the trial, from 0; equal indices have equal scenes
    source: str  # name of the pose source
    off: float  # error added to an exact pose, millimetres and degrees
    seen: bool  # whether the pose source returned a pose; if not, errors are NaN
    recognised: bool  # whether ADD was below a tenth of the part's diameter
    # Errors include calibration errors, and are measured before the alignment with the bench, to
    # the part's nearest pose up to its symmetries.
    add_mm: float  # ADD
    error_mm: float  # of the part's origin
    error_deg: float
    caught: bool  # whether the gripper held the part after lifting and shaking
    failure: str  # one of `FAILURES`, or empty
    hand_eye_mm: float  # position error by the hand-eye calibration at the parts' distance
    hand_eye_deg: float  # rotation error of the hand-eye calibration, degrees
    second_view: str = ""  # where the camera took a second image, and the reason
    attempt: int = 1  # number of the attempt in this trial, from 1
    parts: int = 1  # number of parts on the bench before the attempt
    lifted: int = 0  # number of parts that the gripper held after lifting and shaking


@dataclass(frozen=True, eq=False)
class SceneObservation:
    """Parts that the controller detected, and the arm's joints at the last image."""

    parts: list[EstimatedPart]  # sorted by descending height
    joints: Joints
    second_view: str = ""  # as in :class:`Record`
    unexplained: Unexplained | None = None  # regions of undetected parts in the last image


@dataclass(frozen=True, eq=False)
class TrialScene:
    """The objects, the robot and the camera image of a trial before an attempt."""

    number: int  # index of the trial
    attempt: int  # number of the attempt, from 1
    cell: Cell
    placed: Sequence[PlacedBody]  # objects before they settle, the parts first
    start: Any  # state of the MuJoCo simulation before the grasp
    poses: list[Transform]  # T_base_obj of every object at rest
    robot: TrueRobot
    calibrated: CalibratedRobot
    joints: Joints  # measured joint angles at the time of the image, radians
    T_base_cam: Transform  # the true pose of the camera
    image: RGBImage
    photograph: Photographer
    arrange: Callable[[Sequence[Transform]], Photographer]  # for other poses in the same light
    taken: frozenset[int] = frozenset()  # indices of the objects that earlier attempts lifted

    @property
    def parts(self) -> list[int]:
        """Indices of the parts on the bench."""
        parts = (index for index, item in enumerate(self.placed) if item.body.part)
        return [index for index in parts if index not in self.taken]

    @property
    def targets(self) -> list[Transform]:
        """True poses T_base_obj of the parts at rest, sorted by descending height."""
        return sorted((self.poses[index] for index in self.parts), key=_height, reverse=True)


@dataclass(eq=False)
class Attempt:
    """The record, the motion and the used pose of an attempt with one pose source."""

    scene: TrialScene
    record: Record
    outcome: Outcome = field(default_factory=Outcome)
    estimate: Transform | None = None  # estimated T_base_obj of the grasped part
    state: Any = None  # state of the MuJoCo simulation after the motion, None without a motion


class Trials:
    """The trials of a task, by number. Trial i depends only on the task's options, seed and i."""

    def __init__(self, task: GraspTask) -> None:
        self.task, self.part = task, load_part(task.part, task.unit)
        self.grasps = find_grasps(self.part, task.grasps)
        self.layout = Layout(self.part, task.layout, task.yaw_deg, task.rest)
        self.arm, self.gripper = Arm(), measure_gripper()
        self.tip = np.array([0.0, 0.0, self.gripper.reach(0.0)])
        self.distance = DEFAULT_DISTANCE if task.network is None else self._trained_distance()
        assert self.part.mesh is not None  # as a layout requires it
        self._symmetries = symmetry_group(*cached_symmetries(self.part.mesh))
        self._raster = RasterView(task.renderer == "raster-shadows")
        self.robot = cache(self._robot)
        # Scenes of equal numbers of parts share their models.
        self._cell = lru_cache(8)(lambda *bodies: Cell(bodies))
        self._mujoco = lru_cache(8)(lambda *bodies: MujocoView(bodies))

    @cached_property
    def estimator(self) -> PoseEstimator:
        """The task's network."""
        from dopepp.inference.estimator import PoseEstimator

        assert self.task.network is not None
        return PoseEstimator.load(self.task.network, refine="region" if self.task.refine else None)

    @cached_property
    def templates(self) -> PoseEstimator:
        """Estimator that compares the image with templates of the part's mesh, without training."""
        from dopepp.inference.estimator import PoseEstimator

        distances = self.distance[0] / DISTANCE_MARGIN, self.distance[1] * DISTANCE_MARGIN
        lies_flat = self.task.rest == "front" and self.task.layout != "heap"
        tilt_deg = FLAT_TILT_DEG if lies_flat else 180.0
        return PoseEstimator.from_mesh(self.task.part, self.task.unit, distances, tilt_deg)

    @cached_property
    def _outline(self) -> OutlineMesh:
        assert self.part.mesh is not None  # a part without a mesh cannot be simulated
        return make_outline_mesh(self.part.mesh.vertices, self.part.mesh.faces)

    def _trained_distance(self) -> tuple[float, float]:
        """Return the range of camera distances: 40 to 75 % of the network's range, metres."""
        names = [part.name for part in self.estimator.parts]
        if self.part.name not in names:
            problem = f"--network {self.task.network}, which was not trained on {self.part.name}"
            allowed = f"a network of this part, not of {', '.join(names)}"
            raise UserError(problem, allowed, f"pass a network trained on {self.part.name}")
        depths = self.estimator.depth_range(self.part.name)
        if depths is None:
            return DEFAULT_DISTANCE
        near, far = depths
        return near + 0.4 * (far - near), near + 0.75 * (far - near)

    def _robot(self, block: int) -> tuple[TrueRobot, CalibratedRobot]:
        """Sample the errors of the robot for a block of trials, and calibrate it."""
        rng = np.random.default_rng([self.task.seed, block, 1])
        robot = draw_robot(rng, self.tip)
        return robot, calibrate(robot, self.arm, rng, float(np.mean(self.distance)))

    def scene(self, number: int) -> TrialScene:
        """Sample the objects and the camera pose of a trial, and render the objects at rest."""
        rng = np.random.default_rng([self.task.seed, number])
        robot, calibrated = self.robot(number // BLOCK)
        placed = self.layout.draw(rng)
        bodies = [item.body for item in placed]
        cell = self._cell(*bodies)
        state = cell.data()
        for index, item in enumerate(placed):
            cell.put(state, index, item.T_base_obj)
        joints, T_base_cam = self._aim_camera(robot, rng)
        poses = self._settle(cell, state, robot, joints)
        view = self._mujoco(*bodies) if self.task.renderer == "mujoco" else self._raster
        appearance = deepcopy(rng)

        def arrange(poses: Sequence[Transform]) -> Photographer:
            return view.arrange(bodies, poses, T_base_cam, deepcopy(appearance))

        photograph = view.arrange(bodies, poses, T_base_cam, rng)
        camera = joints, T_base_cam, photograph(T_base_cam, rng), photograph, arrange
        return TrialScene(number, 1, cell, placed, state, poses, robot, calibrated, *camera)

    def _settle(self, cell: Cell, state: Any, robot: TrueRobot, joints: Joints) -> list[Transform]:
        """Simulate until the solids rest, with the arm at ``joints``; return their poses."""
        execution = Execution(cell, state, self.gripper, robot.zero)
        execution.stand(joints)
        execution.wait(SETTLE_S[self.task.layout])
        return [cell.pose(state, index) for index in range(cell.count)]

    def attempts(self, scene: TrialScene, source: PoseSource) -> Iterator[Attempt]:
        """Yield the attempts of a trial: one, or for a heap as many as it takes to empty the heap.

        A heap gets at most :data:`EXTRA_ATTEMPTS` more attempts than it has parts, and is given up
        when two successive attempts find no plan.
        """
        limit = len(scene.parts) + EXTRA_ATTEMPTS if self.task.layout == "heap" else 1
        failed, failure = list[Transform](), ""
        while True:
            attempt = self.attempt(scene, source, failed)
            yield attempt
            is_empty = len(attempt.outcome.lifted) == len(scene.parts)
            is_stuck = failure == attempt.record.failure == "no plan"
            if is_empty or is_stuck or scene.attempt == limit:
                return
            failure = attempt.record.failure
            if failure and attempt.estimate is not None:
                failed.append(attempt.estimate)
            scene = self._look_again(attempt)

    def _look_again(self, attempt: Attempt) -> TrialScene:
        """Return the scene after an attempt, without the lifted objects, from a new camera pose."""
        scene, lifted = attempt.scene, attempt.outcome.lifted
        rng = np.random.default_rng([self.task.seed, scene.number, 1 + 2 * scene.attempt])
        state = copy(scene.start) if attempt.state is None else attempt.state
        for index in lifted:
            scene.cell.put_away(state, index)
        state.qpos[scene.cell.fingers] = self.gripper.fingers(self.gripper.widest)
        state.ctrl[JOINTS] = 0.0
        joints, T_base_cam = self._aim_camera(scene.robot, rng)
        poses = self._settle(scene.cell, state, scene.robot, joints)
        photograph = scene.arrange(poses)
        image, taken = photograph(T_base_cam, rng), scene.taken.union(lifted)
        scene = replace(scene, attempt=scene.attempt + 1, start=state, poses=poses, taken=taken)
        return replace(
            scene, joints=joints, T_base_cam=T_base_cam, image=image, photograph=photograph
        )

    def attempt(
        self, scene: TrialScene, source: PoseSource, failed: Sequence[Transform] = ()
    ) -> Attempt:
        """Grasp the best part for which a motion is found, at the poses from a source.

        ``failed`` are poses T_base_obj at which earlier attempts failed.
        """
        observation = self._observe(scene, source)
        if not observation.parts:
            return Attempt(scene, self._record(scene, source, observation, None, None))
        bench, hull = scene.calibrated.knowledge.T_base_bench, self.layout.body.hull
        parts, joints = observation.parts[:MAX_OBSTACLES], observation.joints
        low = MAX_HEIGHTS[self.task.layout]
        poses = (align_with_bench(part.T_base_obj, hull, bench, low) for part in parts)
        flat = [replace(part, T_base_obj=pose) for part, pose in zip(parts, poses, strict=True)]
        planner = self._planner(scene)
        surface, unexplained = self.part.points, observation.unexplained
        choice = choose_part(planner, flat, surface, self.grasps, joints, failed, unexplained)
        estimate = parts[choice.number if choice else 0].T_base_obj
        if choice is None:
            record = self._record(scene, source, observation, estimate, None)
            return Attempt(scene, record, estimate=estimate)
        state = copy(scene.start)
        execution = Execution(scene.cell, state, self.gripper, scene.robot.zero)
        if observation.second_view:
            execution.move(np.stack([scene.joints, joints]))
        outcome = execution.run(choice.plan)
        record = self._record(scene, source, observation, estimate, outcome)
        return Attempt(scene, record, outcome, estimate, state)

    def _planner(self, scene: TrialScene) -> Planner:
        count = 1 if self.task.layout == "single" else MAX_OBSTACLES
        tilts = TILTS.tolist() if self.task.layout == "heap" else [0.0]
        cell = self._cell(*[self.layout.body] * count)
        return Planner(self.arm, self.gripper, cell, scene.calibrated.knowledge, tilts)

    def _observe(self, scene: TrialScene, source: PoseSource) -> SceneObservation:
        """Return the parts detected by a source, which takes one or two images if needed."""
        rng = np.random.default_rng([self.task.seed, scene.number, 2 * scene.attempt])
        if source.kind == "random":
            return SceneObservation([EstimatedPart(self.layout.draw_pose(rng))], scene.joints)
        if source.kind == "exact":
            poses = (_perturb(pose, source.error, rng) for pose in scene.targets)
            return SceneObservation([EstimatedPart(pose) for pose in poses], scene.joints)
        estimator = self.templates if source.kind == "templates" else self.estimator
        lens, T_base_cam = scene.calibrated.camera, self._camera_pose(scene, source, scene.joints)
        if self.task.views == 1:
            likely_parts = self._likely(estimator.predict(scene.image, lens.K, lens.coefficients))
            chances = [p.score if p.probability is None else p.probability for p in likely_parts]
            seen = [T_base_cam @ part.T_cam_obj for part in likely_parts]
            parts = [EstimatedPart(*pair) for pair in zip(seen, chances, strict=True)]
            unexplained = self._unexplained(scene.image, lens, T_base_cam, parts)
            return SceneObservation(_by_height(parts), scene.joints, unexplained=unexplained)
        result = estimator.predict_views([scene.image], [lens], [T_base_cam])
        likely = self._likely(result.detections) or self._likely(result.weaker)[:1]
        likely.sort(key=lambda part: _height(part.T_world_obj), reverse=True)
        planner = self._planner(scene)
        view = choose_viewpoint(planner, lens.K, scene.joints, likely, self._outline)
        joints, reason = (scene.joints, "none in reach") if view is None else view
        image = scene.image
        if view is not None:
            image = scene.photograph(self._true_camera_pose(scene.robot, joints), rng)
            cameras = [T_base_cam, self._camera_pose(scene, source, joints)]
            result = estimator.predict_views([scene.image, image], [lens] * 2, cameras)
            T_base_cam = cameras[1]
        likely = self._likely(result.detections)
        parts = [EstimatedPart(part.T_world_obj, part.probability) for part in likely]
        unexplained = self._unexplained(image, lens, T_base_cam, parts)
        return SceneObservation(_by_height(parts), joints, reason, unexplained)

    def _unexplained(
        self, image: RGBImage, lens: Camera, T_base_cam: Transform, parts: Sequence[EstimatedPart]
    ) -> Unexplained | None:
        """Return the regions of a heap's image that probably show undetected parts, if any."""
        from dopepp.inference.input_image import prepare_image

        if self.task.layout != "heap":
            return None
        T_cam_base = invert_transform(T_base_cam)
        image, K, _ = prepare_image(image, lens.K, lens.coefficients)
        poses = [T_cam_base @ part.T_base_obj for part in parts]
        mask = find_unexplained(image, K, self._outline, poses)
        return Unexplained(mask, K, T_cam_base) if mask.any() else None

    def _likely(self, detections: Sequence[AnyDetection]) -> list[AnyDetection]:
        """Return the part's detections with at least half the score of its best detection."""
        parts = [detection for detection in detections if detection.object == self.part.name]
        return [part for part in parts if part.score >= parts[0].score / 2]

    def _camera_pose(self, scene: TrialScene, source: PoseSource, joints: Joints) -> Transform:
        """Return T_base_cam by the calibration or, if the source asks for it, the true pose."""
        if source.matrices == "true":
            return self._true_camera_pose(scene.robot, joints)
        return np.asarray(self.arm.flange(joints) @ scene.calibrated.knowledge.T_flange_cam)

    def _true_camera_pose(self, robot: TrueRobot, joints: Joints) -> Transform:
        """Return T_base_cam of the true robot at the joint angles that its controller reads."""
        return np.asarray(self.arm.flange(joints + robot.zero) @ robot.T_flange_cam)

    def _record(
        self,
        scene: TrialScene,
        source: PoseSource,
        observation: SceneObservation,
        estimate: Transform | None,
        outcome: Outcome | None,
    ) -> Record:
        """Return the result of an attempt; ``outcome`` is None if no plan was found."""
        robot = scene.calibrated
        ends = (robot.hand_eye_mm, robot.hand_eye_deg, observation.second_view)
        counts: dict[str, Any] = {"attempt": scene.attempt, "parts": len(scene.parts)}
        trial = (scene.number, source.name, source.error[0])
        if estimate is None:
            nan = float("nan")
            return Record(*trial, False, False, nan, nan, nan, False, "not seen", *ends, **counts)
        targets = [target @ S for target in scene.targets for S in self._symmetries]
        adds = [self._add(estimate, target) for target in targets]
        add, target = min(adds), targets[int(np.argmin(adds))]
        shift = float(np.linalg.norm(estimate[:3, 3] - target[:3, 3]))
        angle = float(np.degrees(rotation_angle(estimate[:3, :3].T @ target[:3, :3])))
        is_recognised = bool(add < RECOGNISED * self.part.diameter)
        is_caught = outcome is not None and outcome.held in scene.parts
        if outcome is not None:
            counts["lifted"] = len(set(scene.parts).intersection(outcome.lifted))
        if is_caught:
            failure = ""
        elif not is_recognised:
            failure = "wrong pose"
        elif outcome is None:
            failure = "no plan"
        else:
            failure = "collided" if outcome.collided else "slipped"
        pose = (1000 * add, 1000 * shift, angle)
        return Record(*trial, True, is_recognised, *pose, is_caught, failure, *ends, **counts)

    def _add(self, estimate: Transform, target: Transform) -> float:
        """Return the ADD of an estimated pose, metres."""
        points = self.part.points
        shifts = transform(estimate, points) - transform(target, points)
        return float(np.linalg.norm(shifts, axis=1).mean())

    def _aim_camera(self, robot: TrueRobot, rng: Generator) -> tuple[Joints, Transform]:
        """Sample a camera pose above the tray; return the measured joints and true T_base_cam."""
        for _ in range(20):
            point = TRAY + np.array([*rng.uniform(-0.01, 0.01, 2), 0.0])
            distance = rng.uniform(*self.distance)
            tilt, roll = rng.uniform(-TILT, TILT, 2), rng.uniform(-0.2, 0.2)
            flange = downward_view(point, distance, tilt, roll) @ invert_transform(MOUNT)
            joints = self.arm.joints(flange, HOME)
            if joints is not None:
                return joints, self._true_camera_pose(robot, joints)
        raise UserError(
            f"--network {self.task.network}, trained for distances of "
            f"{self.distance[0]:.2f} to {self.distance[1]:.2f} m",
            "distances that this arm can reach over the tray, up to about 0.6 m",
            "train for smaller distances: working_distance=[0.2,0.4]",
        )


def _height(T_base_obj: Transform) -> float:
    return float(T_base_obj[2, 3])


def _by_height(parts: Sequence[EstimatedPart]) -> list[EstimatedPart]:
    return sorted(parts, key=lambda part: _height(part.T_base_obj), reverse=True)


def _perturb(pose: Transform, error: tuple[float, float], rng: Generator) -> Transform:
    """Return a pose with errors (mm, °) in a random direction and about a random axis."""
    direction, axis = (vector / np.linalg.norm(vector) for vector in rng.normal(size=(2, 3)))
    R = Rotation.from_rotvec(np.radians(error[1]) * axis).as_matrix()
    return make_transform(R @ pose[:3, :3], pose[:3, 3] + 0.001 * error[0] * direction)
