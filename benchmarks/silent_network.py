"""Correct and wrong poses of templates on images without a detection of the network.

    python benchmarks/silent_network.py FOLDER

FOLDER is a BOP data set with one part, as ``dopepp render`` writes it. The network's poses are
refined and must pass its threshold. On images without such a pose, templates of the same part
search the distances of the data set.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from common import pose_errors, print_head, print_row, use_one_thread
from refine_real import read_scenes

from dopepp.geometry.camera import Transform
from dopepp.inference.estimator import PoseEstimator
from dopepp.inference.template_estimator import TemplateEstimator
from dopepp.parts.part import Part
from dopepp.recovery.detection import Detection

SLACK = 1.03  # margin of the searched distances


def count_right(part: Part, detections: list[Detection], poses: list[Transform]) -> int:
    """Return the number of detections with an ADD below a tenth of the diameter."""
    adds = [
        min(pose_errors(detection.T_cam_obj, T, part.points).add for T in poses)
        for detection in detections
        if poses
    ]
    return sum(add < 100 * part.diameter for add in adds)


def main() -> None:
    """Print the numbers of correct and wrong poses of the network and of the templates."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    arguments = parser.parse_args()
    use_one_thread()
    network = PoseEstimator.load("pretrained/pivconnector_wide", refine="region")
    (part,) = network.parts
    frames = list(read_scenes(arguments.folder, "train_pbr"))
    depths = [float(T[2, 3]) for frame in frames for _, T in frame.objects]
    templates = TemplateEstimator.of_parts([part], (min(depths) / SLACK, max(depths) * SLACK))
    print_head("method", "images", "right", "wrong")
    silent = []
    for name, estimator in (("network", network), ("templates", templates)):
        images = frames if estimator is network else silent
        right = wrong = 0
        for frame in images:
            detections = estimator.predict(frame.image, frame.K)
            correct = count_right(part, detections, [T for _, T in frame.objects])
            right, wrong = right + correct, wrong + len(detections) - correct
            if estimator is network and not detections:
                silent.append(frame)
        print_row(name, len(images), right, wrong)


if __name__ == "__main__":
    main()
