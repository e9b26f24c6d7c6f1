"""CPU time of the pose errors for 1,000 pairs of poses, compared with a KD-tree.

    python benchmarks/metrics.py [--seed 0]

The table has the CPU time of the second of two calls on one thread. ADD-S is compared with one
prebuilt ``cKDTree`` of scipy in the same process on the same poses. The true points are transformed
into the estimate's object frame, where distances are the same. MSSD and MSPD are measured on a
solid of revolution with 2,000 points.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable

import numpy as np
import torch
from common import timed
from jaxtyping import Float
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from torch import Tensor

from dopepp.geometry.symmetry import symmetry_group
from dopepp.metrics.functional import add, add_s, mspd, mssd, rotation_error_deg

K = torch.tensor([[1066.8, 0.0, 313.0], [0.0, 1067.5, 241.3], [0.0, 0.0, 1.0]])
Poses = tuple[Tensor, Tensor, Tensor, Tensor]

PAIRS = 1000
TURNS = (64, 315)  # Numbers of symmetries; 1,000 would take 7 GB


def draw_poses(pairs: int, rng: np.random.Generator) -> Poses:
    """Draw true poses and estimates about 15° and 1.5 cm off."""
    true = Rotation.random(pairs, random_state=rng)
    estimated = true * Rotation.from_rotvec(rng.normal(0, np.radians(9), (pairs, 3)))
    t = rng.normal([0, 0, 0.8], 0.1, (pairs, 3))
    t_est = t + rng.normal(0, 0.009, (pairs, 3))
    arrays = estimated.as_matrix(), t_est, true.as_matrix(), t
    return tuple(torch.from_numpy(array) for array in arrays)  # type: ignore[return-value]


def box_surface(count: int, rng: np.random.Generator) -> Float[np.ndarray, "count 3"]:
    """Draw points on a cracker box."""
    points = rng.uniform(-1, 1, (count, 3))
    axis = rng.integers(0, 3, count)
    points[np.arange(count), axis] = rng.choice([-1.0, 1.0], count)
    return points * [0.036, 0.082, 0.107]


def can_surface(count: int, rng: np.random.Generator) -> Float[np.ndarray, "count 3"]:
    """Draw points on the side of a soup can."""
    angle, z = rng.uniform(0, 2 * np.pi, count), rng.uniform(-0.051, 0.051, count)
    return np.stack([0.034 * np.cos(angle), 0.034 * np.sin(angle), z], axis=1)


def kd_tree_add_s(poses: Poses, points: Float[np.ndarray, "v 3"]) -> Float[np.ndarray, "n"]:
    """Return ADD-S of every pair by one KD-tree."""
    R_est, t_est, R_gt, t_gt = (tensor.numpy() for tensor in poses)
    tree = cKDTree(points)
    errors = np.empty(len(t_est))
    for n in range(len(errors)):
        true = points @ R_gt[n].T + t_gt[n]
        errors[n] = np.mean(tree.query((true - t_est[n]) @ R_est[n])[0])
    return errors


def report(name: str, seconds: float, note: str = "") -> None:
    """Print a line."""
    print(f"{name:<36} {seconds:8.3f} s  {note}")


def measure(name: str, call: Callable[[], object]) -> None:
    """Print the CPU time of the second of two calls."""
    call()
    report(name, timed(call)[1] / 1e3)


def measure_distances(poses: Poses, rng: np.random.Generator) -> None:
    """Measure ADD and ADD-S, and compare ADD-S with a KD-tree."""
    points = torch.from_numpy(box_surface(10_000, rng))
    measure("ADD 10,000", lambda: add(*poses, points))
    for count in (2000, 10_000):
        surface = box_surface(count, rng)
        points = torch.from_numpy(surface)
        add_s(*poses, points)
        errors, ours_ms = timed(lambda points=points: add_s(*poses, points))
        expected, tree_ms = timed(lambda surface=surface: kd_tree_add_s(poses, surface))
        worst = float(np.abs(np.asarray(errors) / expected - 1).max())
        ratio = f"KD-tree {tree_ms / 1e3:.2f} s, {tree_ms / ours_ms:.1f} times as long"
        report(f"ADD-S {count:,}", ours_ms / 1e3, f"{ratio}; differ by at most {worst:.0e}")


def measure_symmetric(poses: Poses, rng: np.random.Generator) -> None:
    """Measure the errors that are minimised over symmetries."""
    can = torch.from_numpy(can_surface(2000, rng))
    for turns in TURNS:
        axis = ((0.0, 0.0, 1.0), (0.0, 0.0, 0.0))
        group = torch.from_numpy(symmetry_group(None, [axis], np.pi / turns))
        assert len(group) == turns
        size = f"2,000, {turns} symmetries"
        measure(f"MSSD {size}", lambda g=group: mssd(*poses, can, g))
        measure(f"MSPD {size}", lambda g=group: mspd(*poses, can, K, g))
        measure(
            f"rotation, {turns} symmetries",
            lambda g=group: rotation_error_deg(poses[0], poses[2], g),
        )


def main() -> None:
    """Print a line per error and number of points."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    torch.set_num_threads(1)
    rng = np.random.default_rng(options.seed)
    poses = draw_poses(PAIRS, rng)
    print(f"{PAIRS:,} pairs of poses, one thread, process time")
    measure_distances(poses, rng)
    measure_symmetric(poses, rng)


if __name__ == "__main__":
    main()
