"""Refinement on depth: ADD before and after, on rendered depth and on real frames.

    python benchmarks/depth.py [--poses 200] [--seed 41] [--ycb FOLDER] [--draws 10]

Rendered: the part is in mid-air without a background, in front of a wall, or flat on a table. The
depth has the noise of a structured-light camera: σ = 1.5 mm at 0.75 m, growing with the square of
the distance, steps of 1 mm, no depth at edges and at grazing angles. Half of the images have an
occluder. Start poses are shifted by 12–16 mm, mostly along the viewing ray, and rotated by 3–5°.

Real: start poses are shifted by 10 mm and rotated by 5°, both in random directions. Times are CPU
times of one thread.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
from common import pose_errors, print_head, print_row, timed
from scipy.spatial import KDTree

from dopepp.data.formats.ycb_video import read_classes
from dopepp.data.formats.ycb_video.ycb_reader import YcbVideoReader
from dopepp.geometry.camera import camera_matrix, make_transform, transform
from dopepp.geometry.rotation import random_rotation, rotation_vector_to_matrix
from dopepp.inference.refinement.refiner import PartRefiner
from dopepp.parts.catalogue import pivconnector, servoholder
from dopepp.parts.mesh.read import ycb_part
from dopepp.parts.part import Mesh, Part, make_part
from dopepp.virtual.body import make_body
from dopepp.virtual.renderers.raster import render
from dopepp.virtual.scene import Plane, Scene, SceneObject

SIZE = (640, 480)
PLACES = ("air", "wall", "table")
LEAST_VISIBLE = 0.3
BLACK = np.zeros((SIZE[1], SIZE[0], 3), np.uint8)
Array = np.ndarray


def box() -> Part:
    """Return a box of the size of YCB's cracker box."""
    half = np.array([0.082, 0.107, 0.036])
    signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    faces = [[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1], [2, 3, 7],
             [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3]]  # fmt: skip
    return make_part("box", Mesh(signs * half, np.array(faces, np.int32)))


def structured_light(depth: Array, rng: np.random.Generator) -> Array:
    """Return a depth image with the noise of a structured-light camera, metres; 0 is unknown."""
    noisy = depth + rng.normal(size=depth.shape) * 1.5e-3 * (depth / 0.75) ** 2
    noisy = np.round(noisy, 3)
    step_x = np.abs(np.gradient(depth, axis=1))
    step_y = np.abs(np.gradient(depth, axis=0))
    # A depth step of four pixel widths between neighbours is an edge, or a surface seen at 76°.
    wide = 4 * depth / 600
    lost = ((step_x > wide) | (step_y > wide)) & (rng.random(depth.shape) < 0.9)
    lost |= rng.random(depth.shape) < 0.02
    return np.where(lost | (depth <= 0), 0, noisy).astype(np.float32)


def start_pose(
    T: Array,
    rng: np.random.Generator,
    shift: tuple[float, float],
    turn_deg: tuple[float, float],
    along: float,
) -> Array:
    """Return a shifted (metres) and rotated pose; ``along`` weights the viewing ray."""
    ray = T[:3, 3] / np.linalg.norm(T[:3, 3])
    direction = rng.normal(size=3)
    direction += (along - 1) * ray * (direction @ ray)
    direction *= rng.uniform(*shift) / np.linalg.norm(direction)
    axis = rng.normal(size=3)
    axis *= math.radians(rng.uniform(*turn_deg)) / np.linalg.norm(axis)
    return make_transform(rotation_vector_to_matrix(axis) @ T[:3, :3], T[:3, 3] + direction)


def scenes(
    part: Part, setting: str, count: int, seed: int
) -> Iterator[tuple[Array, Array, Array, np.random.Generator]]:
    """Yield noisy depth, K, true pose and random generator of scenes with a part."""
    body, other = (make_body(solid, is_target=False) for solid in (part, servoholder()))
    K = camera_matrix(600, 600, SIZE[0] / 2 - 0.5, SIZE[1] / 2 - 0.5)
    number, num_scenes = 0, 0
    while num_scenes < count:
        rng = np.random.default_rng([seed, number, PLACES.index(setting)])
        number += 1
        pixel = rng.uniform(0.3, 0.7, 2) * SIZE
        z = rng.uniform(0.45, 0.9)
        t = z * np.array([*((pixel - K[:2, 2]) / 600), 1.0])
        T, plane = _posed(part, t, setting, rng)
        objects = [SceneObject(body.surface, T, part=part)]
        if rng.random() < 0.5:
            angle = rng.uniform(0, 2 * math.pi)
            aside = part.diameter * rng.uniform(0.3, 0.6)
            position = t + aside * np.array([math.cos(angle), math.sin(angle), 0])
            T_other = make_transform(random_rotation(rng), position * rng.uniform(0.75, 0.9))
            objects.append(SceneObject(other.surface, T_other))
        rendered = render(Scene(K, BLACK, tuple(objects), plane=plane))
        if rendered.visible_fractions[0] >= LEAST_VISIBLE:
            num_scenes += 1
            yield structured_light(rendered.depth, rng), K, T, rng


def _posed(
    part: Part, t: Array, setting: str, rng: np.random.Generator
) -> tuple[Array, Plane | None]:
    """Return a pose at a position, and the plane behind or under the part."""
    T = make_transform(random_rotation(rng), t)
    if setting == "air":
        return T, None
    if setting == "wall":
        return T, Plane((0.0, 0.0, -1.0), -float(t[2] + rng.uniform(0.15, 0.6)))
    tilt, azimuth = math.radians(rng.uniform(0, 50)), rng.uniform(0, 2 * math.pi)
    across = math.sin(tilt) * np.array([math.cos(azimuth), math.sin(azimuth)])
    normal = np.array([*across, -math.cos(tilt)])
    # The part lies on its front or back, with a random rotation about the table's normal.
    x = np.cross(normal, [0.0, 1.0, 0.2])
    x /= np.linalg.norm(x)
    flat = np.stack([x, np.cross(normal, x), normal], axis=1)
    turn = rotation_vector_to_matrix(np.array([0, 0, rng.uniform(0, 2 * math.pi)]))
    side = np.diag([1.0, -1.0, -1.0]) if rng.random() < 0.5 else np.eye(3)
    T = make_transform(flat @ turn @ side, t)
    assert part.mesh is not None
    return T, Plane(
        tuple(normal.tolist()), float((transform(T, part.mesh.vertices) @ normal).min())
    )


def rendered_row(part: Part, setting: str, count: int, seed: int) -> list[str]:
    """Return the table's row for a part in mid-air, in front of a wall or on a table."""
    refiner, rows = PartRefiner(part, ["depth"]), []
    for depth, K, T, rng in scenes(part, setting, count, seed):
        start = start_pose(T, rng, (0.012, 0.016), (3, 5), along=4)
        refined, milliseconds = timed(
            lambda K=K, start=start, depth=depth: refiner.refine(BLACK, K, start, depth=depth)
        )
        adds = [pose_errors(pose, T, part.points).add for pose in (start, refined.T_cam_obj)]
        rows.append((*adds, milliseconds, bool(refined.reason)))
    before, after, took, kept = np.array(rows).T
    limit = 50 * part.diameter
    shares = [f"{np.mean(errors < limit):.2f}" for errors in (before, after)]
    medians = [f"{np.median(errors):.1f}" for errors in (before, after)]
    rest = f"{np.mean(after > before):.1%}", f"{np.mean(kept):.0%}", f"{np.median(took):.1f}"
    return [part.name, setting, *shares, *medians, *rest]


def real_rows(root: Path, draws: int, seed: int) -> Iterator[list[str]]:
    """Yield a row for each object in the frames of a YCB-Video folder."""
    parts = {name: ycb_part(root, name) for name in read_classes(root)}
    frames = sorted(
        str(path.relative_to(root / "data"))[: -len("-color.png")]
        for path in (root / "data").rglob("*-color.png")
    )
    source = YcbVideoReader(root, list(parts.values()), image_set=frames)
    refiners = {name: PartRefiner(part, ["depth"]) for name, part in parts.items()}
    for number in range(len(source)):
        sample = source.sample(number)
        assert sample.depth is not None
        for instance in sample.instances:
            part, errors = parts[instance.label], []
            for draw in range(draws):
                rng = np.random.default_rng([seed, number, draw])
                start = start_pose(instance.T_cam_obj, rng, (0.01, 0.01), (5, 5), along=1)
                refined = refiners[part.name].refine(
                    sample.image, sample.K, start, depth=sample.depth
                )
                both = [(pose, instance.T_cam_obj) for pose in (start, refined.T_cam_obj)]
                adds = [pose_errors(pose, true, part.points).add for pose, true in both]
                errors.append([*adds, *(add_s_mm(part, pose, true) for pose, true in both)])
            yield [sample.key, part.name, *(f"{value:.1f}" for value in np.median(errors, axis=0))]


def add_s_mm(part: Part, estimate: Array, truth: Array) -> float:
    """Return ADD-S in millimetres."""
    nearest = KDTree(transform(estimate, part.points)).query(transform(truth, part.points))[0]
    return 1e3 * float(np.mean(nearest))


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--poses", type=int, default=200, help="poses per row")
    parser.add_argument("--seed", type=int, default=41)
    parser.add_argument("--ycb", type=Path, help="YCB-Video folder, for the second table")
    parser.add_argument("--draws", type=int, default=10, help="start poses per real object")
    options = parser.parse_args()
    cv2.setNumThreads(1)
    print_head(
        "part", "place", "ADD-0.05d before", "after", "median mm before", "after", "worse", "kept",
        "ms",
    )  # fmt: skip
    for part in (box(), servoholder(), pivconnector()):
        for setting in PLACES:
            print_row(*rendered_row(part, setting, options.poses, options.seed))
    if options.ycb is not None:
        print()
        print_head("frame", "object", "ADD mm before", "after", "ADD-S mm before", "after")
        for row in real_rows(options.ycb, options.draws, options.seed):
            print_row(*row)


if __name__ == "__main__":
    main()
