"""Refinement on real frames of a BOP data set.

    python benchmarks/refine_real.py FOLDER [--checkpoint CKPT] [--half even]

Start poses are the detections of a network (``--checkpoint``). Without a network, they are drawn
around the published poses: shifted by 10 mm and rotated by 5°, both in random directions. With
``--from-truth``, they are the published poses; adding ``--scale-errors 1e-6`` measures how well
images and annotation agree. The refinement uses RGB only, and objects that are at least half
visible. Errors are relative to the nearest equivalent of the published pose.

"Distance" is the error along the viewing ray. If it is equal in all frames, the annotation has
another scale than camera and CAD file. "Shape" requires depth images: the median deviation of the
measured depth from the mesh, after subtraction of its median. It does not depend on the annotation.
Parameters are chosen on ``--half even`` and reported on
``--half odd``. Published rotations that are not exactly orthogonal are replaced by the nearest
rotation.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Iterator, Sequence
from itertools import product
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import torch
from common import pose_errors, print_head, print_row, random_step, timed

from dopepp.core.json import read_json
from dopepp.data.formats.bop.bop_models import bop_parts, parts_by_id
from dopepp.data.sample import Instance
from dopepp.drawing.pictures import RGBImage, read_rgb
from dopepp.geometry.camera import (
    CameraMatrix,
    Transform,
    make_transform,
    move_pose,
    project,
    project_keypoints,
    transform,
)
from dopepp.geometry.rotation import nearest_rotation
from dopepp.geometry.symmetry import symmetry_group
from dopepp.inference.estimator import PoseEstimator
from dopepp.inference.input_image import read_depth_image
from dopepp.inference.refinement.creases import SharpEdges
from dopepp.inference.refinement.outline import make_outline_mesh, posed
from dopepp.inference.refinement.refiner import Refiner
from dopepp.inference.refinement.region import RegionRefiner
from dopepp.inference.refinement.region.shared_errors import SCALE_ERROR
from dopepp.metrics.functional import mahalanobis
from dopepp.metrics.pose import assign
from dopepp.parts.part import Part
from dopepp.recovery.detection import Detection

TURN, SHIFT = math.radians(5.0), 0.010
LEAST_VISIBLE = 0.5
WORSE_MM = 1.0
SEED = 5
COVARIANCE = np.diag(np.repeat([TURN**2 / 3, SHIFT**2 / 3], 3))
HALVES = {"both": slice(None), "even": slice(0, None, 2), "odd": slice(1, None, 2)}


class Frame(NamedTuple):
    """One frame with the model numbers and poses of its sufficiently visible objects."""

    image: RGBImage
    depth: np.ndarray | None  # metres along z, 0 where unknown
    K: CameraMatrix
    objects: list[tuple[int, Transform]]


class Refined(NamedTuple):
    """A start pose and its refined pose."""

    start: Transform
    end: Transform
    covariance: np.ndarray | None  # None if the start pose was kept


def read_frames(scene: Path, half: slice) -> Iterator[Frame]:
    """Yield the frames of a scene."""
    truth, cameras = (read_json(scene / f"scene_{name}.json") for name in ("gt", "camera"))
    info = scene / "scene_gt_info.json"
    visible = read_json(info) if info.exists() else {}
    for image in list(truth)[half]:
        objects = []
        for number, annotation in enumerate(truth[image]):
            if not visible or visible[image][number]["visib_fract"] >= LEAST_VISIBLE:
                R = nearest_rotation(np.reshape(annotation["cam_R_m2c"], (3, 3)))
                T = make_transform(R, np.array(annotation["cam_t_m2c"]) / 1000)
                objects.append((annotation["obj_id"], T))
        pixels = read_rgb(next((scene / "rgb").glob(f"{int(image):06d}.*")))
        measured = scene / "depth" / f"{int(image):06d}.png"
        scale = 1e-3 * cameras[image].get("depth_scale", 1.0)
        depth = read_depth_image(measured, scale) if measured.exists() else None
        K = np.reshape(cameras[image]["cam_K"], (3, 3)).astype(float)
        yield Frame(pixels, depth, K, objects)


def read_scenes(folder: Path, split: str, half: str = "both") -> Iterator[Frame]:
    """Yield the frames of all scenes of a split; ``half`` is a key of :data:`HALVES`."""
    for scene in sorted((folder / split).iterdir()):
        yield from read_frames(scene, HALVES[half])


class DrawnStarts:
    """Start poses around the published poses, or equal to them."""

    def __init__(
        self, parts: dict[int, Part], limits: Sequence[float], spread: float, from_truth: bool
    ) -> None:
        meshes = {n: part.mesh for n, part in parts.items() if part.mesh is not None}
        self.refiners = {
            (n, limit): RegionRefiner(mesh.vertices, mesh.faces, limit)
            for (n, mesh), limit in product(meshes.items(), limits)
        }
        self.spread, self.from_truth = spread, from_truth
        self.rng = np.random.default_rng(SEED)

    def starts(self, frame: Frame) -> Iterator[tuple[int, Transform, Transform]]:
        """Yield model number, true pose and start pose of each object."""
        for number, true in frame.objects:
            step = random_step(self.rng, self.spread * TURN, self.spread * SHIFT)
            yield number, true, true if self.from_truth else move_pose(true, step)

    def refine(self, frame: Frame, number: int, start: Transform, limit: float) -> Refined:
        """Refine a start; ``limit`` is the largest relative error of the scale."""
        refiner = self.refiners[number, limit]
        end = refiner.refine(frame.image, frame.K, start, self.spread**2 * COVARIANCE)
        return Refined(start, end.T_cam_obj, end.covariance)


class NetworkStarts:
    """Detections of a network as start poses, with the corrections of its checkpoint."""

    def __init__(self, parts: dict[int, Part], limits: Sequence[float], checkpoint: str) -> None:
        self.estimator = PoseEstimator.load(checkpoint)
        names = [part.name for part in self.estimator.parts]
        self.parts = {n: part for n, part in parts.items() if part.name in names}
        self.refiners = {
            limit: Refiner("region", list(self.parts.values()), limit) for limit in limits
        }

    def starts(self, frame: Frame) -> Iterator[tuple[int, Transform, Detection]]:
        """Yield model number, true pose and detection of each detected object."""
        detections = self.estimator.candidates(frame.image, frame.K)
        for number, part in self.parts.items():
            poses = [T for model, T in frame.objects if model == number]
            true = [
                Instance(part.name, T, project_keypoints(part.cuboid, T, frame.K)) for T in poses
            ]
            of_part = [detection for detection in detections if detection.object == part.name]
            indices = assign(part, of_part, true)
            for detection, index in zip(of_part, indices, strict=True):
                if index >= 0:
                    yield number, poses[index], detection

    def refine(self, frame: Frame, number: int, start: Detection, limit: float) -> Refined:
        """Refine a start; ``limit`` is the largest relative error of the scale."""
        end = self.refiners[limit](start, frame.image, frame.K, None)
        return Refined(start.T_cam_obj, end.T_cam_obj, None if end.kept else end.covariance)


def nearest_errors(
    part: Part, T: Transform, equivalents: np.ndarray, K: CameraMatrix
) -> np.ndarray:
    """Return ADD in mm, degrees, mm, distance in % and MSPD to the nearest true pose."""
    error, true = min(
        ((pose_errors(T, true, part.points), true) for true in equivalents),
        key=lambda pair: pair[0].add,
    )
    shift, ray = T[:3, 3] - true[:3, 3], true[:3, 3]
    ours, theirs = (project(transform(pose, part.points), K) for pose in (T, true))
    along = 100 * shift @ ray / (ray @ ray)
    mspd = np.linalg.norm(ours - theirs, axis=1).max()
    return np.array([error.add, error.rotation, error.translation, along, mspd])


def shape_residual(part: Part, T: Transform, frame: Frame) -> float:
    """Return how far the measured depth deviates from the mesh at a pose, up to an offset, in mm.

    NaN without a depth image.
    """
    if frame.depth is None or part.mesh is None:
        return math.nan
    mesh = make_outline_mesh(part.mesh.vertices, part.mesh.faces)
    at, edges = posed(mesh, T, frame.K), SharpEdges(mesh)
    assert at is not None  # the part is in front of the camera
    triangles = edges.drawn(at, frame.image.shape[1::-1])
    inside = cv2.erode((triangles >= 0).astype(np.uint8), np.ones((3, 3)))
    rows, columns = np.nonzero(inside * (frame.depth > 0))
    normals = edges.normals[triangles[rows, columns]] @ T[:3, :3].T
    corners = transform(T, mesh.vertices[mesh.faces[triangles[rows, columns], 0]])
    rays = np.column_stack([columns, rows, np.ones(len(rows))]) @ np.linalg.inv(frame.K).T
    drawn = (normals * corners).sum(axis=1) / (normals * rays).sum(axis=1)
    errors = 1e3 * (frame.depth[rows, columns] - drawn)
    return float(np.median(np.abs(errors - np.median(errors))))


def medians(name: str, rows: list[np.ndarray]) -> list[str]:
    """Return the table's row of an object: medians at the start → refined."""
    errors = np.array(rows)
    before, after, rest = errors[:, :6], errors[:, 6:12], errors[:, 12:]
    is_kept, surprise, took, limit = rest.T
    add, turn, shift, along, mspd, shape = (
        f"{np.median(a):.1f} → {np.median(b):.1f}" for a, b in zip(before.T, after.T, strict=True)
    )
    right = " → ".join(f"{np.mean(poses[:, 0] < limit):.0%}" for poses in (before, after))
    worse = f"{np.mean(after[:, 0] > before[:, 0] + WORSE_MM):.0%}"
    normalised = f"{math.sqrt(np.nanmean(surprise)):.2f}"
    rest = f"{is_kept.mean():.0%}", normalised, f"{np.median(took):.1f}"
    return [name, str(len(rows)), add, right, turn, shift, along, mspd, shape, worse, *rest]


def main() -> None:
    """Print a row per object."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--checkpoint", help="start at the detections of this network")
    parser.add_argument("--split", default="test")
    parser.add_argument("--half", choices=HALVES, default="both", help="frames of each scene")
    parser.add_argument(
        "--scale-errors",
        type=float,
        nargs="+",
        default=[SCALE_ERROR],
        help="largest relative errors of the scale to compare; 1e-6 trusts the outline's distance",
    )
    parser.add_argument(
        "--spread", type=float, default=1.0, help="factor on the errors of drawn starts"
    )
    parser.add_argument("--from-truth", action="store_true", help="start at the published poses")
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    parts = parts_by_id(arguments.folder, bop_parts(arguments.folder))
    method: DrawnStarts | NetworkStarts
    if arguments.checkpoint is None:
        spread, from_truth = arguments.spread, arguments.from_truth
        method = DrawnStarts(parts, arguments.scale_errors, spread, from_truth)
    else:
        method = NetworkStarts(parts, arguments.scale_errors, arguments.checkpoint)
    frames = read_scenes(arguments.folder, arguments.split, arguments.half)
    starts = [(frame, *start) for frame in frames for start in method.starts(frame)]
    rows: dict[str, list[np.ndarray]] = {}
    for limit, (frame, number, true, start) in product(arguments.scale_errors, starts):
        part, given = parts[number], (frame, number, start, limit)
        pose, took = timed(lambda given=given: method.refine(*given))  # type: ignore[misc]
        group = symmetry_group(part.symmetries_discrete, part.symmetries_continuous)
        before, after = (
            (*nearest_errors(part, T, true @ group, frame.K), shape_residual(part, T, frame))
            for T in (pose.start, pose.end)
        )
        surprise = math.nan
        if pose.covariance is not None:
            both = (array for T in (pose.end, true) for array in (T[:3, :3], T[:3, 3]))
            batch = (torch.from_numpy(array)[None] for array in (*both, pose.covariance))
            surprise = float(mahalanobis(*batch, torch.from_numpy(group))) ** 2 / 6
        rest = [pose.covariance is None, surprise, took, 100 * part.diameter]
        row = np.array([*before, *after, *rest])
        for name in (part.name, "all"):
            rows.setdefault(f"{name}, scale {limit:g}", []).append(row)
    print_head(
        "object", "poses", "ADD mm", "ADD-0.1d", "rotation °", "translation mm", "distance %",
        "MSPD px", "shape mm", "worse by 1 mm", "kept", "normalised error", "ms",
    )  # fmt: skip
    for name, poses in rows.items():
        print_row(*medians(name, poses))


if __name__ == "__main__":
    main()
