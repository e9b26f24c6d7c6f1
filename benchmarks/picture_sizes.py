"""The same scenes through cameras of other sizes: what a network finds, and what that costs.

    python benchmarks/picture_sizes.py [--checkpoint pretrained/NAME] [--preset wide] [--images 100]

Poses, light and sensor are those of scenes that the network was not trained on. Each camera's
shorter side has the field of view of the training's, so the part covers as much of it, and has more
or fewer pixels. ``any`` looks at all distances; the others where training had the parts.
"""

from __future__ import annotations

import argparse
import math
import statistics
import time
from dataclasses import replace

import cv2
import numpy as np
import torch

from dopepp.geometry.camera import resize_camera, transform
from dopepp.geometry.rotation import rotation_angle
from dopepp.inference.estimator import PoseEstimator
from dopepp.inference.picture import Distances, letterboxes
from dopepp.parts.catalogue import load_part
from dopepp.virtual import PRESETS, Factory, Scene, render
from dopepp.virtual.sensor import capture

SEED = 771
SIZES = ((640, 480), (320, 240), (1920, 1080), (1080, 1920), (2592, 1944))


def through(scene: Scene, size: tuple[int, int]) -> Scene:
    """Return a scene seen by a camera of (width, height) pixels."""
    rows, columns = scene.background.shape[:2]
    scale = min(size) / min(rows, columns)
    K = resize_camera(scene.K, scale, scale)
    K[:2, 2] = (np.array(size) - 1) / 2
    cover = max(size[0] / columns, size[1] / rows)
    background = cv2.resize(scene.background, None, fx=cover, fy=cover)
    background = background[: size[1], : size[0]]
    sensor = replace(
        scene.sensor,
        blur_px=scale * scene.sensor.blur_px,
        motion_px=(scale * scene.sensor.motion_px[0], scale * scene.sensor.motion_px[1]),
    )
    return replace(scene, K=K, background=np.ascontiguousarray(background), sensor=sensor)


def measure(
    estimator: PoseEstimator, scenes: list[Scene], distances: Distances | None = None
) -> str:
    """Return the figures of one camera: pixels looked at, ADD-0.1d, rotation, missed, time."""
    part = load_part(estimator.parts[0].name)
    passed, missed, turns, seconds = 0, 0, [], []
    for scene in scenes:
        image = capture(render(scene).image, scene.sensor)
        start = time.perf_counter()
        detections = estimator.predict(image, scene.K, distances=distances)[:1]
        seconds.append(time.perf_counter() - start)
        missed += not detections
        for detection in detections:
            true = scene.objects[scene.targets[0]].T_cam_obj
            away = transform(detection.T_cam_obj, part.points) - transform(true, part.points)
            passed += float(np.linalg.norm(away, axis=1).mean()) < 0.1 * part.diameter
            turn = rotation_angle(detection.T_cam_obj[:3, :3] @ true[:3, :3].T)
            turns.append(math.degrees(float(turn)))
    boxes = letterboxes(estimator.checkpoint, scenes[0].K, image, distances)
    sizes = ", ".join(f"{box.width}×{box.height}" for box in boxes)
    turn = f"{statistics.median(turns):.1f}" if turns else "–"
    rates = f"{passed / len(scenes):.1%} | {turn} | {missed / len(scenes):.1%}"
    return f"{sizes} | {rates} | {1e3 * statistics.median(seconds):.0f}"


def main() -> None:
    """Print a row for each camera."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--checkpoint", default="pretrained/pivconnector_wide")
    parser.add_argument("--preset", default="wide")
    parser.add_argument("--images", type=int, default=100)
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    torch.set_num_threads(1)
    estimator = PoseEstimator.load(arguments.checkpoint)
    preset = PRESETS[arguments.preset].resized(*estimator.checkpoint.input_size)
    factory = Factory([load_part(estimator.parts[0].name)], preset, SEED)
    scenes = [factory.scene(0, index) for index in range(arguments.images)]
    print("| camera | looks at | ADD-0.1d | rotation ° | missed | ms |\n" + "| --- " * 6 + "|")
    size = preset.width, preset.height
    print(f"| training's, {size[0]}×{size[1]} | {measure(estimator, scenes)} |", flush=True)
    for size in SIZES:
        row = measure(estimator, [through(scene, size) for scene in scenes])
        print(f"| {size[0]}×{size[1]} | {row} |", flush=True)
    large = [through(scene, (640, 480)) for scene in scenes]
    print(f"| 640×480, any | {measure(estimator, large, 'any')} |")


if __name__ == "__main__":
    main()
