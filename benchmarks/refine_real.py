"""Refinement on real frames of a BOP data set, from starts around the published poses.

    python benchmarks/refine_real.py FOLDER [--split test] [--every 1] [--pictures SHEET.png]

Each object that is at least half visible starts 10 mm off in a random direction and turned by 5°
about a random axis, RGB alone; errors are to the published pose, symmetric ones to the nearest.
With ``--from-truth`` it starts at the published pose: how far pictures and annotation agree.
Published rotations that are orthogonal to some thousandths only are replaced by the nearest ones.
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Iterator
from itertools import chain
from pathlib import Path

import cv2
import numpy as np
import torch

from dopepp.core.files import write_png
from dopepp.core.json import read_json
from dopepp.data.formats.bop.bop_models import bop_parts, parts_by_id
from dopepp.drawing.overlay import BLUE, GREEN, YELLOW, Wireframe, overlay
from dopepp.drawing.pictures import read_rgb
from dopepp.drawing.sheet import Tile, contact_sheet
from dopepp.geometry.camera import make_transform, moved, project_keypoints, transform
from dopepp.geometry.symmetry import symmetry_group
from dopepp.inference.refinement.region import RegionRefiner
from dopepp.metrics.functional import mahalanobis
from dopepp.parts.part import Part

TURN, SHIFT = math.radians(5.0), 0.010
LEAST_VISIBLE = 0.5
WORSE = 0.001
SEED = 5
COVARIANCE = np.diag(np.repeat([TURN**2 / 3, SHIFT**2 / 3], 3))


def add_mm(part: Part, T: np.ndarray, equivalents: np.ndarray) -> float:
    """Return the mean distance of points to the nearest equivalent of the true pose."""
    placed = transform(T, part.points)
    return 1e3 * min(
        float(np.linalg.norm(placed - transform(true, part.points), axis=1).mean())
        for true in equivalents
    )


def instances(scene: Path, least: float, every: int) -> Iterator[tuple]:
    """Yield picture, K, object number and true pose of what is visible enough."""
    truth, cameras = (read_json(scene / f"scene_{name}.json") for name in ("gt", "camera"))
    info = scene / "scene_gt_info.json"
    seen = read_json(info) if info.exists() else {}
    for image in list(truth)[::every]:
        picture = read_rgb(next((scene / "rgb").glob(f"{int(image):06d}.*")))
        K = np.reshape(cameras[image]["cam_K"], (3, 3)).astype(float)
        for number, annotation in enumerate(truth[image]):
            if not seen or seen[image][number]["visib_fract"] >= least:
                U, _, Vt = np.linalg.svd(np.reshape(annotation["cam_R_m2c"], (3, 3)))
                T = make_transform(U @ Vt, np.array(annotation["cam_t_m2c"]) / 1000)
                yield picture, K, annotation["obj_id"], T


def main() -> None:
    """Print a row for every object."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--split", default="test")
    parser.add_argument("--every", type=int, default=1, help="every so manieth frame")
    parser.add_argument("--from-truth", action="store_true", help="start at the published poses")
    parser.add_argument(
        "--pictures",
        type=Path,
        help="a sheet of every 20th: truth green, start blue, refined yellow",
    )
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    parts = parts_by_id(arguments.folder, bop_parts(arguments.folder))
    refiners = {
        number: RegionRefiner(part.mesh.vertices, part.mesh.faces)
        for number, part in parts.items()
        if part.mesh is not None
    }
    rng = np.random.default_rng(SEED)
    rows: dict[str, list[tuple[float, ...]]] = {}
    tiles: list[Tile] = []
    scenes = sorted((arguments.folder / arguments.split).iterdir())
    every = (instances(scene, LEAST_VISIBLE, arguments.every) for scene in scenes)
    for count, (picture, K, number, true) in enumerate(chain.from_iterable(every)):
        part = parts[number]
        step = rng.normal(size=6)
        step[:3] *= TURN / np.linalg.norm(step[:3])
        step[3:] *= SHIFT / np.linalg.norm(step[3:])
        start = true if arguments.from_truth else moved(true, step)
        group = symmetry_group(part.symmetries_discrete, part.symmetries_continuous)
        equivalents = true @ group
        began = time.process_time()
        end = refiners[number].refine(picture, K, start, COVARIANCE)
        took = 1e3 * (time.process_time() - began)
        before, after = (add_mm(part, T, equivalents) for T in (start, end.T_cam_obj))
        surprise = math.nan
        if end.covariance is not None:
            both = (array for T in (end.T_cam_obj, true) for array in (T[:3, :3], T[:3, 3]))
            batch = (torch.from_numpy(array)[None] for array in (*both, end.covariance))
            surprise = float(mahalanobis(*batch, torch.from_numpy(group))) ** 2 / 6
        rows.setdefault(part.name, []).append(
            (before, after, after > before + 1e3 * WORSE, bool(end.reason), surprise, took)
        )
        if count % 20 == 0:
            poses = (
                (true, GREEN, "true"),
                (start, BLUE, "start"),
                (end.T_cam_obj, YELLOW, "refined"),
            )
            frames = [
                Wireframe(project_keypoints(part.cuboid, T, K), colour, name)
                for T, colour, name in poses
            ]
            caption = f"{part.name}: {before:.1f} to {after:.1f} mm"
            tiles.append(Tile(overlay(picture, frames), caption))
    titles = "object | poses | ADD mm before | after | worse by 1 mm | kept | normalised error | ms"
    print(f"| {titles} |\n" + "| --- " * 8 + "|")
    rows["all"] = [row for poses in rows.values() for row in poses]
    for name, poses in rows.items():
        before, after, worse, kept, surprise, took = np.array(poses, float).T
        medians = f"{np.median(before):.1f} | {np.median(after):.1f}"
        shares = f"{worse.mean():.0%} | {kept.mean():.0%}"
        normalised = f"{math.sqrt(np.nanmean(surprise)):.2f}"
        cells = f"{len(poses)} | {medians} | {shares} | {normalised} | {np.median(took):.1f}"
        print(f"| {name} | {cells} |")
    if arguments.pictures is not None:
        write_png(arguments.pictures, contact_sheet(tiles, 4))


if __name__ == "__main__":
    main()
