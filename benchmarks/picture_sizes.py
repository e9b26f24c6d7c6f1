"""Accuracy and time of a network on the same scenes in cameras of different sizes.

    python benchmarks/picture_sizes.py

The scenes were not used in training. The shorter side of each camera has the field of view of the
training's camera, so the part covers the same share of it with more or fewer pixels. The row
``any`` searches all distances; the other rows search the trained distances.
"""

from __future__ import annotations

import statistics
import time
from dataclasses import replace

import cv2
import numpy as np
from common import pose_errors, print_head, print_row, use_one_thread

from dopepp.geometry.camera import resize_camera
from dopepp.inference.estimator import PoseEstimator
from dopepp.inference.input_image import Distances
from dopepp.parts.catalogue import load_part
from dopepp.virtual import PRESETS, Factory, Scene, render
from dopepp.virtual.sensor import capture

SEED, NUM_IMAGES = 771, 100
SIZES = ((640, 480), (320, 240), (1920, 1080), (1080, 1920), (2592, 1944))


def with_camera(scene: Scene, size: tuple[int, int]) -> Scene:
    """Return a scene in a camera of (width, height) pixels."""
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
) -> list[str]:
    """Return input sizes, ADD-0.1d, median rotation error, missed parts and time of a camera."""
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
            errors = pose_errors(detection.T_cam_obj, true, part.points)
            passed += errors.add < 100 * part.diameter
            turns.append(errors.rotation)
    boxes = [view.box for view in estimator.views(image, scenes[0].K, distances)]
    sizes = ", ".join(f"{box.width}×{box.height}" for box in boxes)
    turn = f"{statistics.median(turns):.1f}" if turns else "–"
    rates = [f"{passed / len(scenes):.1%}", turn, f"{missed / len(scenes):.1%}"]
    return [sizes, *rates, f"{1e3 * statistics.median(seconds):.0f}"]


def main() -> None:
    """Print a row per camera."""
    use_one_thread()
    estimator = PoseEstimator.load("pretrained/pivconnector_wide")
    preset = PRESETS["wide"].resized(*estimator.checkpoint.input_size)
    factory = Factory([load_part(estimator.parts[0].name)], preset, SEED)
    scenes = [factory.scene(0, index) for index in range(NUM_IMAGES)]
    print_head("camera", "network input", "ADD-0.1d", "rotation °", "missed", "ms")
    print_row(f"training's, {preset.width}×{preset.height}", *measure(estimator, scenes))
    for size in SIZES:
        row = measure(estimator, [with_camera(scene, size) for scene in scenes])
        print_row(f"{size[0]}×{size[1]}", *row)
    large = [with_camera(scene, (640, 480)) for scene in scenes]
    print_row("640×480, any", *measure(estimator, large, "any"))


if __name__ == "__main__":
    main()
