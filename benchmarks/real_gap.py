"""Training loss of a network on real frames in which part or surroundings are replaced by renders.

The script cuts windows around unoccluded parts out of labelled real frames. In copies of a window,
the part is rendered at its true pose, in front of the real surroundings or those of the training.
The training loss of each variant (lower is better) shows whether the part's appearance or the
surroundings cause the errors on real frames. If a true pose is off by a pixel or two, a seam of the
real part remains around the rendered part and counts as surroundings.

python benchmarks/real_gap.py outputs/dopepp_fast_bop_renders/RUN
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import torch

from dopepp.core.yaml import read_yaml
from dopepp.data.batch import collate
from dopepp.data.sample import Sample, crop_sample, resize_sample
from dopepp.drawing.pictures import RGBImage
from dopepp.experiment.assembly.build_parts import build_parts
from dopepp.experiment.assembly.build_sources import labelled_images
from dopepp.experiment.assembly.build_system import build_system
from dopepp.experiment.assembly.camera_fit import fit_to_camera
from dopepp.experiment.assembly.renders import training_preset
from dopepp.experiment.config.run_config import RunConfig
from dopepp.experiment.results.folder import CONFIG_FILE
from dopepp.geometry.cuboid import CENTROID
from dopepp.parts.part import Parts
from dopepp.training.system import PoseSystem
from dopepp.virtual.backgrounds import find_backgrounds
from dopepp.virtual.backgrounds.procedural import ClutteredBackgrounds
from dopepp.virtual.body import make_body
from dopepp.virtual.renderers import find_renderer
from dopepp.virtual.scene import Scene, SceneObject

UNHIDDEN = 0.98  # Smallest visible share; nothing may occlude the part that a render replaces

RING_PX = 12.0
"""Width of the ring around the part that counts as immediate surroundings, network pixels."""


def windows(config: RunConfig, parts: Parts, rng: np.random.Generator) -> list[tuple[Sample, int]]:
    """Cut windows around unoccluded parts out of the test frames, with the part's number."""
    source = labelled_images(config.data, parts, config.seed, "test")
    scale, size = config.data.virtual.camera_scale or 1.0, np.array(config.data.network_input)
    names, cut = [part.name for part in parts], []
    for index in range(len(source)):
        sample = source.sample(index)
        width, height = (round(scale * side) for side in sample.size)
        sample = resize_sample(sample, (width, height))
        for instance in sample.instances:
            if instance.label not in names or instance.visible_fraction < UNHIDDEN:
                continue
            corner = instance.keypoints[CENTROID] - size / 2 + rng.uniform(-0.15, 0.15, 2) * size
            left, top = np.clip(corner, 0, np.array(sample.size) - size).astype(int)
            window = crop_sample(sample, left, top, (int(size[0]), int(size[1])))
            # A second part in the window would be both surroundings and target.
            visible = [near for near in window.instances if near.visible_fraction > 0]
            if len(visible) == 1 and visible[0].visible_fraction > 0.9 * instance.visible_fraction:
                cut.append((replace(window, instances=visible), names.index(instance.label)))
    return cut


def variants(config: RunConfig, parts: Parts, rng: np.random.Generator) -> dict[str, list[Sample]]:
    """Return the variants of every window, by name."""
    preset = training_preset(config.data)
    photos = find_backgrounds(config.data.virtual.backgrounds)
    behind = ClutteredBackgrounds(photos, preset.clutter, preset.background_contrast)
    bodies, render = [make_body(part, is_target=True) for part in parts], find_renderer("raster")
    made: dict[str, list[Sample]] = {}
    for window, number in windows(config, parts, rng):
        (instance,), body, real = (
            window.instances,
            bodies[number],
            np.ascontiguousarray(window.image),
        )
        learned = behind.draw(rng, *window.size)
        lights, ambient = preset.lighting.draw(rng, instance.T_cam_obj[:3, 3])
        material = preset.materials.draw(rng, body.surface)
        item = SceneObject(body.surface, instance.T_cam_obj, material, body.part)
        drawn = render(Scene(window.K, learned, (item,), lights, ambient))
        part = drawn.instances == drawn.scene.targets[0]
        opaque = cv2.GaussianBlur(part.astype(np.float32), (0, 0), 0.6)[..., None]
        near = cv2.distanceTransform((~part).astype(np.uint8), cv2.DIST_L2, 5) < RING_PX
        mixed = np.where(near[..., None], real, learned), np.where(near[..., None], learned, real)
        for name, image in {
            "all rendered": drawn.image,
            "rendered part, real surroundings": composite(drawn.image, opaque, real),
            f"… real within {RING_PX:g} pixels": composite(drawn.image, opaque, mixed[0]),
            f"… real beyond {RING_PX:g} pixels": composite(drawn.image, opaque, mixed[1]),
            "real part, rendered surroundings": composite(real, opaque, learned),
            "all real": real,
        }.items():
            made.setdefault(name, []).append(replace(window, image=image))
    return made


def composite(part: RGBImage, opaque: np.ndarray, behind: RGBImage) -> RGBImage:
    """Return an image of a part in front of other surroundings, by an opacity mask."""
    return np.asarray(np.rint(opaque * part + (1 - opaque) * behind), np.uint8)


@torch.inference_mode()
def losses(system: PoseSystem, samples: Sequence[Sample]) -> np.ndarray:
    """Return the training loss of each window."""
    numbers = {part.name: number for number, part in enumerate(system.parts)}
    values = []
    for first in range(0, len(samples), 32):
        batch = collate(samples[first : first + 32], numbers)
        stages = system(batch.images)
        values.append(system.loss.per_image(stages, *system.targets(batch, stages)).numpy())
    return np.concatenate(values)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("runs", type=Path, nargs="+", help="run folders; windows are of the first")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    made: dict[str, list[Sample]] = {}
    for run in options.runs:
        config = RunConfig.of(read_yaml(run / CONFIG_FILE))
        parts = build_parts(config.data)
        config = fit_to_camera(config, parts)
        made = made or variants(config, parts, np.random.default_rng(options.seed))
        trained = replace(config, init_from=str(run / "checkpoints" / "best.ckpt"))
        system = build_system(trained, parts, "").eval()
        print(f"{run.name}: {len(made['all real'])} windows, training loss")
        for name, samples in made.items():
            values = losses(system, samples)
            error = values.std() / np.sqrt(len(values))
            median = np.median(values)
            print(f"  {name:40s} {values.mean():6.2f} ± {error:.2f}, median {median:.2f}")


if __name__ == "__main__":
    main()
