"""Accuracy and time of templates on images with known poses.

    python benchmarks/templates.py FOLDER --distances 0.12,0.25 [--tilt 60] [--images 40]

FOLDER is a BOP data set with one part, as ``dopepp render`` writes it. An image counts as correct
if the best pose has an ADD below a tenth of the diameter from any annotated pose, or from a pose
that a symmetry of the part maps to it. The level of false detections is not measured, because it
does not change the order of the poses.
"""

from __future__ import annotations

import argparse
from itertools import islice
from pathlib import Path

import numpy as np
from common import pose_errors, print_head, print_row, timed, use_one_thread
from refine_real import Frame, read_scenes

from dopepp.geometry.symmetry import symmetry_group
from dopepp.inference.estimator import PoseEstimator
from dopepp.inference.template_estimator import TemplateEstimator, load_solid_part
from dopepp.inference.templates import TemplateDetector

PASSING = (0.1, 0.05)  # ADD, diameters


def measure(estimator: PoseEstimator, frames: list[Frame]) -> list[tuple[float, float, float]]:
    """Return ADD (diameters) and rotation error (degrees) of the best pose, and CPU s per image."""
    (part,) = estimator.parts
    group = symmetry_group(part.symmetries_discrete, part.symmetries_continuous, max_step=0.1)
    rows = []
    for frame in frames:
        detections, spent = timed(lambda frame=frame: estimator.candidates(frame.image, frame.K))
        errors = [
            pose_errors(best.T_cam_obj, T @ equivalent, part.points)
            for best in detections[:1]
            for _, T in frame.objects
            for equivalent in group
        ]
        best = min(errors, key=lambda error: error.add, default=None)
        add, rotation = (np.inf, np.inf) if best is None else (best.add, best.rotation)
        rows.append((add / 1000 / part.diameter, rotation, spent / 1000))
    return rows


def main() -> None:
    """Print the share of correct images, the median rotation error and the time."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--distances", required=True, help="nearest,farthest depth, metres")
    parser.add_argument("--tilt", type=float, default=180.0)
    parser.add_argument("--images", type=int, default=None, help="number of images (default: all)")
    arguments = parser.parse_args()
    use_one_thread()
    near, far = (float(distance) for distance in arguments.distances.split(","))
    model = arguments.folder / "models" / "obj_000001.ply"
    part = load_solid_part(model, "mm", None, "auto")
    detector = TemplateDetector(part, (near, far), arguments.tilt)
    estimator = TemplateEstimator([detector], (near, far))
    frames = list(islice(read_scenes(arguments.folder, "train_pbr"), arguments.images))
    measure(estimator, frames[:1])  # compiles
    add, rotation, spent = np.array(measure(estimator, frames)).T
    correct = add < PASSING[0]
    print_head("images", "ADD-0.1d", "ADD-0.05d", "rotation", "CPU s", "slowest")
    shares = (f"{(add < limit).mean():.1%}" for limit in PASSING)
    turn = f"{np.median(rotation[correct]):.2f}°" if correct.any() else ""
    print_row(len(add), *shares, turn, f"{spent.mean():.2f}", f"{spent.max():.2f}")


if __name__ == "__main__":
    main()
