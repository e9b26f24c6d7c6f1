"""CPU time of verifying a pose, compared with refining the pose, on one core.

    python benchmarks/verification_cost.py [FOLDER] [--poses 60] [--other verification.py]

Poses are the published poses in a BOP data set's frames in FOLDER, and the true poses in renders of
the released parts. Each pose is moved by 2 mm and 1° (standard deviations), like a refined pose.
``--other`` measures another version of ``dopepp/inference/refinement/verification.py`` in turn and
compares the evidence.
"""

from __future__ import annotations

import argparse
import importlib.util
import math
import sys
from collections.abc import Callable, Iterator
from functools import partial
from itertools import islice
from pathlib import Path

import cv2
import numpy as np
from common import print_head, print_row, timed
from refine_real import read_scenes

from dopepp.data.formats.bop.bop_models import bop_parts, parts_by_id
from dopepp.drawing.pictures import RGBImage
from dopepp.geometry.camera import CameraMatrix, Transform, move_pose
from dopepp.inference.refinement import verification
from dopepp.inference.refinement.refiner import PartRefiner
from dopepp.parts.catalogue import load_part
from dopepp.parts.part import Part
from dopepp.virtual import PRESETS, Factory

RENDERED = ("pivconnector", "servoholder")
COVARIANCE = np.diag(np.repeat([math.radians(1.0), 0.002], 3) ** 2)
REPEATS = 5  # the fastest run counts

Case = tuple[str, Part, RGBImage, CameraMatrix, Transform]


def real_cases(folder: Path) -> Iterator[Case]:
    """Yield the annotated poses of a BOP data set."""
    parts = parts_by_id(folder, bop_parts(folder))
    for frame in read_scenes(folder, "test"):
        for number, T in frame.objects:
            yield f"{folder.name}: {parts[number].name}", parts[number], *frame[:2], T


def rendered_cases(name: str) -> Iterator[Case]:
    """Yield the targets of renders."""
    part = load_part(name)
    factory, index = Factory([part], PRESETS["table"], 61), 0
    while True:
        rendered = factory.render(0, index)
        for number in rendered.scene.targets:
            if rendered.visible_fractions[number] > 0.3:
                T = rendered.scene.objects[number].T_cam_obj
                yield f"renders: {name}", part, rendered.image, rendered.scene.K, T
        index += 1


def fastest_ms(run: Callable[[], object]) -> float:
    """Return the CPU time of the fastest run in milliseconds."""
    return min(timed(run)[1] for _ in range(REPEATS))


def main() -> None:
    """Print a row per part."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", nargs="?", type=Path, help="BOP data set")
    parser.add_argument("--poses", type=int, default=60, help="per part")
    parser.add_argument("--other", type=Path, help="another verification.py")
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    versions = [verification.Verifier]
    if arguments.other is not None:
        spec = importlib.util.spec_from_file_location("other_verification", arguments.other)
        assert spec is not None
        assert spec.loader is not None
        other = importlib.util.module_from_spec(spec)
        sys.modules[spec.name] = other  # numba's cache finds compiled functions by their module
        spec.loader.exec_module(other)
        versions.append(other.Verifier)
    sources = [rendered_cases(name) for name in RENDERED]
    if arguments.folder is not None:
        sources.insert(0, real_cases(arguments.folder))
    print_head(
        "part", "poses", "verify ms", "refine ms", "verify/refine", "this/other", "difference"
    )
    for source in sources:
        rng, rows, refiner, title = np.random.default_rng(5), [], None, ""
        for name, part, image, K, T in islice(source, arguments.poses):
            if refiner is None:
                title = name
                refiner = PartRefiner(part, ("region",))
                assert refiner.verifier is not None
                mesh = refiner.verifier.mesh
                verifiers = [version(mesh, part.diameter) for version in versions]
            pose = move_pose(T, rng.multivariate_normal(np.zeros(6), COVARIANCE))
            case = (image, K, pose, COVARIANCE)
            evidence = [verifier.evidence(*case, 1.0) for verifier in verifiers]
            if any(values is None for values in evidence):
                assert all(values is None for values in evidence)
                continue
            difference = float(np.abs(np.subtract(evidence[0], evidence[-1])).max())
            spent = [fastest_ms(partial(each.evidence, *case, 1.0)) for each in verifiers]
            refined = fastest_ms(partial(refiner.refine, *case))
            rows.append((spent[0], refined, spent[0] / refined, spent[0] / spent[-1], difference))
        *figures, _ = np.median(rows, axis=0)
        difference = np.max(rows, axis=0)[-1]
        print_row(title, len(rows), *(f"{figure:.2f}" for figure in figures), f"{difference:.0e}")


if __name__ == "__main__":
    main()
