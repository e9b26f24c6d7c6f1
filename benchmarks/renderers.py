"""CPU time per image of Mitsuba's variants and the rasteriser, and agreement of their labels.

    python benchmarks/renderers.py

All renderers draw the same random scenes. Times are CPU time (all threads of the process) and wall
time, without the first image, which compiles kernels. Depth agrees within 1 mm; masks agree if they
have the same instance number. A process can use only one variant, so each variant runs in a
separate process, together with the rasteriser.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import time
from collections.abc import Callable, Sequence

import cv2
import numpy as np
from common import print_head, print_row

from dopepp.core.errors import UserError
from dopepp.parts.catalogue import BUILTIN
from dopepp.virtual import PRESETS, Factory, Scene, render
from dopepp.virtual.renderers import find_renderer
from dopepp.virtual.renderers.photoreal import VARIANT_SETTING, VARIANTS
from dopepp.virtual.scene import Rendered

SCENES = ("paper", "table")
SIZE, NUM_IMAGES = (640, 480), 6
LIMIT_M = 1e-3
SEED = 11


def timed(
    renderer: Callable[[Scene], Rendered], scenes: Sequence[Scene]
) -> tuple[list[Rendered], float, float]:
    """Return images, and CPU and wall seconds per image; the first scene is a warm-up."""
    renderer(scenes[0])
    cpu, wall = time.process_time(), time.perf_counter()
    images = [renderer(scene) for scene in scenes[1:]]
    count = len(images)
    return images, (time.process_time() - cpu) / count, (time.perf_counter() - wall) / count


def compare(name: str, preset: str) -> list[str]:
    """Return one row of the table."""
    renderer = find_renderer("photoreal")
    parts = [make() for make in BUILTIN.values()]
    factory = Factory(parts, PRESETS[preset].resized(*SIZE), SEED)
    scenes = [factory.scene(0, index) for index in range(NUM_IMAGES + 1)]
    expected, base, _ = timed(render, scenes)
    images, cpu, wall = timed(renderer, scenes)
    pairs = list(zip(images, expected, strict=True))
    depth = [(np.abs(image.depth - reference.depth) < LIMIT_M).mean() for image, reference in pairs]
    masks = [(image.instances == reference.instances).mean() for image, reference in pairs]
    times = f"{cpu:.3f}", f"{wall:.3f}", f"{1e3 * base:.1f}", f"{cpu / base:.0f}×"
    agreement = f"{100 * min(depth):.3f} %", f"{100 * min(masks):.3f} %"
    return [name, preset, f"{SIZE[0]}×{SIZE[1]}", *times, *agreement]


def main() -> None:
    """Print the table, or with ``--only`` the rows of one variant."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", choices=VARIANTS, help="this variant's rows, without a header")
    arguments = parser.parse_args()
    if arguments.only is not None:
        cv2.setNumThreads(1)
        try:
            for preset in SCENES:
                print_row(*compare(arguments.only, preset))
        except UserError as error:
            print(f"{arguments.only}: not measured: {error}")
        return
    print_head(
        "variant", "preset", "size", "CPU-s", "wall-s", "rasteriser CPU-ms", "ratio",
        "depth within 1 mm (worst image)", "same mask (worst image)",
    )  # fmt: skip
    for name in VARIANTS:
        settings = {"OMP_NUM_THREADS": "1", VARIANT_SETTING: name}
        command = [sys.executable, __file__, "--only", name]
        subprocess.run(command, env={**os.environ, **settings}, check=True)


if __name__ == "__main__":
    main()
