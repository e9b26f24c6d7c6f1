"""What ``dopepp doctor`` finds first on rendered images with known faults.

    python benchmarks/doctor.py [--images 40] [--seed 81] [--preset quickstart] [--size 640 480]
                                [--model pretrained/pivconnector] [--faults blur dark …]

A row a fault: on how many images nothing was wrong, and what was wrong first on the others.
"""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import cv2
import numpy as np

from dopepp import PoseEstimator
from dopepp.drawing.pictures import RGBImage
from dopepp.geometry.camera import CameraMatrix, project_keypoints
from dopepp.inference.diagnosis import Case, diagnose
from dopepp.parts.catalogue import load_part
from dopepp.virtual import PRESETS, Factory
from dopepp.virtual.presets import Preset
from dopepp.virtual.scene import Rendered
from dopepp.virtual.sensor import Sensor, capture, defocus


class Taken(NamedTuple):
    """An image and what is said of its camera."""

    image: RGBImage
    K: CameraMatrix


class Studio:
    """Renders images of one part, with it and without."""

    def __init__(self, part: str, preset: Preset, seed: int) -> None:
        parts = [load_part(part)]
        self.cuboid = parts[0].cuboid
        self.factory = Factory(parts, preset, seed)
        self.empty = Factory(parts, replace(preset, targets_per_image=(0, 0)), seed + 1)

    def good(self, index: int) -> Taken:
        """Return an image without a fault."""
        return _taken(self.factory.render(0, index))

    def absent(self, index: int) -> Taken:
        """Return one without the part."""
        return _taken(self.empty.render(0, index))

    def sized(self, scale: float) -> Callable[[int], Taken]:
        """Return images with the part so many times as large."""
        return lambda index: _taken(self.factory.render(0, index, scale))

    def hidden(self, index: int) -> Taken:
        """Cover two thirds of the part's box with another image's background."""
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
        return Taken(image, scene.K)

    def lens(self, factor: float) -> Callable[[int], Taken]:
        """Return good images with a K whose focal lengths are so many times as long."""

        def taken(index: int) -> Taken:
            image, K = self.good(index)
            K = K.copy()
            K[[0, 1], [0, 1]] *= factor
            return Taken(image, K)

        return taken

    def spoilt(self, how: Callable[[RGBImage], RGBImage]) -> Callable[[int], Taken]:
        """Return good images after something was done to them."""

        def taken(index: int) -> Taken:
            image, K = self.good(index)
            return Taken(how(image), K)

        return taken

    def faults(self) -> dict[str, Callable[[int], Taken]]:
        """Return how an image with each fault is taken."""
        return {
            "none": self.good,
            "blur of 2 px": self.spoilt(lambda image: defocus(image, 2.0)),
            "blur of 5 px": self.spoilt(lambda image: defocus(image, 5.0)),
            "a 16th of the light": self.spoilt(lambda image: capture(image, Sensor(-4.0))),
            "8 times the light": self.spoilt(lambda image: capture(image, Sensor(3.0))),
            "K twice as long": self.lens(2.0),
            "K half as long": self.lens(0.5),
            "part 0.4 times as large": self.sized(0.4),
            "part 1.5 times as large": self.sized(1.5),
            "part 2 times as large": self.sized(2.0),
            "two thirds hidden": self.hidden,
            "without the part": self.absent,
        }


def main() -> None:
    """Print a row for every fault."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--images", type=int, default=40, help="a fault")
    parser.add_argument("--seed", type=int, default=81)
    parser.add_argument("--model", default="pretrained/pivconnector")
    parser.add_argument("--part", default="pivconnector")
    parser.add_argument("--preset", default="quickstart")
    parser.add_argument("--size", type=int, nargs=2, help="width height; else the network's")
    parser.add_argument("--faults", nargs="+", default=[""], help="those with one of these words")
    parser.add_argument("--show", action="store_true", help="print every finding")
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    estimator, preset = PoseEstimator.load(arguments.model), PRESETS[arguments.preset]
    size = arguments.size or estimator.checkpoint.input_size
    studio = Studio(arguments.part, preset.reframed(*size), arguments.seed)
    print("| fault | nothing wrong | first finding |")
    print("| --- | ---: | --- |")
    for name, take in studio.faults().items():
        if not any(word in name for word in arguments.faults):
            continue
        firsts: Counter[str] = Counter()
        for index in range(arguments.images):
            image, K = take(index)
            wrong = [
                finding
                for finding in diagnose(Case(estimator, image, K, estimator.parts))
                if finding.fix
            ]
            firsts[wrong[0].subject if wrong else ""] += 1
            if arguments.show:
                print(index, *wrong, sep="\n    ")
        fine = firsts.pop("", 0)
        listed = ", ".join(f"{subject} {count}" for subject, count in firsts.most_common())
        print(f"| {name} | {fine} of {arguments.images} | {listed} |", flush=True)


def _taken(rendered: Rendered) -> Taken:
    return Taken(rendered.image, rendered.scene.K)


if __name__ == "__main__":
    main()
