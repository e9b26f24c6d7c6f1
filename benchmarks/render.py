"""CPU time of the virtual factory per image and its stages, and of the first image of a process.

    python benchmarks/render.py [--images 100] [--faces 20000]

Times are process time (all threads of this process, waiting left out), so a busy machine disturbs
them little; caches shared with other processes still do. An image's scene is drawn (poses, light,
background), rasterised and shaded (2×2 anti-aliasing, shadows) with its labels (depth, instances,
visible fractions), and taken by the sensor. The *painter*, in the same process, gets the same
scenes already drawn and does less: it fills depth-sorted triangles with one colour each on a 2×2
canvas by OpenCV, without shadows, textures and labels.
"""

from __future__ import annotations

import argparse
import resource
import subprocess
import sys
import time
from collections.abc import Callable, Iterable
from dataclasses import replace
from functools import partial
from typing import TypeVar

import cv2
import numpy as np
from manifold3d import Manifold
from manifold3d import Mesh as ManifoldMesh

from dopepp.geometry.camera import project, resize_camera, transform
from dopepp.parts.catalogue import pivconnector
from dopepp.parts.part import Mesh, Part, make_part
from dopepp.virtual import PRESETS, Factory, Preset, Scene, make_surface, render
from dopepp.virtual.sensor import capture

Value = TypeVar("Value")

PRESET_NAMES = ("paper", "quickstart", "table", "bin")
NUM_DISTRACTORS = {"paper": (0, 4), "quickstart": (0, 4)}
"""Where it is not the preset's own number: one part among 0 to 4 distractors."""

SIZES = ((640, 480), (416, 416))
WARM_UP = 3
PLAIN_IMAGES = 3
"""The painter takes long, and its time varies little."""

REFERENCES = """\
Measured earlier on two cores, CPU-ms an image at 640×480 and 416×416: numba prototype 47 and 29;
MuJoCo on EGL 47 and 35 (plain Phong); pyrender on OSMesa 52 and 37; moderngl on llvmpipe 98 and 80;
Blender Cycles, 16 samples a pixel, 16,200 at 640×480."""

FIRST_IMAGE = """\
import sys
from dopepp.parts.catalogue import pivconnector
from dopepp.virtual import PRESETS, Factory
Factory([pivconnector()], PRESETS["paper"].resized(640, 480), seed=0).render(0, 0)
assert "torch" not in sys.modules, "rendering has imported torch"
"""


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


def flat_triangles(scene: Scene, scale: float) -> list[np.ndarray]:
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
    return [np.concatenate(arrays) for arrays in zip(*parts, strict=True)]


def painter(scene: Scene) -> np.ndarray:
    """Fill triangles from far to near on a canvas of twice the size."""
    width, height = scene.size
    canvas = cv2.resize(scene.background, (2 * width, 2 * height), interpolation=cv2.INTER_NEAREST)
    pixels, depths, colours = flat_triangles(scene, 2.0)
    fixed = np.round(pixels * 16).astype(np.int32)
    for number in np.argsort(-depths.mean(axis=1)):
        cv2.fillConvexPoly(canvas, fixed[number], colours[number].tolist(), cv2.LINE_8, 4)
    return np.asarray(cv2.resize(canvas, (width, height), interpolation=cv2.INTER_AREA))


def timed(function: Callable[[], Value], times: list[float]) -> Value:
    """Call a function and append its process time, milliseconds."""
    start = time.process_time()
    value = function()
    times.append((time.process_time() - start) * 1e3)
    return value


def preset_of(name: str, size: tuple[int, int]) -> Preset:
    """Return a preset in a size with the benchmark's number of distractors."""
    preset = PRESETS[name].resized(*size)
    number = NUM_DISTRACTORS.get(name, preset.distractors.number)
    return replace(preset, distractors=replace(preset.distractors, number=number))


def measure(part: Part, preset: Preset, num_images: int) -> list[str]:
    """Return one row of the table."""
    factory = Factory([part], preset, seed=0)
    for index in range(WARM_UP):
        factory.render(1, index)
    drawn: list[float] = []
    rendered: list[float] = []
    captured: list[float] = []
    painted: list[float] = []
    for index in range(num_images):
        scene = timed(partial(factory.scene, 0, index), drawn)
        picture = timed(partial(render, scene), rendered)
        timed(partial(capture, picture.image, scene.sensor), captured)
        if index < PLAIN_IMAGES:
            timed(partial(painter, scene), painted)
    stages = np.array([drawn, rendered, captured])
    totals = stages.sum(axis=0)
    shares = stages.sum(axis=1) / stages.sum()
    low, high = preset.distractors.number
    labels = [preset.name, f"{preset.width}×{preset.height}", f"{low}–{high}" if high else "0"]
    times = [f"{np.median(totals):.1f}", f"{totals.mean():.1f}"]
    return [*labels, *times, *(f"{share:.0%}" for share in shares), f"{np.mean(painted):.0f}"]


def first_image() -> tuple[float, float]:
    """Return wall and CPU seconds of a fresh process that renders one image and ends."""
    before, start = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    subprocess.run([sys.executable, "-c", FIRST_IMAGE], check=True)
    wall, after = time.perf_counter() - start, resource.getrusage(resource.RUSAGE_CHILDREN)
    return wall, after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def bake_rows(part: Part, num_images: int) -> list[list[str]]:
    """Return what a surface costs once: ambient occlusion and all, and a texture's pyramid."""
    mesh = part.mesh
    assert mesh is not None
    image = np.random.default_rng(0).integers(0, 256, (1024, 1024, 3), dtype=np.uint8)
    uv = np.ptp(mesh.vertices[:, :2], axis=0)
    uv = (mesh.vertices[:, :2] - mesh.vertices[:, :2].min(axis=0)) / uv
    textured = Mesh(mesh.vertices, mesh.faces, uv.astype(np.float32), image)
    rows = []
    for name, each in (("plain", mesh), ("with a texture of 1024×1024", textured)):
        times: list[float] = []
        for _ in range(num_images):
            timed(partial(make_surface, each), times)
        rows.append([name, f"{np.median(times):.0f}"])
    return rows


def show(header: list[str], rows: Iterable[list[str]]) -> None:
    """Print a table, row by row as it comes."""
    print("\n| " + " | ".join(header) + " |")
    print("| " + " | ".join("---" for _ in header) + " |")
    for row in rows:
        print("| " + " | ".join(row) + " |", flush=True)


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--images", type=int, default=100, help="images per row")
    parser.add_argument("--faces", type=int, default=20_000, help="triangles of the part")
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    part = refined(pivconnector(), arguments.faces)
    assert part.mesh is not None
    print(f"{part.name}, {len(part.mesh.faces):,} faces, CPU-ms an image (process time)")
    headings = (
        "preset, size, distractors, median, mean, scene, rasterise and shade, sensor, painter"
    )
    presets = (preset_of(name, size) for name in PRESET_NAMES for size in SIZES)
    show(headings.split(", "), (measure(part, preset, arguments.images) for preset in presets))
    print(f"\n{REFERENCES}")
    show(["a surface, once", "CPU-ms"], bake_rows(part, WARM_UP))
    first_image()  # compiles what is not compiled yet
    wall, cpu = first_image()
    print(f"\nFirst image of a fresh process, without torch: {wall:.2f} s, {cpu:.2f} CPU-s")


if __name__ == "__main__":
    main()
