"""Templates where a network reports nothing: do they find the part?

    python benchmarks/silent_network.py FOLDER --checkpoint pretrained/pivconnector_wide

FOLDER is a BOP data set with one part, as ``dopepp render`` writes it. The network's poses are
refined and have to pass its threshold. On the images where none does, templates of the same part
search the distances of the data set.
"""

from __future__ import annotations

import argparse
from itertools import chain
from pathlib import Path

import cv2
import numpy as np
import torch
from refine_real import HALVES, read_frames

from dopepp.geometry.camera import Transform, transform
from dopepp.inference.estimator import PoseEstimator
from dopepp.inference.template_estimator import TemplateEstimator
from dopepp.parts.part import Part
from dopepp.recovery.detection import Detection

SLACK = 1.03  # of the searched distances


def count_right(part: Part, detections: list[Detection], poses: list[Transform]) -> int:
    """Return how many detections have an ADD below a tenth of the diameter."""
    adds = [
        min(
            np.linalg.norm(
                transform(detection.T_cam_obj, part.points) - transform(T, part.points), axis=1
            ).mean()
            for T in poses
        )
        for detection in detections
        if poses
    ]
    return sum(add < 0.1 * part.diameter for add in adds)


def main() -> None:
    """Print how many poses of the network and of the templates are right and wrong."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--checkpoint", default="pretrained/pivconnector_wide")
    parser.add_argument("--split", default="train_pbr")
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    torch.set_num_threads(1)
    network = PoseEstimator.load(arguments.checkpoint, refine="region")
    (part,) = network.parts
    scenes = sorted((arguments.folder / arguments.split).iterdir())
    frames = list(chain.from_iterable(read_frames(scene, HALVES["both"]) for scene in scenes))
    depths = [float(T[2, 3]) for frame in frames for _, T in frame.objects]
    templates = TemplateEstimator.of_parts([part], (min(depths) / SLACK, max(depths) * SLACK))
    print("| method | images | right | wrong |\n| --- | ---: | ---: | ---: |")
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
        print(f"| {name} | {len(images)} | {right} | {wrong} |", flush=True)


if __name__ == "__main__":
    main()
