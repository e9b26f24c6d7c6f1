"""How exact calibrations are, from drawn images of a ChArUco board to the hand-eye matrix.

    python benchmarks/calibration.py --seeds 100

Twenty-four images a seed, noise of 4 grey levels, a robot that is off by 0.3 mm and 0.03°; the
lens is calibrated from the same images.
"""

from __future__ import annotations

import argparse

import numpy as np
from scipy.spatial.transform import Rotation

from dopepp.geometry.camera import camera_matrix, invert_transform, make_transform
from dopepp.geometry.camera_file import Camera
from dopepp.robot.calibration.board import board_pose, draw_view, parse_board
from dopepp.robot.calibration.hand_eye import calibrate_hand_eye
from dopepp.robot.calibration.lens import calibrate_lens
from dopepp.robot.calibration.quality import assess
from dopepp.robot.calibration.tool import find_tip

BOARD = parse_board("charuco:9x7:25:18")
SIZE = (960, 720)
TIP = np.array([0.0, 0.02, 0.18])


def noisy(M, rng):
    """Return a robot's pose as it reports it."""
    turn = Rotation.from_rotvec(np.radians(0.03) * rng.normal(size=3)).as_matrix()
    return make_transform(M[:3, :3] @ turn, M[:3, 3] + 3e-4 * rng.normal(size=3))


def apart(T, other):
    """Return the angle in degrees and the distance in millimetres between two poses."""
    turn = Rotation.from_matrix(T[:3, :3].T @ other[:3, :3]).magnitude()
    return np.degrees(turn), 1000 * np.linalg.norm(T[:3, 3] - other[:3, 3])


def calibrated(seed: int, num: int):
    """Return a seed's errors, camera in the hand and on the bench.

    Hand-eye (°, mm), expected by itself (mm), focal length (%), tip (mm), number of doubts.
    """
    rng = np.random.default_rng(seed)
    focal = rng.uniform(700, 1000)
    centre = np.array(SIZE) / 2 + rng.uniform(-15, 15, 2)
    lens = (rng.uniform(-0.1, 0.1), rng.uniform(-0.1, 0.1), 0.001, -0.001, 0.0)
    camera = Camera(SIZE, camera_matrix(focal, focal * 1.002, *centre), lens, "true")
    X, Y = (
        make_transform(Rotation.random(rng=rng).as_matrix(), rng.uniform(-far, far, 3))
        for far in (0.1, 0.5)
    )
    robot, seen = [], []
    for number in range(num):
        turn = Rotation.from_euler("zxy", rng.uniform([-1, -0.6, -0.6], [1, 0.6, 0.6])).as_matrix()
        near = rng.uniform(0.3, 0.5) * focal / 850
        middle = np.append(near * rng.uniform(-0.2, 0.2, 2), near)
        T_cam_board = make_transform(turn, middle - turn @ BOARD.points.mean(axis=0))
        sighting = BOARD.find(draw_view(BOARD, T_cam_board, camera, rng), f"{number}.png")
        if sighting is not None:
            robot.append(Y @ invert_transform(T_cam_board) @ invert_transform(X))
            seen.append(sighting)
    found_lens = calibrate_lens(seen, SIZE)
    off = 100 * abs(found_lens.camera.K[0, 0] / focal - 1)
    boards = [board_pose(view, found_lens.camera) for view in seen]
    tilts = Rotation.from_euler("xyz", rng.uniform(-0.6, 0.6, (8, 3))).as_matrix()
    touches = [noisy(make_transform(R, np.array([0.4, 0, 0.1]) - R @ TIP), rng) for R in tilts]
    tip = 1000 * np.linalg.norm(find_tip(np.array(touches)).position - TIP)
    for mount in ("hand", "bench"):
        flanges = [M if mount == "hand" else invert_transform(M) for M in robot]
        said = np.array([noisy(M, rng) for M in flanges])
        estimate = calibrate_hand_eye(said, boards, mount)
        worth = assess(said, boards, estimate)
        yield [*apart(X, estimate.T_mount_cam), 1000 * worth.shift, off, tip, len(worth.findings)]


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=100)
    parser.add_argument("--pictures", type=int, default=24)
    options = parser.parse_args()
    heads = ["°", "mm", "expected mm", "focal length %", "tip mm"]
    print(
        "| camera | "
        + " | ".join(f"{heading}, median (worst)" for heading in heads)
        + " | doubted |"
    )
    print("| --- |" + " ---: |" * 6)
    rows = np.array([[*calibrated(seed, options.pictures)] for seed in range(options.seeds)])
    for name, errors in zip(("in the hand", "on the bench"), rows.transpose(1, 0, 2), strict=True):
        middle, worst = np.median(errors, axis=0), errors.max(axis=0)
        cells = [f"{middle[k]:.3f} ({worst[k]:.3f})" for k in range(5)]
        doubted = f"{np.count_nonzero(errors[:, 5])} of {len(errors)}"
        print(f"| {name} | {' | '.join(cells)} | {doubted} |")


if __name__ == "__main__":
    main()
