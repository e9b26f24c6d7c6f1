"""False detections of a network on camera frames without its part, by kind of frame.

python benchmarks/silence.py outputs/dopepp_fast_virtual/RUN/checkpoints/best.ckpt --num-frames 90
"""

from __future__ import annotations

import argparse
from collections import defaultdict

import numpy as np
from common import print_head, print_row

from dopepp.data.negatives import PhotoFrames
from dopepp.data.sample import SampleSource
from dopepp.experiment.assembly.build_parts import build_parts
from dopepp.experiment.assembly.negative_frames import frame_view, negative_frames
from dopepp.experiment.config.data_config import evaluation_data, stored_config
from dopepp.inference.estimator import PoseEstimator
from dopepp.virtual.backgrounds import PhotoBackgrounds, find_backgrounds


def main() -> None:
    """Print a row per kind of frame, for the network and for refined poses."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("checkpoint")
    parser.add_argument("--num-frames", type=int, default=90)
    options = parser.parse_args()
    network = PoseEstimator.load(options.checkpoint)
    data = evaluation_data({}, {}, stored_config(network.checkpoint.data), options.checkpoint)
    parts = build_parts(data)
    sources: list[SampleSource] = [negative_frames(data, parts, "test", options.num_frames)]
    photos = find_backgrounds(data.virtual.backgrounds, "train")
    if isinstance(photos, PhotoBackgrounds):
        view = frame_view(data, parts)
        count = min(len(photos.paths), options.num_frames)
        sources.append(PhotoFrames(photos, view.K, view.size, count, "photos of the training"))
    for estimator in (network, network.refining("region", parts)):
        highest, reported = defaultdict(list), defaultdict(list)
        for source in sources:
            for index in range(len(source)):
                sample = source.sample(index)
                candidates = estimator.candidates(sample.image, sample.K, cropped=True)
                passed = estimator.split(candidates)[0]
                highest[sample.source].append(max((each.score for each in candidates), default=0.0))
                reported[sample.source].append(len(passed))
        print(f"refine={estimator.refine}, threshold {estimator.min_score:.3g}")
        print_head("kind", "frames", "detections/frame", "highest score: median", "90 %", "max")
        for kind, scores in highest.items():
            values = np.mean(reported[kind]), *np.quantile(scores, (0.5, 0.9)), max(scores)
            print_row(kind, len(scores), *(f"{value:.3f}" for value in values))


if __name__ == "__main__":
    main()
