"""CPU time per simulated heap, heaps per minute on two cores, and the largest overlap of meshes.

python benchmarks/heaps.py --heaps 60
"""

from __future__ import annotations

import argparse
import os
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor
from functools import cache
from itertools import combinations
from multiprocessing import get_context

import numpy as np

from dopepp.data.render_job import named_part
from dopepp.geometry.camera import invert_transform, transform
from dopepp.parts.convex import convex_pieces
from dopepp.parts.mesh import SurfaceTree
from dopepp.virtual import PRESETS, Factory, SceneObject
from dopepp.virtual.surface import Surface

SAMPLES = 300  # tested surface points per object


def heap(text: str, unit: str | None, index: int) -> tuple[float, ...]:
    """Simulate a heap; return the number of objects, CPU seconds, and overlap in diameters."""
    part = named_part(text, unit)
    Factory([part], PRESETS["table"], 0).scene(0, index)  # compiles
    factory = Factory([part], PRESETS["heap"], 0)
    start = time.process_time()
    scene = factory.scene(0, index)
    seconds = time.process_time() - start
    pairs = combinations([item for item in scene.objects if item.surface.closed], 2)
    return len(scene.objects), seconds, max(overlap(*pair) for pair in pairs) / part.diameter


def overlap(first: SceneObject, second: SceneObject) -> float:
    """Return the largest depth of sampled points of the first object inside the second, metres."""
    points, _ = tree(first.surface).spread(SAMPLES, 0)
    points = transform(invert_transform(second.T_cam_obj) @ first.T_cam_obj, points)
    vertices = second.surface.vertices
    points = points[((points > vertices.min(0)) & (points < vertices.max(0))).all(axis=1)]
    if not len(points):
        return 0.0
    inside = points[[is_inside(point, vertices[second.surface.faces]) for point in points]]
    return float(tree(second.surface).distances(inside).max(initial=0.0))


@cache
def tree(surface: Surface) -> SurfaceTree:
    """Return the search tree of a surface."""
    return SurfaceTree(surface.vertices, surface.faces)


def is_inside(point: np.ndarray, corners: np.ndarray) -> bool:
    """Return whether a point lies in a closed mesh: its winding number (van Oosterom 1983)."""
    a, b, c = (corners - point).swapaxes(0, 1)
    la, lb, lc = (np.linalg.norm(edge, axis=1) for edge in (a, b, c))
    dots = [np.einsum("ij,ij->i", *pair) for pair in ((a, b), (b, c), (c, a))]
    volume = np.einsum("ij,ij->i", a, np.cross(b, c))
    angles = np.arctan2(volume, la * lb * lc + dots[0] * lc + dots[1] * la + dots[2] * lb)
    return bool(angles.sum() > np.pi)


def main() -> None:
    """Print a row per part."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("parts", nargs="*", default=["pivconnector", "servoholder"])
    parser.add_argument("--unit")
    parser.add_argument("--heaps", type=int, default=60)
    parser.add_argument("--workers", type=int, default=2)
    options = parser.parse_args()
    print(f"{'part':>28}{'heaps':>8}{'objects':>9}{'s':>8}{'a minute':>10}{'overlap %':>11}")
    for text in options.parts:
        with tempfile.TemporaryDirectory() as folder:
            os.environ["XDG_CACHE_HOME"] = folder
            convex_pieces(named_part(text, options.unit))
            with ProcessPoolExecutor(options.workers, get_context("spawn")) as pool:
                jobs = [pool.submit(heap, text, options.unit, i) for i in range(options.heaps)]
                objects, seconds, overlaps = np.array([job.result() for job in jobs]).T
        print(
            f"{text[-28:]:>28}{len(seconds):8d}{objects.mean():9.1f}{seconds.mean():8.2f}"
            f"{120 / seconds.mean():10.0f}{100 * overlaps.max():11.2f}"
        )


if __name__ == "__main__":
    main()
