"""CPU time per rendered image and per stage, and of the first image of a process.

    python benchmarks/render.py [--images 100] [--faces 20000]

Times are CPU time of all threads, so other load affects them little. The stages are

- scene: draw poses, light and background;
- rasterise and shade: 2×2 anti-aliasing, shadows, and the labels depth, instances and visible
  fractions;
- sensor: blur, noise and compression.
"""

from __future__ import annotations

import argparse
import resource
import subprocess
import sys
import time
from collections.abc import Iterable
from dataclasses import replace
from functools import partial

import cv2
import numpy as np
from common import print_head, print_row, timed
from manifold3d import Manifold
from manifold3d import Mesh as ManifoldMesh

from dopepp.parts.catalogue import pivconnector
from dopepp.parts.part import Mesh, Part, make_part
from dopepp.virtual import PRESETS, Factory, make_surface, render
from dopepp.virtual.presets import Preset
from dopepp.virtual.sensor import capture

PRESET_NAMES = ("paper", "quickstart", "table", "bin")
NUM_DISTRACTORS = {"paper": (0, 4), "quickstart": (0, 4)}
"""Number of distractors, where it differs from the preset's."""

SIZES = ((640, 480), (416, 416))
WARM_UP = 3

FIRST_IMAGE = """\
import sys
from dopepp.parts.catalogue import pivconnector
from dopepp.virtual import PRESETS, Factory
Factory([pivconnector()], PRESETS["paper"].resized(640, 480), seed=0).render(0, 0)
assert "torch" not in sys.modules, "rendering has imported torch"
"""


def refined(part: Part, num_faces: int) -> Part:
    """Return a part whose triangles are subdivided to about ``num_faces``."""
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


def preset_of(name: str, size: tuple[int, int]) -> Preset:
    """Return a preset with an image size and the benchmark's number of distractors."""
    preset = PRESETS[name].resized(*size)
    number = NUM_DISTRACTORS.get(name, preset.distractors.number)
    return replace(preset, distractors=replace(preset.distractors, number=number))


def measure(part: Part, preset: Preset, num_images: int) -> list[str]:
    """Return one row of the table."""
    factory = Factory([part], preset, seed=0)
    for index in range(WARM_UP):
        factory.render(1, index)
    times = []
    for index in range(num_images):
        scene, scene_ms = timed(partial(factory.scene, 0, index))
        rendered, render_ms = timed(partial(render, scene))
        _, sensor_ms = timed(partial(capture, rendered.image, scene.sensor))
        times.append((scene_ms, render_ms, sensor_ms))
    stages = np.array(times).T
    totals = stages.sum(axis=0)
    shares = stages.sum(axis=1) / stages.sum()
    low, high = preset.distractors.number
    labels = [preset.name, f"{preset.width}×{preset.height}", f"{low}–{high}" if high else "0"]
    spent = [f"{np.median(totals):.1f}", f"{totals.mean():.1f}"]
    return [*labels, *spent, *(f"{share:.0%}" for share in shares)]


def first_image() -> tuple[float, float]:
    """Return wall and CPU seconds of a fresh process that renders one image."""
    before, start = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    subprocess.run([sys.executable, "-c", FIRST_IMAGE], check=True)
    wall, after = time.perf_counter() - start, resource.getrusage(resource.RUSAGE_CHILDREN)
    return wall, after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def bake_rows(part: Part, num_images: int) -> list[list[str]]:
    """Return the CPU time of preparing a surface (ambient occlusion), and of a textured surface."""
    mesh = part.mesh
    assert mesh is not None
    image = np.random.default_rng(0).integers(0, 256, (1024, 1024, 3), dtype=np.uint8)
    uv = np.ptp(mesh.vertices[:, :2], axis=0)
    uv = (mesh.vertices[:, :2] - mesh.vertices[:, :2].min(axis=0)) / uv
    textured = Mesh(mesh.vertices, mesh.faces, uv.astype(np.float32), image)
    rows = []
    for name, each in (("plain", mesh), ("with a texture of 1024×1024", textured)):
        times = [timed(partial(make_surface, each))[1] for _ in range(num_images)]
        rows.append([name, f"{np.median(times):.0f}"])
    return rows


def show(titles: list[str], rows: Iterable[list[str]]) -> None:
    """Print a table, each row as soon as it is measured."""
    print()
    print_head(*titles)
    for row in rows:
        print_row(*row)


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--images", type=int, default=100, help="images per row")
    parser.add_argument("--faces", type=int, default=20_000, help="triangles of the part")
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    part = refined(pivconnector(), arguments.faces)
    assert part.mesh is not None
    print(f"{part.name}, {len(part.mesh.faces):,} faces, CPU milliseconds per image")
    headings = "preset, size, distractors, median, mean, scene, rasterise and shade, sensor"
    presets = (preset_of(name, size) for name in PRESET_NAMES for size in SIZES)
    show(headings.split(", "), (measure(part, preset, arguments.images) for preset in presets))
    show(["preparing a surface, once per part", "CPU-ms"], bake_rows(part, WARM_UP))
    first_image()  # compiles the kernels
    wall, cpu = first_image()
    print(f"\nFirst image of a fresh process, without torch: {wall:.2f} s, {cpu:.2f} CPU-s")


if __name__ == "__main__":
    main()
