"""Frames per second of a stream, with and without detection in the next frame during refinement.

    python benchmarks/stream.py [NETWORK ...] [--rounds 5]

A network is a checkpoint or an export of ``pivconnector`` (default: ``pretrained/pivconnector``).
The frames are 640×480 renders. Both sides take turns in one process, estimate the same poses, and
are compared by the median of their rounds.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Iterator

import numpy as np
from common import print_head, print_row

from dopepp import PoseEstimator
from dopepp.data.rendered import RenderedSource
from dopepp.geometry.camera_file import Camera
from dopepp.inference.frames import CameraFrame, FrameSource
from dopepp.inference.frames.source import Lens
from dopepp.inference.pose_result import PoseResult
from dopepp.inference.stream import FrameEstimator
from dopepp.parts.catalogue import pivconnector
from dopepp.virtual import PRESETS, Factory

NUM_SCENES = 40


class Renders(FrameSource):
    """Frame source of rendered scenes with one camera."""

    name = stem = "renders"
    count = NUM_SCENES

    def __init__(self) -> None:
        factory = Factory([pivconnector()], PRESETS["quickstart"].reframed(640, 480), 5)
        scenes = RenderedSource(factory, NUM_SCENES, "test")
        self.samples = [scenes.sample(number) for number in range(NUM_SCENES)]

    def frames(self, stride: int = 1) -> Iterator[CameraFrame]:
        """Yield the scenes in order."""
        for number, sample in enumerate(self.samples):
            yield CameraFrame(sample.image, self.name, number)


def main() -> None:
    """Print a table with a row for each network."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("networks", nargs="*", default=["pretrained/pivconnector"])
    parser.add_argument("--rounds", type=int, default=5, help=f"of {NUM_SCENES} frames")
    asked = parser.parse_args()
    renders = Renders()
    camera = Camera(None, renders.samples[0].K, (), "renders")
    print_head("network", "frames/s, one after the other", "overlapped", "ratio", "detections")
    for path in asked.networks:
        estimator = PoseEstimator.load(path, refine="region")
        frame_estimator = FrameEstimator(estimator, {}, Lens(camera).undistort)
        sides = {
            "sequential": lambda each=frame_estimator: map(each, renders.frames()),
            "overlapped": lambda each=estimator: each.stream(renders, camera=camera),
        }
        rates: dict[str, list[float]] = {side: [] for side in sides}
        found: dict[str, list[PoseResult]] = {}
        for number in range(asked.rounds + 1):
            for side, results in sides.items():
                start = time.perf_counter()
                found[side] = list(results())
                if number > 0:  # the first round allocates and compiles
                    rates[side].append(NUM_SCENES / (time.perf_counter() - start))
        poses = {
            side: [pose.T_cam_obj for item in results for pose in item.detections]
            for side, results in found.items()
        }
        assert np.array_equal(*poses.values())
        before, after = (statistics.median(rates[side]) for side in sides)
        ratio = f"{after / before:.2f}"
        print_row(path, f"{before:.1f}", f"{after:.1f}", ratio, len(poses["overlapped"]))


if __name__ == "__main__":
    main()
