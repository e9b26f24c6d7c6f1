"""Rank correlation between the agreement score and the true error of perturbed poses, on renders.

    python benchmarks/verify.py [--images 40] [--parts servoholder pivconnector FILE …]

Poses are shifted by up to 20 mm and rotated by up to 20° from the true pose (both uniform, in
random directions). The table has Spearman's rank correlation of agreement and ADD over all poses of
a part and preset, and as the median over single targets; -1 is perfect.
"""

from __future__ import annotations

import argparse
import math

import cv2
import numpy as np
from common import pose_errors, print_head, print_row, timed
from scipy.stats import spearmanr

from dopepp.geometry.camera import make_transform
from dopepp.geometry.rotation import rotation_vector_to_matrix
from dopepp.parts.catalogue import load_part
from dopepp.virtual import PRESETS, Factory
from dopepp.virtual.agreement import agreement

SHIFT_M, TURN_DEG = 0.02, 20.0
LEAST_VISIBLE = 0.3
SEED, NUM_POSES = 61, 12  # the first pose of a target is the true pose
PRESET_NAMES = ("paper", "table", "bin", "quickstart")


def perturbed(T: np.ndarray, rng: np.random.Generator, share: float) -> np.ndarray:
    """Return a pose with random errors up to a share of the largest shift and rotation."""
    shift, axis = rng.normal(size=3), rng.normal(size=3)
    shift *= share * rng.random() * SHIFT_M / np.linalg.norm(shift)
    axis *= share * rng.random() * math.radians(TURN_DEG) / np.linalg.norm(axis)
    return make_transform(rotation_vector_to_matrix(axis) @ T[:3, :3], T[:3, 3] + shift)


def measure(name: str, preset: str, num_images: int) -> tuple[float, float, float, float, float]:
    """Return the row of a part and preset.

    The numbers are the rank correlation over all poses, its median over targets, the median
    agreement of true poses and of poses with an ADD above 15 mm, and milliseconds per pose.
    """
    part = load_part(name, "mm")
    factory = Factory([part], PRESETS[preset], SEED)
    rows, single, took = [], [], []
    for index in range(num_images):
        rendered = factory.render(0, index)
        rng = np.random.default_rng([SEED, index])
        for number in rendered.scene.targets:
            if rendered.visible_fractions[number] < LEAST_VISIBLE:
                continue
            item, pairs = rendered.scene.objects[number], []
            for pose in range(NUM_POSES):
                T = perturbed(item.T_cam_obj, rng, min(1.0, float(pose)))
                given = rendered.image, rendered.scene.K, T, item.surface
                value, milliseconds = timed(lambda given=given: agreement(*given))
                took.append(milliseconds)
                pairs.append((pose_errors(T, item.T_cam_obj, part.points).add, value))
            rows += pairs
            single.append(spearmanr(*zip(*pairs, strict=True)).statistic)
    errors, values = np.array(rows).T
    pooled = spearmanr(errors, values).statistic
    return (
        pooled,
        float(np.nanmedian(single)),
        float(np.median(values[errors < 1e-6])),
        float(np.median(values[errors > 15])),
        float(np.median(took)),
    )


def main() -> None:
    """Print a row per part and preset."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--images", type=int, default=40, help="images per part and preset")
    parser.add_argument("--parts", nargs="+", default=["servoholder", "pivconnector"])
    options = parser.parse_args()
    cv2.setNumThreads(1)
    print_head(
        "part", "preset", "rank correlation", "median of images", "true pose", "> 15 mm off", "ms"
    )
    for name in options.parts:
        for preset in PRESET_NAMES:
            row = measure(name, preset, options.images)
            print_row(name.rsplit("/", 1)[-1], preset, *(f"{value:.2f}" for value in row))


if __name__ == "__main__":
    main()
