"""Calibration of a rig: the poses of several fixed cameras, from images of one moving board.

Images of one name show the board at the same moment. A bundle adjustment refines the poses of
cameras and boards together, on all points. The world is the frame of the first camera.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, NamedTuple

import cv2
import numpy as np
from jaxtyping import Float
from scipy.optimize import least_squares
from scipy.sparse import lil_matrix

from dopepp.core.errors import UserError
from dopepp.geometry.camera import Transform, invert_transform, move_pose, transform
from dopepp.geometry.camera_file import Camera
from dopepp.geometry.refine import covariance_of
from dopepp.robot.calibration.board import (
    PIXEL_NOISE,
    BoardDetection,
    BoardPose,
    Transforms,
    board_pose,
)
from dopepp.robot.calibration.lens import MAX_ERROR_PX, MIN_OUTLIER_PX, OUTLIER

MIN_CAMERAS, MAX_CAMERAS = 2, 8
MIN_SHARED: Final = 5  # moments at which each camera of a reliable rig shares the board
SOFT_PX: Final = 1.0  # error from which a point loses weight, pixels
START_PX: Final = 5.0  # smallest error of a moment that is rejected before refinement, pixels
MAX_STEPS: Final = 30  # a solution takes about ten

Boards = Mapping[str, Mapping[str, BoardDetection]]
"""Detections of the board by camera and moment; a moment is the name of its images."""


class _View(NamedTuple):
    """A camera's image of the board at a moment."""

    camera: str
    moment: str
    detection: BoardDetection
    lens: Camera
    pose: BoardPose


@dataclass(frozen=True, eq=False)
class Rig:
    """Poses of several fixed cameras in the frame of the first camera, and their errors."""

    names: tuple[str, ...]  # names of the cameras; the frame of the first camera is the world
    T_world_cam: Transforms
    # Of each camera's rotation about its centre (radians) and translation (metres), world axes
    covariances: Float[np.ndarray, "cameras 6 6"]
    errors_px: Float[np.ndarray, "cameras"]  # RMS reprojection error of each camera
    shared: tuple[int, ...]  # number of moments at which each camera and another see the board
    outliers: tuple[str, ...]  # moments that were rejected for their reprojection error
    findings: tuple[str, ...]  # reasons not to trust the rig, with remedies

    @property
    def deviations(self) -> Float[np.ndarray, "cameras 2"]:
        """Standard deviations of position (metres) and rotation (radians), RMS over the 3 axes."""
        variances = np.diagonal(self.covariances, axis1=1, axis2=2)
        rotations, shifts = variances[:, :3].mean(axis=1), variances[:, 3:].mean(axis=1)
        return np.asarray(np.sqrt(np.stack([shifts, rotations], axis=1)))


def calibrate_rig(boards: Boards, cameras: Mapping[str, Camera]) -> Rig:
    """Estimate the poses of cameras from images of a board that they see together.

    Raises:
        UserError: The number of cameras is out of range, or a camera never sees the board together
            with the others.
    """
    names = tuple(boards)
    if not MIN_CAMERAS <= len(names) <= MAX_CAMERAS:
        allowed = f"{MIN_CAMERAS} to {MAX_CAMERAS} cameras"
        raise UserError(f"a rig of {len(names)} cameras", allowed, "pass a folder for each camera")
    counts = Counter(moment for detections in boards.values() for moment in detections)
    shared = {moment for moment, count in counts.items() if count > 1}
    views = [
        _View(name, moment, detection, cameras[name], board_pose(detection, cameras[name]))
        for name, detections in boards.items()
        for moment, detection in detections.items()
        if moment in shared
    ]
    adjustment, outliers = _Adjustment(names, views), list[str]()
    for limit_px in (START_PX, MIN_OUTLIER_PX):
        worst = adjustment.outliers(limit_px)
        outliers += worst
        if worst:
            views = [view for view in views if view.moment not in worst]
            adjustment = _Adjustment(names, views)
        if worst or limit_px == START_PX:
            adjustment.solve()
    counts_shared = tuple(sum(view.camera == name for view in views) for name in names)
    errors_px = adjustment.camera_errors_px()
    findings = [
        f"{name} sees the board with another camera {count} times: take at least {MIN_SHARED} "
        "images"
        for name, count in zip(names, counts_shared, strict=True)
        if count < MIN_SHARED
    ]
    if errors_px.max() > MAX_ERROR_PX:
        name = names[int(errors_px.argmax())]
        findings.append(
            f"the reprojection error of {name} is {errors_px.max():.2f} px: check that images of "
            "one name show the same moment, and calibrate the cameras again"
        )
    solution = adjustment.T_world_cam, adjustment.covariances
    return Rig(names, *solution, errors_px, counts_shared, tuple(outliers), tuple(findings))


def _link_cameras(names: Sequence[str], views: Sequence[_View]) -> list[Transform]:
    """Return initial values of T_world_cam for each camera; the first camera is the world.

    The next camera is always the camera that shares most moments with a camera whose pose is known.

    Raises:
        UserError: A camera shares no moment with the cameras whose poses are known.
    """
    poses: dict[str, dict[str, Transform]] = {name: {} for name in names}
    for view in views:
        poses[view.camera][view.moment] = view.pose.T_cam_board
    first, *others = names
    linked = {first: np.eye(4)}
    while others:
        shared = {
            (anchor, name): [moment for moment in poses[name] if moment in poses[anchor]]
            for anchor in linked
            for name in others
        }
        anchor, name = max(shared, key=lambda pair: len(shared[pair]))
        if not shared[anchor, name]:
            problem = f"{', '.join(others)} without images of the board at the same moments as "
            problem += ", ".join(linked)
            allowed = "images of the same name in which two cameras see the board"
            fix = "hold the board in view of two cameras at once, and take images again"
            raise UserError(problem, allowed, fix)
        steps = np.stack(
            [
                poses[anchor][moment] @ invert_transform(poses[name][moment])
                for moment in shared[anchor, name]
            ]
        )
        # The most central step has the smallest sum of Frobenius distances from the others.
        flat = steps[:, :3].reshape(len(steps), -1)
        distances = np.linalg.norm(flat[:, None] - flat[None], axis=2).sum(axis=1)
        linked[name] = linked[anchor] @ steps[distances.argmin()]
        others.remove(name)
    return [linked[name] for name in names]


class _Adjustment:
    """Bundle adjustment: minimises all reprojection errors over poses of cameras and boards.

    The unknowns are rotation and translation of each camera except the first, then of each board.
    """

    def __init__(self, names: Sequence[str], views: Sequence[_View]) -> None:
        start = _link_cameras(names, views)
        self._views, self._num_cameras = views, len(names)
        self._moments = sorted({view.moment for view in views})
        self._cameras = [names.index(view.camera) for view in views]
        self._boards = [self._moments.index(view.moment) for view in views]
        # The most certain pose of the board at each moment is its initial pose.
        best: dict[int, tuple[float, int]] = {}
        for number, (view, board) in enumerate(zip(views, self._boards, strict=True)):
            spread = float(np.trace(view.pose.covariance)), number
            best[board] = min(best.get(board, spread), spread)
        chosen = [best[board][1] for board in range(len(self._moments))]
        boards = [start[self._cameras[k]] @ views[k].pose.T_cam_board for k in chosen]
        self._transforms = np.stack([*start, *boards])
        self._errors = self._residuals(self._transforms)

    def solve(self) -> None:
        """Refine all poses by robust least squares; set ``T_world_cam`` and ``covariances``."""
        start = self._transforms
        num_unknowns = 6 * (len(start) - 1)
        ends = np.cumsum([0, *(2 * len(view.detection.points) for view in self._views)])
        sparsity = lil_matrix((ends[-1], num_unknowns), dtype=np.int8)
        for number, (camera, board) in enumerate(zip(self._cameras, self._boards, strict=True)):
            for unknown in (camera - 1, self._num_cameras - 1 + board):
                if unknown >= 0:
                    sparsity[ends[number] : ends[number + 1], 6 * unknown : 6 * unknown + 6] = 1

        def move(step: Float[np.ndarray, "numbers"]) -> Transforms:
            return np.concatenate([start[:1], move_pose(start[1:], step.reshape(-1, 6))])

        def errors(step: Float[np.ndarray, "numbers"]) -> Float[np.ndarray, "numbers"]:
            return np.concatenate(self._residuals(move(step))).ravel()

        solution = least_squares(
            errors,
            np.zeros(num_unknowns),
            jac_sparsity=sparsity,
            x_scale="jac",
            max_nfev=MAX_STEPS,
            loss="soft_l1",
            f_scale=SOFT_PX,
        )
        self._transforms = move(solution.x)
        self.T_world_cam = self._transforms[: self._num_cameras]
        self._errors = self._residuals(self._transforms)
        squares = sum(float(np.square(error).sum()) for error in self._errors)
        noise = max(PIXEL_NOISE**2, squares / max(1, int(ends[-1]) - num_unknowns))
        jacobian: Any = solution.jac
        whole = covariance_of((jacobian.T @ jacobian).toarray() / noise)
        self.covariances = np.zeros((self._num_cameras, 6, 6))
        for number in range(1, self._num_cameras):
            rows = slice(6 * number - 6, 6 * number)
            self.covariances[number] = whole[rows, rows]

    def _residuals(self, transforms: Transforms) -> list[Float[np.ndarray, "points 2"]]:
        """Return the reprojection errors of each view in pixels."""
        errors = []
        for view, camera, board in zip(self._views, self._cameras, self._boards, strict=True):
            T_cam_board = (
                invert_transform(transforms[camera]) @ transforms[self._num_cameras + board]
            )
            points, zero = transform(T_cam_board, view.detection.points), np.zeros(3)
            given = points, zero, zero, view.lens.K, view.lens.coefficients
            errors.append(cv2.projectPoints(*given)[0][:, 0] - view.detection.pixels)
        return errors

    def outliers(self, limit_px: float) -> list[str]:
        """Return the moments with an RMS error above ``limit_px`` and 3 times the median."""
        errors = self._rms(self._boards, len(self._moments))
        limit = max(limit_px, OUTLIER * float(np.median(errors)))
        pairs = zip(self._moments, errors, strict=True)
        return [moment for moment, error in pairs if error > limit]

    def camera_errors_px(self) -> Float[np.ndarray, "cameras"]:
        """Return the RMS reprojection error of each camera, pixels."""
        return self._rms(self._cameras, self._num_cameras)

    def _rms(self, groups: Sequence[int], count: int) -> Float[np.ndarray, "groups"]:
        """Return the RMS reprojection error (pixels) by group; ``groups`` has each view's group."""
        squares = [float(np.square(error).sum()) for error in self._errors]
        points = [len(error) for error in self._errors]
        sums = np.bincount(groups, squares, count) / np.bincount(groups, points, count)
        return np.asarray(np.sqrt(sums))
