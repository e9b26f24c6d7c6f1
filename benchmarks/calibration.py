"""Accuracy of the calibrations, from rendered images of a ChArUco board to the hand-eye transform.

    python benchmarks/calibration.py --seeds 100

Each seed has 24 images with a noise of 4 grey levels. The robot has errors of 0.3 mm and 0.03°. The
lens is calibrated from the same images.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator

import numpy as np
from common import pose_errors, print_head, print_row
from scipy.spatial.transform import Rotation

from dopepp.geometry.camera import Transform, camera_matrix, invert_transform, make_transform
from dopepp.geometry.camera_file import Camera
from dopepp.robot.calibration.board import board_pose, draw_view, parse_board
from dopepp.robot.calibration.hand_eye import calibrate_hand_eye
from dopepp.robot.calibration.lens import calibrate_lens
from dopepp.robot.calibration.quality import assess
from dopepp.robot.calibration.tool import find_tip

BOARD = parse_board("charuco:9x7:25:18")
SIZE, NUM_IMAGES = (960, 720), 24
TIP = np.array([0.0, 0.02, 0.18])


def noisy(T: Transform, rng: np.random.Generator) -> Transform:
    """Return a flange pose with the robot's errors."""
    turn = Rotation.from_rotvec(np.radians(0.03) * rng.normal(size=3)).as_matrix()
    return make_transform(T[:3, :3] @ turn, T[:3, 3] + 3e-4 * rng.normal(size=3))


def calibration_errors(seed: int) -> Iterator[list[float]]:
    """Yield the errors of a seed for a camera in the hand, then for a camera on the bench.

    The errors are rotation (°), position (mm), expected position error (mm), focal length (%),
    tool tip (mm), and the number of findings that question the result.
    """
    rng = np.random.default_rng(seed)
    focal = rng.uniform(700, 1000)
    centre = np.array(SIZE) / 2 + rng.uniform(-15, 15, 2)
    distortion = (rng.uniform(-0.1, 0.1), rng.uniform(-0.1, 0.1), 0.001, -0.001, 0.0)
    camera = Camera(SIZE, camera_matrix(focal, focal * 1.002, *centre), distortion, "true")
    X, Y = (
        make_transform(Rotation.random(rng=rng).as_matrix(), rng.uniform(-far, far, 3))
        for far in (0.1, 0.5)
    )
    flanges, views = [], []
    for number in range(NUM_IMAGES):
        turn = Rotation.from_euler("zxy", rng.uniform([-1, -0.6, -0.6], [1, 0.6, 0.6])).as_matrix()
        near = rng.uniform(0.3, 0.5) * focal / 850
        middle = np.append(near * rng.uniform(-0.2, 0.2, 2), near)
        T_cam_board = make_transform(turn, middle - turn @ BOARD.points.mean(axis=0))
        view = BOARD.detect(draw_view(BOARD, T_cam_board, camera, rng), f"{number}.png")
        if view is not None:
            flanges.append(Y @ invert_transform(T_cam_board) @ invert_transform(X))
            views.append(view)
    lens = calibrate_lens(views, SIZE)
    focal_error = 100 * abs(lens.camera.K[0, 0] / focal - 1)
    boards = [board_pose(view, lens.camera) for view in views]
    tilts = Rotation.from_euler("xyz", rng.uniform(-0.6, 0.6, (8, 3))).as_matrix()
    touches = [noisy(make_transform(R, np.array([0.4, 0, 0.1]) - R @ TIP), rng) for R in tilts]
    tip_error = 1000 * np.linalg.norm(find_tip(np.array(touches)).position - TIP)
    for mount in ("hand", "bench"):
        poses = [T if mount == "hand" else invert_transform(T) for T in flanges]
        reported = np.array([noisy(T, rng) for T in poses])
        estimate = calibrate_hand_eye(reported, boards, mount)
        quality = assess(reported, boards, estimate)
        error = pose_errors(estimate.T_mount_cam, X, BOARD.points)
        yield [
            error.rotation, error.translation, 1000 * quality.shift, focal_error, tip_error,
            len(quality.findings),
        ]  # fmt: skip


def main() -> None:
    """Print a row per mounting: medians over the seeds, with the worst seed in brackets."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=100)
    options = parser.parse_args()
    rows = np.array([[*calibration_errors(n)] for n in range(options.seeds)])
    print_head("camera", "°", "mm", "expected mm", "focal length %", "tip mm", "doubtful")
    for name, errors in zip(("in the hand", "on the bench"), rows.transpose(1, 0, 2), strict=True):
        medians, worst = np.median(errors, axis=0), errors.max(axis=0)
        cells = [f"{medians[k]:.3f} ({worst[k]:.3f})" for k in range(5)]
        print_row(name, *cells, f"{np.count_nonzero(errors[:, 5])} of {len(errors)}")


if __name__ == "__main__":
    main()
