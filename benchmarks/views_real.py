"""Several views of a static scene compared with one view, on real frames of a BOP data set.

    python benchmarks/views_real.py FOLDER [--stride 4] [--spread 3]

The relative poses of the cameras come from aligning the cuboids of all other objects at their
published poses. LM-O's objects were moved several times, so only frames are combined in which all
other objects agree within 8 mm. The evaluated object may still have been moved. Detections are
drawn around the published poses, 5° and 10 mm off (times ``--spread``), in each frame
independently. The table has ADD(-S)-0.1d of objects that are at least a tenth visible in the
first frame, refined on this frame and on all frames.
"""

from __future__ import annotations

import argparse
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from common import print_head, print_row, random_step, use_one_thread
from refine_real import COVARIANCE, SEED, SHIFT, TURN

from dopepp.core.json import read_json
from dopepp.data.formats.bop.bop_models import bop_parts, parts_by_id
from dopepp.drawing.pictures import read_rgb
from dopepp.geometry.camera import (
    Transform,
    make_transform,
    move_pose,
    project_keypoints,
    transform,
)
from dopepp.geometry.rotation import nearest_rotation, rotation_vector_to_matrix
from dopepp.inference.estimator import PoseEstimator, SeenMaps
from dopepp.inference.refinement.refiner import Refiner
from dopepp.metrics.functional import add, add_s
from dopepp.parts.part import Part
from dopepp.recovery.detection import Detection, RecoveryOptions, recalibrate

SYMMETRIC = (10, 11)  # eggbox and glue of LINEMOD, by a half turn about z
LEAST_VISIBLE = 0.1
FEWEST_OTHERS, STATIC = 4, 0.008
SCENE, NUM_FRAMES, ANGLES = "test/000002", 4, (20.0, 40.0)  # degrees between the frames
CAMERA_ERROR = (2e-3, math.radians(0.2))


class Frames:
    """The frames of a scene, with the published poses and the visible objects."""

    def __init__(self, scene: Path) -> None:
        self.scene = scene
        truth, cameras, info = (
            read_json(scene / f"scene_{name}.json") for name in ("gt", "camera", "gt_info")
        )
        self.K = {n: np.reshape(cameras[n]["cam_K"], (3, 3)).astype(float) for n in truth}
        self.poses: dict[str, dict[int, Transform]] = {}
        self.visible: dict[str, set[int]] = {}
        for frame, objects in truth.items():
            self.poses[frame] = {
                item["obj_id"]: make_transform(
                    nearest_rotation(np.reshape(item["cam_R_m2c"], (3, 3))),
                    np.array(item["cam_t_m2c"]) / 1000,
                )
                for item in objects
            }
            self.visible[frame] = {
                item["obj_id"]
                for item, visibility in zip(objects, info[frame], strict=True)
                if visibility["visib_fract"] >= LEAST_VISIBLE
            }

    def image(self, frame: str) -> np.ndarray:
        """Read an image."""
        return read_rgb(next((self.scene / "rgb").glob(f"{int(frame):06d}.*")))

    def relative(self, first: str, other: str, left_out: int, parts: dict[int, Part]) -> Transform:
        """Return T_first_other from the poses of all objects except one (Kabsch 1976)."""
        both = [
            [transform(self.poses[frame][n], parts[n].cuboid) for n in parts if n != left_out
             and n in self.poses[first] and n in self.poses[other]]
            for frame in (first, other)
        ]  # fmt: skip
        to, points = (np.concatenate(cuboids) for cuboids in both)
        spread = (to - to.mean(axis=0)).T @ (points - points.mean(axis=0))
        R = nearest_rotation(spread)
        return make_transform(R, to.mean(axis=0) - R @ points.mean(axis=0))

    def partners(self, first: str, left_out: int, parts: dict[int, Part]) -> list[str]:
        """Return the frames of the same scene whose viewing direction differs by ``ANGLES``."""
        frames = []
        for other in self.poses:
            T = self.relative(first, other, left_out, parts)
            turn = math.degrees(math.acos(np.clip(T[2, 2], -1.0, 1.0)))
            if other == first or not ANGLES[0] <= turn <= ANGLES[1]:
                continue
            apart = [
                np.abs(
                    transform(T @ self.poses[other][n], part.cuboid)
                    - transform(self.poses[first][n], part.cuboid)
                ).max()
                for n, part in parts.items()
                if n != left_out and n in self.poses[first] and n in self.poses[other]
            ]
            if len(apart) >= FEWEST_OTHERS and max(apart) < STATIC:
                frames.append(other)
        return frames


class DrawnEstimator:
    """Replaces a network: the detections are drawn around the published poses."""

    timed, device = PoseEstimator.timed, torch.device("cpu")

    def __init__(self, part: Part, spread: float) -> None:
        self.covariance = spread**2 * COVARIANCE
        self.refine, self.parts, self.solid_parts = "region", (part,), (part,)
        self.refiner, self.recovery = Refiner("region", [part]), RecoveryOptions()
        self.min_score, self.spent_ms = (
            0.0,
            dict.fromkeys(("pre", "network", "decode", "refine"), 0),
        )
        self.starts: dict[bytes, Transform] = {}

    def start_detections(
        self, image: np.ndarray, K: np.ndarray, *_: object
    ) -> tuple[list[Detection], list[SeenMaps]]:
        """Return the drawn detection of an image, without maps."""
        if (T := self.starts.get(image.tobytes())) is None:
            return [], []
        part, nothing = self.parts[0], np.full((9, 2), np.nan)
        keypoints = project_keypoints(part.cuboid, T, K)
        return [Detection(part.name, 0.5, 0.5, T, keypoints, nothing, 0.0, self.covariance)], []

    def candidates_from(
        self, starts: list[Detection], image: np.ndarray, K: np.ndarray, *_: object
    ) -> list[Detection]:
        """Return the refined detections of an image."""
        return recalibrate([self.refiner(start, image, K, None) for start in starts], self.recovery)


def with_half_turn(part: Part) -> Part:
    """Return a part with a 180° symmetry about z, which the data set does not state."""
    turn = make_transform(rotation_vector_to_matrix(np.array([0.0, 0.0, math.pi])), np.zeros(3))
    return replace(part, symmetries_discrete=turn[None])


def passes(T: Transform, true: Transform, part: Part, is_symmetric: bool) -> bool:
    """Return whether ADD(-S) is below a tenth of the diameter."""
    poses = [torch.from_numpy(a)[None] for P in (T, true) for a in (P[:3, :3], P[:3, 3])]
    error = (add_s if is_symmetric else add)(*poses, torch.from_numpy(part.points))
    return float(error) < 0.1 * part.diameter


def main() -> None:
    """Print a row per object."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--stride", type=int, default=1, help="use every n-th frame as the first")
    parser.add_argument("--spread", type=float, default=1.0, help="factor on the drawn errors")
    options = parser.parse_args()
    use_one_thread()
    parts = parts_by_id(options.folder, bop_parts(options.folder))
    parts = {n: with_half_turn(part) if n in SYMMETRIC else part for n, part in parts.items()}
    frames, rng = Frames(options.folder / SCENE), np.random.default_rng(SEED)
    names = list(frames.poses)
    print_head("object", "frames", "one frame", "several", "supporting views")
    total = np.zeros(2)
    count = 0
    for number, part in parts.items():
        estimator = DrawnEstimator(part, options.spread)
        rows, shown = [], []
        for first in names[:: options.stride]:
            if number not in frames.visible[first]:
                continue
            near = frames.partners(first, number, parts)
            if len(near) < NUM_FRAMES - 1:
                continue
            chosen = [first, *rng.permutation(near)[: NUM_FRAMES - 1].tolist()]
            images = [frames.image(name) for name in chosen]
            estimator.starts.clear()
            for name, image in zip(chosen, images, strict=True):
                if number in frames.visible[name]:
                    step = random_step(rng, options.spread * TURN, options.spread * SHIFT)
                    pose = move_pose(frames.poses[name][number], step)
                    estimator.starts[image.tobytes()] = pose
            cameras = [frames.K[name] for name in chosen]
            poses = [frames.relative(first, name, number, parts) for name in chosen]
            true, results = frames.poses[first][number], []
            for views in (1, len(chosen)):
                result = PoseEstimator.predict_views(
                    estimator, images[:views], cameras[:views], poses[:views],
                    camera_error=CAMERA_ERROR,
                )  # fmt: skip
                of_part = [it for it in result.detections if it.object == part.name]
                best = max(of_part, key=lambda it: it.score, default=None)
                results.append(
                    best is not None and passes(best.T_world_obj, true, part, number in SYMMETRIC)
                )
                if views > 1 and best is not None:
                    shown.append(len(best.views))
            rows.append(results)
        shares = np.mean(rows, axis=0)
        total, count = total + np.sum(rows, axis=0), count + len(rows)
        mean = np.mean(shown) if shown else 0.0
        print_row(part.name, len(rows), *(f"{share:.1%}" for share in shares), f"{mean:.1f}")
    print_row("all", count, *(f"{share:.1%}" for share in total / count), "")


if __name__ == "__main__":
    main()
