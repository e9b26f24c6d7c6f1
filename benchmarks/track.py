"""Tracking on rendered sequences: accuracy, noise at rest, frames to recover, frames per second.

    python benchmarks/track.py [--seeds 3] [--first 0] [--views 2 [--perturbed]]

The part rests, is rotated (up to 8° per frame) and shifted (up to 5 % of its distance per frame),
passes behind a hand-sized occluder, is covered completely for 15 frames, and rests again, while the
light changes. Times are CPU times of one thread at 640×480, without rendering.

``--views`` compares ``ViewsTracker`` with ``predict_views`` on the images of fixed cameras, whose
viewing directions differ by 25°. Occluders are in front of the first camera. ``--perturbed`` adds
an error of 0.3 mm and 0.05° (standard deviations, which the estimators know) to each camera's pose.
"""

from __future__ import annotations

import argparse
import math
from argparse import Namespace
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
import trimesh
from common import pose_errors, print_head, print_row, timed, use_one_thread
from views import CAMERA_ERROR, perturbed

from dopepp.geometry.camera import (
    invert_transform,
    make_transform,
    orbited_camera,
    step_between,
)
from dopepp.geometry.rotation import rotation_angle, rotation_vector_to_matrix
from dopepp.inference.estimator import PoseEstimator
from dopepp.inference.several_views.views_tracker import ViewsTracker
from dopepp.inference.tracker import PoseTracker
from dopepp.parts.catalogue import load_part
from dopepp.parts.part import Mesh, Part
from dopepp.virtual import PRESETS, Factory, Scene, SceneObject, make_surface, render
from dopepp.virtual.scene import Light, Material
from dopepp.virtual.sensor import capture

SIZE = (640, 480)
REST = 60  # Number of frames at each end without motion
COVERED = range(190, 205)
PASSING = range(110, 160)
WITHIN = (5.0, 2.0)  # Largest errors of a correct pose, millimetres and degrees
LEAST_VISIBLE = 0.3  # Visible share of the part from which a frame is evaluated


@dataclass(frozen=True)
class Frame:
    """One frame: image, camera matrix, true pose and visible share of the part."""

    image: np.ndarray
    K: np.ndarray
    T: np.ndarray
    visible: float
    scene: Scene


def pose_at(frame: float, frames: int, rng: np.random.Generator) -> np.ndarray:
    """Return the pose of a smooth motion that rests at both ends."""
    phases = rng.uniform(0, 2 * math.pi, 6)
    # The motion starts and ends slowly.
    moving = np.clip(frame - REST, 0, frames - 2 * REST)
    length = max(frames - 2 * REST, 1)
    warped = moving - length / (2 * math.pi) * math.sin(2 * math.pi * moving / length)
    periods = (110, 90, 75, 140, 65, 120)
    swing = [
        math.sin(2 * math.pi * warped / period + phase)
        for period, phase in zip(periods, phases, strict=True)
    ]
    tilt = rotation_vector_to_matrix(np.array([0.45 * swing[0], 0.45 * swing[1], 0.0]))
    turn = rotation_vector_to_matrix(np.array([0.0, 0.0, 0.65 * swing[2]]))
    z = 0.19 + 0.04 * swing[3]
    position = np.array([0.25 * z * swing[4], 0.15 * z * swing[5], z])
    facing = np.diag([1.0, -1.0, -1.0])
    return make_transform(tilt @ turn @ facing, position)


def sequence(part: Part, seed: int, frames: int) -> Iterator[Frame]:
    """Render a sequence, which depends only on the seed."""
    factory = Factory([part], PRESETS["wide"].resized(*SIZE), seed)
    base = factory.scene(0, 0)
    target = base.objects[base.targets[0]]
    hand = trimesh.creation.icosphere(3)
    hand = make_surface(Mesh(hand.vertices * (0.02, 0.045, 0.015), hand.faces.astype(np.int32)))
    wall = trimesh.creation.box((0.4, 0.4, 0.01))
    wall = make_surface(Mesh(wall.vertices.copy(), wall.faces.astype(np.int32)))
    skin = Material(colour=(0.5, 0.28, 0.2))
    for frame in range(frames):
        T = pose_at(frame, frames, np.random.default_rng(seed))
        objects = [replace(target, T_cam_obj=T)]
        if frame in PASSING:
            share = (frame - PASSING.start) / len(PASSING)
            position = T[:3, 3] * 0.8 + np.array([0.16 * (share - 0.5), 0.0, 0.0])
            objects.append(SceneObject(hand, make_transform(np.eye(3), position), skin))
        if frame in COVERED:
            objects.append(SceneObject(wall, make_transform(np.eye(3), T[:3, 3] * 0.5), skin))
        wave = math.sin(2 * math.pi * frame / 80)
        lights = tuple(
            replace(light, position=(light.position[0] + 0.3 * wave, *light.position[1:]))
            for light in base.lights
        ) or (Light((0.3 * wave, -0.5, -0.2)),)
        sensor = replace(
            base.sensor,
            exposure_ev=base.sensor.exposure_ev + 0.4 * wave,
            noise_seed=frame,
            motion_px=(0.0, 0.0),
        )
        scene = Scene(base.K, base.background, tuple(objects), lights, base.ambient, sensor=sensor)
        rendered = render(scene)
        image = capture(rendered.image, sensor)
        yield Frame(image, base.K, T, float(rendered.visible_fractions[0]), scene)


def is_right(pose: np.ndarray | None, true: np.ndarray, part: Part) -> bool:
    """Return whether a pose is within the largest errors."""
    if pose is None:
        return False
    errors = pose_errors(pose, true, part.points)
    return errors.translation <= WITHIN[0] and errors.rotation <= WITHIN[1]


def measure(estimator: PoseEstimator, part: Part, seed: int, frames: int) -> list[str]:
    """Return one row of the table."""
    tracker = PoseTracker(estimator)
    right: list[bool] = []
    times: list[float] = []
    resting: list[np.ndarray] = []
    recovery = None
    for number, frame in enumerate(sequence(part, seed, frames)):
        tracks, milliseconds = timed(lambda frame=frame: tracker.track(frame.image, frame.K))
        times.append(milliseconds)
        pose = tracks[0].detection.T_cam_obj if tracks else None
        good = is_right(pose, frame.T, part)
        if frame.visible >= LEAST_VISIBLE:
            right.append(good)
        if pose is not None and 10 <= number < REST:
            resting.append(pose)
        if recovery is None and number >= COVERED.stop and good:
            recovery = number - COVERED.stop + 1
    # Differences between frames over √2, so that a slow drift does not count as noise.
    shifts = [
        float(np.linalg.norm(after[:3, 3] - before[:3, 3])) for before, after in pairwise(resting)
    ]
    turns = [
        float(rotation_angle(after[:3, :3] @ before[:3, :3].T))
        for before, after in pairwise(resting)
    ]
    return [
        str(seed),
        f"{np.mean(right):.1%}",
        f"{1e3 * _noise(shifts):.2f}",
        f"{math.degrees(_noise(turns)):.2f}",
        "never" if recovery is None else str(recovery),
        f"{1e3 / np.mean(times[1:]):.0f}",
        f"{np.median(times):.1f}",
        f"{np.percentile(times, 95):.1f}",
    ]


def compare_views(estimator: PoseEstimator, part: Part, seed: int, options: Namespace) -> float:
    """Print a row for tracking and for single sets; return the ratio of their CPU times."""
    centre = np.array([0.0, 0.0, 0.19])
    orbits = [
        orbited_camera(centre, math.radians(25), n * math.pi / 2) for n in range(options.views - 1)
    ]
    T_new_cam = [np.eye(4), *orbits]
    poses, error = [invert_transform(T) for T in T_new_cam], (0.0, 0.0)
    if options.perturbed:
        rng, error = np.random.default_rng(seed), CAMERA_ERROR
        poses = [perturbed(T, rng) for T in poses]
    tracker = ViewsTracker(estimator)
    calls = {"tracked": tracker.track, "single sets": estimator.predict_views}
    rows = {name: list[tuple[float, ...]]() for name in calls}
    for number, frame in enumerate(sequence(part, seed, options.frames)):
        images = [frame.image]
        for T in T_new_cam[1:]:
            view = frame.scene.seen_from(T)
            images.append(capture(render(view).image, view.sensor))
        for name, call in calls.items():
            given = images, [frame.K] * options.views, poses
            result, ms = timed(lambda call=call, given=given: call(*given, camera_error=error))
            errors, surprise = (math.inf,) * 3, math.nan
            if result.detections:
                found = result.detections[0]
                errors = pose_errors(found.T_world_obj, frame.T, part.points)
                step = step_between(found.T_world_obj, frame.T)
                surprise = float(step @ np.linalg.solve(found.covariance, step)) / 6
            if number:  # the first set warms up
                rows[name].append((*errors, surprise, ms))
    for name, values in rows.items():
        rotation, shift, _, surprise, ms = np.array(values).T
        good = (shift <= WITHIN[0]) & (rotation <= WITHIN[1])
        cells = [
            f"{np.median(e[good]):.2f} ({np.quantile(e[good], 0.9):.2f})" for e in (shift, rotation)
        ]
        normalised = math.sqrt(surprise[good].mean())
        print_row(seed, name, f"{good.mean():.1%}", *cells, f"{normalised:.2f}", f"{ms.mean():.1f}")
    return float(np.sum(rows["tracked"], axis=0)[-1] / np.sum(rows["single sets"], axis=0)[-1])


def _noise(steps: list[float]) -> float:
    """Return the RMS noise of a frame, given differences between frames; NaN without any."""
    return math.sqrt(sum(step**2 for step in steps) / len(steps) / 2) if steps else math.nan


def main() -> None:
    """Print a row per seed."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--first", type=int, default=0, help="first seed")
    parser.add_argument("--frames", type=int, default=300)
    parser.add_argument("--views", type=int, default=1, help="number of cameras")
    parser.add_argument("--perturbed", action="store_true", help="errors of the camera poses")
    arguments = parser.parse_args()
    use_one_thread()
    estimator = PoseEstimator.load("pretrained/pivconnector_wide")
    part = load_part(estimator.parts[0].name)
    estimator = estimator.refining("region", [part])
    seeds = range(arguments.first, arguments.first + arguments.seeds)
    if arguments.views > 1:
        print_head(
            "seed", "poses", "within 5 mm and 2°", "mm (90 %)", "° (90 %)", "normalised", "ms",
        )  # fmt: skip
        ratios = [compare_views(estimator, part, seed, arguments) for seed in seeds]
        print(f"\nCPU time, tracked / single sets: {np.mean(ratios):.3f}")
        return
    print_head(
        "seed", "within 5 mm and 2°", "at rest mm", "at rest °", "frames to recover", "frames/s",
        "ms p50", "p95",
    )  # fmt: skip
    for seed in seeds:
        print_row(*measure(estimator, part, seed, arguments.frames))


if __name__ == "__main__":
    main()
