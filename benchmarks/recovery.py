"""Accuracy of poses recovered from maps: simulated noise, clean maps, missing corners, crowds.

python benchmarks/recovery.py --seed 7
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from itertools import combinations

import cv2
import numpy as np
import torch
from common import encoded, pose_errors
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from dopepp.geometry.camera import camera_matrix, make_transform, project_keypoints
from dopepp.geometry.cuboid import CENTROID, cuboid_keypoints
from dopepp.geometry.pnp import solve_pnp
from dopepp.recovery import recover, recover_batch

CELLS, STRIDE, FOCAL, CROWD = 50, 8, 600.0, 10
K = camera_matrix(FOCAL, FOCAL, 199.5, 199.5)
SIZES = {
    "plate": (0.100, 0.060, 0.007),
    "can": (0.068, 0.068, 0.102),
    "box": (0.072, 0.164, 0.213),
    "pivconnector": (0.105, 0.052, 0.007),
}


class Solid:
    """A cuboid with its keypoints and surface points."""

    def __init__(self, name: str) -> None:
        half = np.array(SIZES[name]) / 2
        self.name, self.cuboid = name, cuboid_keypoints(-half, half)
        self.diameter = 2 * float(np.linalg.norm(half))
        rng = np.random.default_rng(0)
        points = rng.uniform(-1, 1, (500, 3))
        faces = rng.integers(0, 3, 500)
        points[np.arange(500), faces] = rng.choice([-1, 1], 500)
        self.points = points * half

    def right(self, T: np.ndarray, truth: np.ndarray) -> bool:
        """Return whether ADD is below a tenth of the diameter."""
        return pose_errors(T, truth, self.points).add < 100 * self.diameter


def random_pose(rng: np.random.Generator, u: float, v: float, z: float) -> np.ndarray:
    """Return a pose with a random rotation and the centroid at pixel (u, v) and depth z."""
    t = np.array([(u - K[0, 2]) * z / FOCAL, (v - K[1, 2]) * z / FOCAL, z])
    return make_transform(Rotation.random(random_state=rng).as_matrix(), t)


def crowd(
    solid: Solid, rng: np.random.Generator, sigma: float, sizes: tuple[float, float]
) -> tuple[list[np.ndarray], torch.Tensor, torch.Tensor]:
    """Return random poses with centroids at least 60 px apart, and their noisy maps."""
    while True:
        centres: list[np.ndarray] = []
        for _ in range(2000):
            centre = rng.uniform(20, CELLS * STRIDE - 20, 2)
            if all(np.linalg.norm(centre - other) >= 60 for other in centres):
                centres.append(centre)
            if len(centres) == CROWD:
                break
        else:
            continue
        break
    poses = [
        random_pose(rng, *centre, FOCAL * solid.diameter / rng.uniform(*sizes))
        for centre in centres
    ]
    keypoints = np.array([project_keypoints(solid.cuboid, T, K) for T in poses])
    belief, field = encoded(keypoints, CELLS, STRIDE, sigma)
    generator = torch.Generator().manual_seed(int(rng.integers(2**31)))
    belief = belief + 0.02 * torch.randn(belief.shape, generator=generator)
    field = field + 0.05 * torch.randn(field.shape, generator=generator)
    return poses, belief, field


def crowds(seed: int, frames: int) -> None:
    """Print the table of crowds."""
    print("\nTen instances, centroids >= 60 px apart, belief noise 0.02, field noise 0.05")
    print(f"{'part':14}{'sigma':>6}{'size px':>12}{'ADD-0.1d':>10}{'detections':>12}")
    for name in ("box", "pivconnector"):
        solid = Solid(name)
        for sigma in (2.0, 0.5):
            for sizes in ((60.0, 100.0), (60.0, 150.0), (100.0, 150.0)):
                rng = np.random.default_rng(seed)
                right = num_detections = 0
                for _ in range(frames):
                    poses, belief, field = crowd(solid, rng, sigma, sizes)
                    detections = recover(belief, field, solid.cuboid[None], K, STRIDE, sigma=sigma)
                    num_detections += len(detections)
                    right += sum(
                        any(solid.right(d.T_cam_obj, T) for d in detections) for T in poses
                    )
                span = f"{sizes[0]:.0f}-{sizes[1]:.0f}"
                recall, mean = right / (10 * frames), num_detections / frames
                print(f"{name:14}{sigma:6}{span:>12}{recall:10.3f}{mean:12.1f}")


def noisy_maps(keypoints: np.ndarray, covariance: np.ndarray) -> tuple[torch.Tensor, torch.Tensor]:
    """Return maps with peaks of covariance σ²I + Σ (σ is one cell) at noisy keypoints."""
    belief, field = encoded(keypoints[None], CELLS, STRIDE)
    centre = np.arange(CELLS) * STRIDE + (STRIDE - 1) / 2
    grid = np.stack(np.meshgrid(centre, centre), -1)
    for k in range(9):
        if belief[k].any():
            off = grid - keypoints[k]
            precision = np.linalg.inv(covariance[k] + STRIDE**2 * np.eye(2))
            drawn = np.exp(-0.5 * np.einsum("hwi,ij,hwj->hw", off, precision, off))
            belief[k] = torch.tensor(drawn)
    return belief, field


def reference(
    cuboid: np.ndarray, pixels: np.ndarray, covariance: np.ndarray, truth: np.ndarray
) -> np.ndarray:
    """Fit a pose with scipy: robust, with the known covariances, started at the true pose."""
    whitening = np.linalg.inv(np.linalg.cholesky(covariance))

    def residuals(p: np.ndarray) -> np.ndarray:
        T = make_transform(Rotation.from_rotvec(p[:3]).as_matrix(), p[3:])
        white = np.einsum("nij,nj->ni", whitening, project_keypoints(cuboid, T, K) - pixels)
        squared = (white**2).sum(1, keepdims=True)
        return (white * 3 / np.sqrt(squared + 9)).ravel()

    start = np.r_[Rotation.from_matrix(truth[:3, :3]).as_rotvec(), truth[:3, 3]]
    p = least_squares(residuals, start).x
    return make_transform(Rotation.from_rotvec(p[:3]).as_matrix(), p[3:])


def noise(seed: int, frames: int) -> None:
    """Print the table of simulated noise."""
    print("\nCorners off by 0.5-4 px along two axes; 40 % of frames with a corner 20-60 px off")
    print(f"{'part':14}{'EPnP':>8}{'known':>8}{'reference':>11}{'from maps':>11}")
    for name, near, far in (("plate", 0.5, 1.0), ("can", 0.5, 1.0), ("box", 0.7, 1.0)):
        solid, rng = Solid(name), np.random.default_rng(seed)
        right = np.zeros(4)
        for _ in range(frames):
            truth = random_pose(rng, *rng.uniform(180, 220, 2), rng.uniform(near, far))
            turn, deviation = rng.uniform(0, np.pi, 9), rng.uniform(0.5, 4, (9, 2))
            axes = np.stack([np.cos(turn), -np.sin(turn), np.sin(turn), np.cos(turn)], 1)
            axes = axes.reshape(9, 2, 2) * deviation[:, None]
            covariance = axes @ axes.transpose(0, 2, 1)
            pixels = project_keypoints(solid.cuboid, truth, K)
            pixels += np.einsum("nij,nj->ni", axes, rng.normal(size=(9, 2)))
            if rng.random() < 0.4:
                angle = rng.uniform(0, 2 * np.pi)
                off = rng.uniform(20, 60) * np.array([np.cos(angle), np.sin(angle)])
                pixels[rng.integers(8)] += off
            _, turned, moved = cv2.solvePnP(
                solid.cuboid, np.ascontiguousarray(pixels), K, None, flags=cv2.SOLVEPNP_EPNP
            )
            weighted = solve_pnp(solid.cuboid, pixels, K, covariance_px=covariance).T_cam_obj
            detections = recover(*noisy_maps(pixels, covariance), solid.cuboid[None], K, STRIDE)
            poses = (
                make_transform(cv2.Rodrigues(turned)[0], moved[:, 0]),
                weighted,
                reference(solid.cuboid, pixels, covariance, truth),
                detections[0].T_cam_obj if detections else None,
            )
            right += [T is not None and solid.right(T, truth) for T in poses]
        epnp, weighted, best, maps = right / frames
        print(f"{name:14}{epnp:8.3f}{weighted:8.3f}{best:11.3f}{maps:11.3f}")


def clean(seed: int, frames: int) -> None:
    """Print the table of clean maps."""
    print("\nClean maps: errors of reprojected keypoints and of peaks, px; instances found")
    print(f"{'sigma':>6}{'count':>6}{'bias':>9}{'99 %':>9}{'bias':>9}{'99 %':>9}{'found':>8}")
    solid = Solid("can")
    for sigma in (0.5, 1.0, 2.0):
        for count in (1, 3, 10):
            rng, errors, off, num_found = np.random.default_rng(seed), [], [], 0
            for _ in range(frames):
                centres = rng.uniform(0, CELLS * STRIDE, (count, 2))
                poses = [random_pose(rng, *c, rng.uniform(0.5, 1.5)) for c in centres]
                points = np.array([project_keypoints(solid.cuboid, T, K) for T in poses])
                maps = encoded(points, CELLS, STRIDE, sigma)
                detections = recover(*maps, solid.cuboid[None], K, STRIDE, sigma=sigma)
                for truth in points:
                    if not detections:
                        continue
                    misses = [np.abs(d.keypoints - truth).mean() for d in detections]
                    nearest = detections[int(np.argmin(misses))]
                    if min(misses) < 20:
                        num_found += 1
                        errors.append(nearest.keypoints - truth)
                        off.append(nearest.peaks - truth)
            row = []
            for kind in (errors, off):
                values = np.concatenate(kind)
                values = values[np.isfinite(values[:, 0])]
                row += [
                    np.abs(values.mean(0)).max(),
                    np.quantile(np.linalg.norm(values, axis=1), 0.99),
                ]
            share = num_found / (frames * count)
            print(f"{sigma:6}{count:6}" + "".join(f"{v:9.4f}" for v in row) + f"{share:8.3f}")


def missing(seed: int, poses: int) -> None:
    """Print the table of missing corners."""
    print("\nAny 3 of the 8 corner maps zeroed: ADD-0.1d, mean and worst of the 56 combinations")
    for name in SIZES:
        solid, rng = Solid(name), np.random.default_rng(seed)
        right = np.zeros(56)
        for _ in range(poses):
            truth = random_pose(rng, *rng.uniform(150, 250, 2), 600 * solid.diameter / 120)
            belief, field = noisy_maps(
                project_keypoints(solid.cuboid, truth, K), np.zeros((9, 2, 2))
            )
            beliefs = belief.repeat(56, 1, 1, 1)
            for detections, gone in zip(beliefs, combinations(range(CENTROID), 3), strict=True):
                detections[list(gone)] = 0
            fields = field.expand(56, -1, -1, -1)
            batch = recover_batch(beliefs, fields, solid.cuboid[None], np.stack([K] * 56), STRIDE)
            right += [
                len(detections) > 0 and solid.right(detections[0].T_cam_obj, truth)
                for detections in batch
            ]
        print(f"{name:14}{right.mean() / poses:8.3f}{right.min() / poses:8.3f}")


def main() -> None:
    """Print the requested tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    functions: tuple[Callable[[int, int], None], ...] = (noise, clean, missing, crowds)
    tables = {function.__name__: function for function in functions}
    parser.add_argument("tables", nargs="*", default=list(tables), choices=list(tables))
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--frames", type=int, default=100, help="images per row")
    options = parser.parse_args()
    torch.set_num_threads(1)
    for table in options.tables:
        tables[table](options.seed, options.frames)


if __name__ == "__main__":
    main()
