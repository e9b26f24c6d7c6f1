"""CPU time of the virtual factory per image, beside two plain renderers in the same run.

    python benchmarks/render.py [--images 100] [--faces 20000]

Times are process time (all threads of this process, waiting left out), so a busy machine disturbs
them little; caches shared with other processes still do. An image is drawn (scene, background),
rendered (2×2 anti-aliasing, shadow) and labelled (depth, instances, visible fractions). The plain
renderers get the same scenes, already drawn, and do less: *painter* fills depth-sorted triangles
with one colour each on a 2×2 canvas by OpenCV, without labels; *numpy* is a vectorised z-buffer
with flat colours and depth, without anti-aliasing. Neither has shadows or textures.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from dataclasses import replace

import cv2
import numpy as np
from manifold3d import Manifold
from manifold3d import Mesh as ManifoldMesh

from dopepp.geometry.camera import project, resize_camera, transform
from dopepp.parts.builtin import pivconnector
from dopepp.parts.part import Mesh, Part, make_part
from dopepp.virtual import PRESETS, Distractors, Factory, Preset, Scene, render

SIZES = ((640, 480), (416, 416), (128, 128))
NUM_DISTRACTORS = ((0, 0), (0, 4))
PLAIN_IMAGES = 3
"""The plain renderers take long, and their time varies little."""


def refined(part: Part, num_faces: int) -> Part:
    """Return a part with its triangles cut up until there are about ``num_faces``."""
    assert part.mesh is not None
    solid = Manifold(
        ManifoldMesh(part.mesh.vertices.astype(np.float32), part.mesh.faces.astype(np.uint32))
    )
    length, finer = part.diameter, solid
    while finer.num_tri() < num_faces:
        length *= 0.97
        finer = solid.refine_to_length(length)
    mesh = finer.to_mesh()
    vertices = np.asarray(mesh.vert_properties, np.float64)[:, :3]
    return make_part(part.name, Mesh(vertices, np.asarray(mesh.tri_verts, np.int32)))


def flat_triangles(scene: Scene, scale: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return pixels (N, 3, 2), depths (N, 3) and colours (N, 3) of all front faces."""
    K = resize_camera(scene.K, scale, scale)
    towards = -np.array(scene.lights[0].position)
    towards /= np.linalg.norm(towards)
    parts = []
    for item in scene.objects:
        corners = transform(item.T_cam_obj, item.surface.vertices)[item.surface.faces]
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        front = ((normals * corners[:, 0]).sum(axis=1) < 0) & (corners[..., 2].min(axis=1) > 0.01)
        corners, normals = corners[front], normals[front]
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
        light = np.clip(-normals @ towards, 0, 1) * 0.7 + 0.2
        colours = 255 * light[:, None] * np.array(item.material.colour)
        parts.append((project(corners, K), corners[..., 2], colours))
    return tuple(np.concatenate(arrays) for arrays in zip(*parts, strict=True))  # type: ignore[return-value]


def painter(scene: Scene) -> np.ndarray:
    """Fill triangles from far to near on a canvas of twice the size."""
    width, height = scene.size
    canvas = cv2.resize(scene.background, (2 * width, 2 * height), interpolation=cv2.INTER_NEAREST)
    pixels, depths, colours = flat_triangles(scene, 2.0)
    fixed = np.round(pixels * 16).astype(np.int32)
    for number in np.argsort(-depths.mean(axis=1)):
        cv2.fillConvexPoly(canvas, fixed[number], colours[number].tolist(), cv2.LINE_8, 4)
    return np.asarray(cv2.resize(canvas, (width, height), interpolation=cv2.INTER_AREA))


def numpy_zbuffer(scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    """Rasterise each triangle's bounding box with array operations."""
    width, height = scene.size
    image, inverse_depth = scene.background.copy(), np.zeros((height, width))
    for (a, b, c), depth, colour in zip(*flat_triangles(scene, 1.0), strict=True):
        low = np.maximum(np.ceil(np.minimum(np.minimum(a, b), c)), 0).astype(int)
        high = np.floor(np.maximum(np.maximum(a, b), c)).astype(int)
        x = np.arange(low[0], min(high[0], width - 1) + 1)
        y = np.arange(low[1], min(high[1], height - 1) + 1)[:, None]
        area = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
        if not x.size or not y.size or area == 0:
            continue
        first = ((b[0] - x) * (c[1] - y) - (b[1] - y) * (c[0] - x)) / area
        second = ((c[0] - x) * (a[1] - y) - (c[1] - y) * (a[0] - x)) / area
        third = 1 - first - second
        inverse = first / depth[0] + second / depth[1] + third / depth[2]
        window = np.s_[low[1] : low[1] + y.size, low[0] : low[0] + x.size]
        nearer = (first >= 0) & (second >= 0) & (third >= 0) & (inverse > inverse_depth[window])
        inverse_depth[window][nearer] = inverse[nearer]
        image[window][nearer] = colour
    return image, inverse_depth


def cpu_ms(function: Callable[[int], object], count: int) -> float:
    """Return the mean process time of ``function(0..count−1)``, milliseconds."""
    start = time.process_time()
    for index in range(count):
        function(index)
    return (time.process_time() - start) / count * 1e3


def measure(part: Part, preset: Preset, num_images: int) -> list[str]:
    """Return one row of the table."""
    factory = Factory([part], preset, seed=0)
    for index in range(3):
        factory.render(1, index)
    total = cpu_ms(lambda index: factory.render(0, index), num_images)
    scenes = [factory.scene(0, index) for index in range(num_images)]
    drawn = cpu_ms(lambda index: render(scenes[index]), num_images)
    ours = cpu_ms(lambda index: render(scenes[index]), PLAIN_IMAGES)
    painted = cpu_ms(lambda index: painter(scenes[index]), PLAIN_IMAGES)
    plain = cpu_ms(lambda index: numpy_zbuffer(scenes[index]), PLAIN_IMAGES)
    low, high = preset.distractors.number
    return [
        preset.name, f"{preset.width}×{preset.height}", f"{low}–{high}" if high else "0",
        f"{total:.1f}", f"{drawn:.1f}", f"{painted:.0f}", f"{plain:.0f}",
        f"{painted / ours:.0f}×", f"{plain / ours:.0f}×",
    ]  # fmt: skip


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--images", type=int, default=100, help="images per row")
    parser.add_argument("--faces", type=int, default=20_000, help="triangles of the part")
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    part = refined(pivconnector(), arguments.faces)
    assert part.mesh is not None
    print(f"{part.name}, {len(part.mesh.faces):,} faces, CPU-ms per image (process time)")
    header = [
        "preset", "size", "distractors", "total", "of it rendering", "painter", "numpy",
        "painter / ours", "numpy / ours",
    ]  # fmt: skip
    print("| " + " | ".join(header) + " |")
    print("| " + " | ".join("---" for _ in header) + " |")
    for name, sizes in (("paper", SIZES), ("quickstart", SIZES)):
        for size in sizes:
            for number in NUM_DISTRACTORS:
                preset = replace(PRESETS[name].resized(*size), distractors=Distractors(number))
                print("| " + " | ".join(measure(part, preset, arguments.images)) + " |", flush=True)


if __name__ == "__main__":
    main()
