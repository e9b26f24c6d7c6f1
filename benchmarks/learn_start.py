"""Learn the initial weights of ``init_from=auto`` from random parts in a given time, on a GPU.

    python benchmarks/learn_start.py data/start --minutes 6 [--parts 160] [--from auto]

Random parts are bodies with bosses, ribs, holes and slots, similar to machined or printed parts. A
single network learns the poses of all parts, with any in-plane rotation and tilts of up to 60°. The
weights of all layers except the output layers, which are specific to the parts, are written to
``dopepp_fast.safetensors`` in the folder, which also holds the parts' meshes.
"""

from __future__ import annotations

import argparse
import itertools
import math
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import torch
import trimesh
from manifold3d import CrossSection, Manifold
from runtimes import config_of

from dopepp.data.batch import Batch
from dopepp.data.datamodule import PoseDataModule
from dopepp.experiment.assembly.build_parts import build_parts
from dopepp.experiment.assembly.build_sources import build_datamodule
from dopepp.experiment.assembly.build_system import build_system
from dopepp.models.network import PoseNetwork
from dopepp.models.start import output_tensors
from dopepp.models.storage import write_safetensors
from dopepp.training.system import PoseSystem

DIAMETERS_MM = (35.0, 60.0)
_SEGMENTS = 48  # sides of a round feature
_WARM_UP = 0.05  # share of the time in which the learning rate grows
_WINDOWS = 250_000  # rendered once, with new augmentation in each epoch


def random_part(rng: np.random.Generator) -> trimesh.Trimesh:
    """Return a random closed mesh in millimetres, with the centre of its box at the origin."""
    while True:
        solid = _body(rng)
        for _ in range(rng.integers(1, 5)):
            solid += _feature(rng, solid, cut=False)
        for _ in range(rng.integers(1, 6)):
            solid -= _feature(rng, solid, cut=True)
        pieces = solid.decompose()
        if not pieces:
            continue
        mesh = max(pieces, key=lambda piece: piece.volume()).to_mesh()
        part = trimesh.Trimesh(mesh.vert_properties[:, :3].astype(float), mesh.tri_verts)
        if part.is_volume and 0.05 < part.volume / part.bounding_box.volume < 0.9:
            part.apply_translation(-part.bounds.mean(axis=0))
            hull = part.convex_hull.vertices
            spans = np.linalg.norm(hull[:, None] - hull, axis=2)
            part.apply_scale(rng.uniform(*DIAMETERS_MM) / spans.max())
            return part


def _body(rng: np.random.Generator) -> Manifold:
    """Return a block, a disc or cone, a plate with a polygonal outline, or an L-shape."""
    kind = rng.integers(4)
    size = rng.uniform([15, 15, 4], [45, 35, 25])
    if kind == 0:
        return Manifold.cube(size, True)
    if kind == 1:
        low, high = rng.uniform(8, 22, 2)
        return Manifold.cylinder(rng.uniform(4, 40), low, high, _SEGMENTS, True)
    if kind == 2:
        number = rng.integers(4, 9)
        angles = np.sort(rng.uniform(0, 2 * np.pi, number))
        radii = rng.uniform(10, 24, number)[:, None]
        outline = radii * np.stack([np.cos(angles), np.sin(angles)], axis=1)
        plate = CrossSection([outline]).extrude(rng.uniform(3, 14))
        return plate if not plate.is_empty() else Manifold.cube(size, True)
    thickness, height = rng.uniform(2.5, 6), rng.uniform(12, 35)
    flat = Manifold.cube([size[0], size[1], thickness])
    return flat + Manifold.cube([thickness, size[1] * rng.uniform(0.5, 1), height])


def _feature(rng: np.random.Generator, solid: Manifold, cut: bool) -> Manifold:
    """Return a cylinder, cone or block inside a solid's bounding box, mostly along an axis."""
    bounds = np.reshape(solid.bounding_box(), (2, 3))
    extent = bounds[1] - bounds[0]
    centre = bounds[0] + extent * rng.uniform(0.1, 0.9, 3)
    width = rng.uniform(0.08, 0.45 if cut else 0.6) * np.sort(extent)[1]
    length = extent.max() * (rng.choice([0.4, 3.0]) if cut else rng.uniform(0.3, 1.1))
    if rng.random() < 0.6:
        tip = rng.choice([1.0, 1.0, rng.uniform(0.3, 1.0)])
        shape = Manifold.cylinder(length, width / 2, width / 2 * tip, _SEGMENTS, True)
    else:
        shape = Manifold.cube([width, width * rng.uniform(0.4, 2.5), length], True)
    turn = [(0, 0, 0), (90, 0, 0), (0, 90, 0)][rng.integers(3)]
    if rng.random() < 0.15:
        turn = tuple(rng.uniform(0, 180, 3))
    return shape.rotate(turn).translate(centre)


def write_parts(folder: Path, number: int, seed: int) -> list[Path]:
    """Write random parts as STL files."""
    folder.mkdir(parents=True, exist_ok=True)
    files = [folder / f"part{index:03}.stl" for index in range(number)]
    for index, file in enumerate(files):
        random_part(np.random.default_rng([seed, index])).export(file)
    return files


def learn(system: PoseSystem, data: PoseDataModule, minutes: float, device: str) -> int:
    """Train for a given time with a one-cycle schedule; return the number of images."""
    optimizer = system.make_optimizer(system.parameters())
    rates = [group["lr"] for group in optimizer.param_groups]
    system.to(device).train()
    images = 0
    begin = time.perf_counter()
    for batch in _endless(data):
        done = (time.perf_counter() - begin) / (60 * minutes)
        if done >= 1:
            break
        share = min(done / _WARM_UP + 0.01, (1 + math.cos(math.pi * done)) / 2)
        for group, rate in zip(optimizer.param_groups, rates, strict=True):
            group["lr"] = rate * share
        batch = batch.to(torch.device(device))
        with torch.autocast(device, torch.bfloat16):
            stages = system(batch.images)
        stages = [(logits.float(), field.float()) for logits, field in stages]
        loss, _ = system.loss(stages, *system.targets(batch, stages))
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        torch.nn.utils.clip_grad_norm_(system.parameters(), 1.0)
        optimizer.step()
        if images // 50_000 < (images := images + len(batch)) // 50_000:
            print(f"{images} images: loss {loss.item() * len(system.parts):.3f}", flush=True)
    return images


def _endless(data: PoseDataModule) -> Iterator[Batch]:
    """Yield the batches of all epochs."""
    loader = data.train_dataloader()
    for epoch in itertools.count():
        loader.sampler.set_epoch(epoch)
        yield from loader


def save_start(network: PoseNetwork, path: Path) -> None:
    """Write the weights of all layers except the output layers, in half precision."""
    outputs = output_tensors(network)
    weights = {
        name: value.half() if value.is_floating_point() else value
        for name, value in network.state_dict().items()
        if name not in outputs
    }
    write_safetensors(path, weights, {})


def main() -> None:
    """Learn the weights and write them."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--minutes", type=float, default=6.0)
    parser.add_argument("--parts", type=int, default=160)
    parser.add_argument("--seed", type=int, default=0, help="seed of the parts")
    parser.add_argument("--from", dest="start", default="null", help="initial weights")
    parser.add_argument("--device", default="cuda")
    parser.add_argument("overrides", nargs="*", help="e.g. data.batch_size=32")
    args = parser.parse_intermixed_args()
    files = ",".join(
        str(file.resolve()) for file in write_parts(args.folder, args.parts, args.seed)
    )
    config = config_of(
        "dopepp_fast", "experiment=my_part", f"data.parts=[{files}]", "data.input_size=[128,128]",
        f"data.samples_per_epoch={_WINDOWS}", "data.batch_size=160", "optimizer.lr=0.012",
        # Most maps belong to absent parts; the belief terms of the loss are averages over all maps.
        f"model.loss.field_weight={2 / args.parts}", f"init_from={args.start}", *args.overrides,
    )  # fmt: skip
    torch.manual_seed(config.seed)
    parts = build_parts(config.data)
    data = build_datamodule(config.data, parts, config.seed)
    data.train_item(0, 0)  # compiles the rendering code before the workers fork
    system = build_system(config, parts, "")
    print(f"{learn(system, data, args.minutes, args.device)} images")
    save_start(system.network, args.folder / "dopepp_fast.safetensors")


if __name__ == "__main__":
    main()
