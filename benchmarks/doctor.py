"""First finding of ``dopepp doctor`` on rendered images with a known fault.

    python benchmarks/doctor.py [--images 40] [--seed 81]

Each row has a fault, the number of images without a finding, and how often each check was the
first finding.
"""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import cv2
import numpy as np
from common import print_head, print_row

from dopepp import PoseEstimator
from dopepp.drawing.pictures import RGBImage
from dopepp.geometry.camera import CameraMatrix, project_keypoints
from dopepp.inference.diagnosis import Case, diagnose
from dopepp.parts.catalogue import load_part
from dopepp.virtual import PRESETS, Factory
from dopepp.virtual.presets import Preset
from dopepp.virtual.scene import Rendered
from dopepp.virtual.sensor import Sensor, capture, defocus


class FaultyImage(NamedTuple):
    """An image and the camera matrix that is passed to the doctor."""

    image: RGBImage
    K: CameraMatrix


class FaultRenderer:
    """Renders images of one part with each fault.

    Args:
        part: Built-in part.
        preset: Preset of the scenes.
        seed: Seed of the scenes.
    """

    def __init__(self, part: str, preset: Preset, seed: int) -> None:
        parts = [load_part(part)]
        self.cuboid = parts[0].cuboid
        self.factory = Factory(parts, preset, seed)
        self.empty = Factory(parts, replace(preset, targets_per_image=(0, 0)), seed + 1)

    def good(self, index: int) -> FaultyImage:
        """Return an image without a fault."""
        return _image_and_camera(self.factory.render(0, index))

    def absent(self, index: int) -> FaultyImage:
        """Return an image without the part."""
        return _image_and_camera(self.empty.render(0, index))

    def sized(self, scale: float) -> Callable[[int], FaultyImage]:
        """Return a function that renders the part larger by a factor."""
        return lambda index: _image_and_camera(self.factory.render(0, index, scale))

    def hidden(self, index: int) -> FaultyImage:
        """Return an image with two thirds of the part's box covered by another background."""
        rendered = self.factory.render(0, index)
        scene, image = rendered.scene, rendered.image.copy()
        T = scene.objects[scene.targets[0]].T_cam_obj
        points = project_keypoints(self.cuboid, T, scene.K)
        size = np.array(image.shape[1::-1])
        low, high = (np.clip(f(points, axis=0), 0, size).astype(int) for f in (np.min, np.max))
        cover = ((high - low) * np.sqrt(2 / 3)).astype(int)
        x, y = np.random.default_rng(index).integers(low, high - cover + 1)
        region = np.s_[y : y + cover[1], x : x + cover[0]]
        image[region] = self.empty.render(0, index).image[region]
        return FaultyImage(image, scene.K)

    def lens(self, factor: float) -> Callable[[int], FaultyImage]:
        """Return a function that multiplies the focal lengths in K by a factor."""

        def render(index: int) -> FaultyImage:
            image, K = self.good(index)
            K = K.copy()
            K[[0, 1], [0, 1]] *= factor
            return FaultyImage(image, K)

        return render

    def changed(self, change: Callable[[RGBImage], RGBImage]) -> Callable[[int], FaultyImage]:
        """Return a function that applies a change to an image without a fault."""

        def render(index: int) -> FaultyImage:
            image, K = self.good(index)
            return FaultyImage(change(image), K)

        return render

    def faults(self) -> dict[str, Callable[[int], FaultyImage]]:
        """Return, by fault, the function that renders the image with a given index."""
        return {
            "none": self.good,
            "blur of 2 px": self.changed(lambda image: defocus(image, 2.0)),
            "blur of 5 px": self.changed(lambda image: defocus(image, 5.0)),
            "a 16th of the light": self.changed(lambda image: capture(image, Sensor(-4.0))),
            "8 times the light": self.changed(lambda image: capture(image, Sensor(3.0))),
            "K twice as long": self.lens(2.0),
            "K half as long": self.lens(0.5),
            "part 0.4 times as large": self.sized(0.4),
            "part 1.5 times as large": self.sized(1.5),
            "part 2 times as large": self.sized(2.0),
            "two thirds hidden": self.hidden,
            "without the part": self.absent,
        }


def main() -> None:
    """Print a row per fault."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--images", type=int, default=40, help="images per fault")
    parser.add_argument("--seed", type=int, default=81)
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    estimator = PoseEstimator.load("pretrained/pivconnector")
    preset = PRESETS["quickstart"].reframed(*estimator.checkpoint.input_size)
    renderer = FaultRenderer("pivconnector", preset, arguments.seed)
    print_head("fault", "no finding", "first finding")
    for name, take in renderer.faults().items():
        firsts: Counter[str] = Counter()
        for index in range(arguments.images):
            image, K = take(index)
            results = diagnose(Case(estimator, image, K, estimator.parts))
            findings = [result for result in results if result.fix]
            firsts[findings[0].subject if findings else ""] += 1
        fine = firsts.pop("", 0)
        listed = ", ".join(f"{subject} {count}" for subject, count in firsts.most_common())
        print_row(name, f"{fine} of {arguments.images}", listed)


def _image_and_camera(rendered: Rendered) -> FaultyImage:
    return FaultyImage(rendered.image, rendered.scene.K)


if __name__ == "__main__":
    main()
