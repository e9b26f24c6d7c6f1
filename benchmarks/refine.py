"""Refinement on rendered images: errors before and after, and time per detection.

    python benchmarks/refine.py [--images 20] [--seed 77] [--presets wide table …] [--parts NAME …]
                                [--refine region,depth]

Start poses are rotated by 9° and shifted by 5 mm from the true pose (medians). Their covariance
has the same size. Errors of symmetric parts are relative to the nearest equivalent pose. Depth is
simulated as in ``benchmarks/depth.py``. Times are CPU times of one thread at 640×480, after a
warm-up.
"""

from __future__ import annotations

import argparse
import math

import cv2
import numpy as np
from common import PoseError, pose_errors, print_head, print_row, timed
from depth import structured_light

from dopepp.data.part_symmetries import with_symmetries
from dopepp.geometry.camera import move_pose, transform
from dopepp.geometry.symmetry import symmetry_group
from dopepp.inference.refinement.refiner import PartRefiner
from dopepp.parts.catalogue import load_part
from dopepp.parts.part import Part
from dopepp.virtual import PRESETS, Factory

SIZE = (640, 480)
LEAST_VISIBLE = 0.5
MEDIAN_NORM = 1.54  # Median length of a vector of three standard normal numbers
DEVIATIONS = np.repeat([math.radians(9.0), 0.005], 3) / MEDIAN_NORM
WORSE_MM = 1.0


def errors(T: np.ndarray, true: np.ndarray, part: Part, group: np.ndarray) -> PoseError:
    """Return the errors relative to the nearest equivalent pose."""
    some, equal = part.points[::50], true @ group
    away = transform(T, some) - (some @ equal[:, :3, :3].swapaxes(1, 2) + equal[:, None, :3, 3])
    return pose_errors(T, equal[np.linalg.norm(away, axis=2).mean(axis=1).argmin()], part.points)


def measure(
    name: str, preset: str, num_images: int, seed: int, unit: str, terms: list[str]
) -> list[str]:
    """Return one row of the table."""
    part = with_symmetries(load_part(name, unit))
    group = symmetry_group(part.symmetries_discrete, part.symmetries_continuous)
    refiner = PartRefiner(part, terms)
    factory = Factory([part], PRESETS[preset].resized(*SIZE), seed)
    rng = np.random.default_rng(seed)
    before, after, took, kept = [], [], [], 0
    for index in range(num_images):
        rendered = factory.render(0, index)
        depth = None
        if "depth" in terms:
            depth = structured_light(rendered.depth, np.random.default_rng([seed, index]))
        for number in rendered.scene.targets:
            if rendered.visible_fractions[number] < LEAST_VISIBLE:
                continue
            true = rendered.scene.objects[number].T_cam_obj
            start = move_pose(true, rng.normal(size=6) * DEVIATIONS)
            given = rendered.image, rendered.scene.K, start, np.diag(DEVIATIONS**2), depth
            if not took:  # compiles, or loads compiled code
                refiner.refine(*given)
            refined, milliseconds = timed(lambda given=given: refiner.refine(*given))
            took.append(milliseconds)
            before.append(errors(start, true, part, group))
            after.append(errors(refined.T_cam_obj, true, part, group))
            kept += bool(refined.reason)
    old, new = np.array(before), np.array(after)
    shares = [
        " / ".join(
            f"{np.mean(rows[:, 2] < 1e3 * share * part.diameter):.0%}" for rows in (old, new)
        )
        for share in (0.1, 0.05, 0.02)
    ]
    high = np.percentile(new, 90, axis=0)
    middle = [
        f"{np.median(old[:, c]):.1f} → {np.median(new[:, c]):.1f} ({high[c]:.1f})" for c in (0, 1)
    ]
    worse = float(np.mean(new[:, 2] > old[:, 2] + WORSE_MM))
    times = f"{np.median(took):.1f}", f"{np.percentile(took, 95):.1f}"
    counts = f"{worse:.0%}", f"{kept / len(took):.0%}"
    return [part.name, preset, str(len(took)), *shares, *middle, *counts, *times]


def main() -> None:
    """Print a row per part and preset."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--images", type=int, default=20, help="images per part and preset")
    parser.add_argument("--seed", type=int, default=77)
    parser.add_argument("--presets", nargs="+", default=["quickstart", "wide", "table"])
    parser.add_argument("--parts", nargs="+", default=["pivconnector", "servoholder"])
    parser.add_argument("--refine", default="region", help="terms: region, depth, region,depth")
    parser.add_argument("--unit", default="mm", help="unit of mesh files")
    options = parser.parse_args()
    cv2.setNumThreads(1)
    print_head(
        "part", "preset", "poses", "ADD-0.1d", "0.05d", "0.02d", "° (90 %)", "mm (90 %)",
        "worse", "kept", "ms p50", "p95",
    )  # fmt: skip
    terms = options.refine.split(",")
    for name in options.parts:
        for preset in options.presets:
            print_row(*measure(name, preset, options.images, options.seed, options.unit, terms))


if __name__ == "__main__":
    main()
