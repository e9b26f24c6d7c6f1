"""Accuracy and time of templates on images with known poses.

    python benchmarks/templates.py FOLDER --distances 0.12,0.25 [--tilt 60] [--images 40]
    python benchmarks/templates.py lmo_bop --split test --object 1 --distances 0.5,1.5 --every 20

FOLDER is a BOP data set, as ``dopepp render`` writes it. Its object ``--object`` is searched in
each image. An image counts as correct if the best pose has an ADD below a tenth of the diameter
from any annotated pose, or from a pose that a symmetry of the part maps to it. "MSPD" is BOP's
average recall of the best pose's largest distance on the image. The level of false detections is
not measured, because it does not change the order of the poses.
"""

from __future__ import annotations

import argparse
from itertools import islice
from pathlib import Path

import numpy as np
from common import pose_errors, print_head, print_row, timed, use_one_thread
from refine_real import Frame, read_scenes

from dopepp.geometry.camera import project, transform
from dopepp.geometry.symmetry import symmetry_group
from dopepp.inference.estimator import PoseEstimator
from dopepp.inference.template_estimator import TemplateEstimator, load_solid_part
from dopepp.inference.templates.detector import TemplateDetector
from dopepp.metrics.functional import BOP_MSPD_THRESHOLDS

PASSING = (0.1, 0.05)  # ADD, diameters


def measure(
    estimator: PoseEstimator, frames: list[Frame]
) -> list[tuple[float, float, float, float]]:
    """Return errors of the best pose of each image, and CPU seconds.

    The errors are ADD (diameters), rotation error (degrees) and MSPD (pixels, of 640 across).
    """
    (part,) = estimator.parts
    group = symmetry_group(part.symmetries_discrete, part.symmetries_continuous, max_step=0.1)
    rows = []
    for frame in frames:
        detections, spent = timed(lambda frame=frame: estimator.candidates(frame.image, frame.K))
        poses = [T @ equivalent for _, T in frame.objects for equivalent in group]
        add, rotation, farthest = np.inf, np.inf, np.inf
        for best in detections[:1]:
            errors = [pose_errors(best.T_cam_obj, T, part.points) for T in poses]
            add, rotation = min((error.add, error.rotation) for error in errors)
            pixels, *true = (
                project(transform(T, part.points), frame.K) for T in (best.T_cam_obj, *poses)
            )
            farthest = min(np.linalg.norm(pixels - it, axis=1).max() for it in true)
        farthest *= 640 / frame.image.shape[1]
        rows.append((add / 1000 / part.diameter, rotation, farthest, spent / 1000))
    return rows


def main() -> None:
    """Print the share of correct images, the median rotation error and the time."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--distances", required=True, help="nearest,farthest depth, metres")
    parser.add_argument("--tilt", type=float, default=180.0)
    parser.add_argument("--split", default="train_pbr")
    parser.add_argument("--object", type=int, default=1)
    parser.add_argument("--every", type=int, default=1, help="use every n-th image")
    parser.add_argument("--images", type=int, default=None, help="number of images (default: all)")
    arguments = parser.parse_args()
    use_one_thread()
    near, far = (float(distance) for distance in arguments.distances.split(","))
    model = arguments.folder / "models" / f"obj_{arguments.object:06d}.ply"
    part = load_solid_part(model, "mm", None, "auto")
    detector = TemplateDetector(part, (near, far), arguments.tilt)
    estimator = TemplateEstimator([detector], (near, far))
    read = read_scenes(arguments.folder, arguments.split)
    frames = [
        frame._replace(objects=[it for it in frame.objects if it[0] == arguments.object])
        for frame in islice(islice(read, 0, None, arguments.every), arguments.images)
    ]
    frames = [frame for frame in frames if frame.objects]
    measure(estimator, frames[:1])  # compiles
    add, rotation, mspd, spent = np.array(measure(estimator, frames)).T
    correct = add < PASSING[0]
    print_head("images", "ADD-0.1d", "ADD-0.05d", "MSPD", "rotation", "CPU s", "slowest")
    shares = (f"{(add < limit).mean():.1%}" for limit in PASSING)
    turn = f"{np.median(rotation[correct]):.2f}°" if correct.any() else ""
    recall = np.mean([mspd < limit for limit in BOP_MSPD_THRESHOLDS])
    print_row(len(add), *shares, f"{recall:.1%}", turn, f"{spent.mean():.2f}", f"{spent.max():.2f}")


if __name__ == "__main__":
    main()
