"""Agreement of image and drawn part against the true error of perturbed poses, on virtual data.

    python benchmarks/verify.py [--images 40] [--seed 61] [--parts servoholder pivconnector FILE …]

Every target of every image is shown at poses up to 20 mm and 20° off (both uniform, in random
directions). Spearman's rank correlation of agreement and ADD is given over all poses of a preset
and part, and as the median over images; -1 would be perfect.
"""

from __future__ import annotations

import argparse
import math
import time

import cv2
import numpy as np
from scipy.stats import spearmanr

from dopepp.geometry.camera import make_transform, transform
from dopepp.geometry.rotation import rotation_vector_to_matrix
from dopepp.parts.catalogue import load_part
from dopepp.virtual import PRESETS, Factory
from dopepp.virtual.agreement import agreement

SHIFT_M, TURN_DEG = 0.02, 20.0
LEAST_VISIBLE = 0.3


def perturbed(T: np.ndarray, rng: np.random.Generator, share: float) -> np.ndarray:
    """Return a pose off by a share of the largest shift and turn."""
    shift, axis = rng.normal(size=3), rng.normal(size=3)
    shift *= share * rng.random() * SHIFT_M / np.linalg.norm(shift)
    axis *= share * rng.random() * math.radians(TURN_DEG) / np.linalg.norm(axis)
    return make_transform(rotation_vector_to_matrix(axis) @ T[:3, :3], T[:3, 3] + shift)


def measure(
    name: str, preset: str, num_images: int, poses: int, seed: int, unit: str
) -> tuple[float, float, float, float, float]:
    """Return pooled and median rank correlation, agreement of true poses, of the worst, and ms."""
    part = load_part(name, unit)
    factory = Factory([part], PRESETS[preset], seed)
    rows, single, took = [], [], []
    for index in range(num_images):
        rendered = factory.render(0, index)
        rng = np.random.default_rng([seed, index])
        for number in rendered.scene.targets:
            if rendered.visible_fractions[number] < LEAST_VISIBLE:
                continue
            item, pairs = rendered.scene.objects[number], []
            for pose in range(poses):
                T = perturbed(item.T_cam_obj, rng, min(1.0, float(pose)))
                start = time.process_time()
                value = agreement(rendered.image, rendered.scene.K, T, item.surface)
                took.append(1000 * (time.process_time() - start))
                moved = transform(T, part.points) - transform(item.T_cam_obj, part.points)
                pairs.append((float(np.linalg.norm(moved, axis=1).mean()), value))
            rows += pairs
            single.append(spearmanr(*zip(*pairs, strict=True)).statistic)
    errors, values = np.array(rows).T
    pooled = spearmanr(errors, values).statistic
    return (
        pooled,
        float(np.nanmedian(single)),
        float(np.median(values[errors < 1e-9])),
        float(np.median(values[errors > 0.015])),
        float(np.median(took)),
    )


def main() -> None:
    """Print a row for every part and preset."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--images", type=int, default=40, help="a preset and part")
    parser.add_argument("--poses", type=int, default=12, help="per target, the first unperturbed")
    parser.add_argument("--seed", type=int, default=61)
    parser.add_argument("--presets", nargs="+", default=["paper", "table", "bin", "quickstart"])
    parser.add_argument("--parts", nargs="+", default=["servoholder", "pivconnector"])
    parser.add_argument("--unit", default="mm", help="of mesh files")
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    print("| part | preset | rank correlation | median of images | true pose | > 15 mm off | ms |")
    print("| --- | --- | --- | --- | --- | --- | --- |")
    for name in arguments.parts:
        for preset in arguments.presets:
            row = measure(
                name, preset, arguments.images, arguments.poses, arguments.seed, arguments.unit
            )
            text = " | ".join(f"{value:.2f}" for value in row)
            print(f"| {name.rsplit('/', 1)[-1]} | {preset} | {text} |", flush=True)


if __name__ == "__main__":
    main()
