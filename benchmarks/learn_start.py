"""Learn the initial weights of ``init_from=auto`` from random parts in a given time, on a GPU.

    python benchmarks/learn_start.py data/start --parts 96 --prepare data.cache=none
    python benchmarks/learn_start.py data/start --parts 96 --minutes 8.5 [--from auto]

Random parts are bodies with bosses, ribs, holes and slots, similar to machined or printed parts. A
single network learns the poses of all parts: single parts with any in-plane rotation and tilts of
up to 60°, and heaps (extra ``robot``). The weights of all layers except the output layers, which
are specific to the parts, are written to ``dopepp_fast.safetensors`` in the folder, which also
holds the parts' meshes.

``--prepare`` only writes the meshes and the cached heaps: about 20 s per part on one core.
"""

from __future__ import annotations

import argparse
import itertools
import math
import time
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
import trimesh
from manifold3d import CrossSection, Manifold
from runtimes import config_of
from torch.utils.data import DataLoader, Dataset, Sampler

from dopepp.core.pool import available_cores
from dopepp.data.batch import Batch, collate
from dopepp.data.datamodule import PoseDataModule
from dopepp.data.sample import Sample
from dopepp.experiment.assembly.build_parts import build_parts
from dopepp.experiment.assembly.build_sources import build_datamodule
from dopepp.experiment.assembly.build_system import build_system
from dopepp.experiment.assembly.camera_fit import fit_to_camera
from dopepp.experiment.assembly.photos import training_backgrounds
from dopepp.experiment.assembly.renders import training_renders
from dopepp.experiment.config.run_config import RunConfig
from dopepp.models.network import PoseNetwork
from dopepp.models.start import output_tensors
from dopepp.models.storage import write_safetensors
from dopepp.parts.catalogue import load_part
from dopepp.parts.symmetry_finder import find_symmetries
from dopepp.training.system import PoseSystem
from dopepp.virtual.body import make_body

DIAMETERS_MM = (35.0, 60.0)
_SEGMENTS = 48  # sides of a round feature
_WARM_UP = 0.05  # share of the time in which the learning rate grows
_PILES = 60  # heaps per block of images
_BLOCK = 10_000  # images that share heaps
_CAMERA = "{width: 640, height: 480, fx: 605.0, fy: 605.0, cx: 319.5, cy: 239.5}"
_HEAP = f"++virtual.scene.table.pile={{piles: {_PILES}, mixed_share: 0.2}}"


class Stream(NamedTuple):
    """A kind of training images."""

    share: float  # Share of the training images
    new_share: float  # Share of new renders; the other images are former renders, augmented anew
    overrides: tuple[str, ...]  # Options of ``train.py`` for the renders


STREAMS = (
    Stream(0.4, 0.25, ("seen_on=front",)),
    Stream(0.35, 0.12, ("seen_on=bin", "materials=mixed", _HEAP)),
    Stream(0.25, 0.12, ("seen_on=bin", "materials=metal", _HEAP)),
)


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
    """Return a block, a disc or cone, a plate with a polygonal outline, an L-shape or a shaft."""
    kind = rng.integers(5)
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
    if kind == 3:
        shaft, end = Manifold(), 0.0
        for _ in range(rng.integers(2, 5)):
            length, radius = rng.uniform(5, 25), rng.uniform(3, 10)
            sides = rng.choice([6, _SEGMENTS])
            shaft += Manifold.cylinder(length, radius, radius, sides).translate([0, 0, end - 0.5])
            end += length - 0.5
        return shaft
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
    """Write random parts without symmetries as STL files, unless they exist."""
    folder.mkdir(parents=True, exist_ok=True)
    files = [folder / f"part{index:03}.stl" for index in range(number)]
    for index, file in enumerate(files):
        rng = np.random.default_rng([seed, index])
        while not file.exists():
            random_part(rng).export(file)
            discrete, continuous = find_symmetries(load_part(file, "mm").mesh, 0.02)
            if len(discrete) or continuous:
                file.unlink()
    return files


def _split(file: Path) -> None:
    """Divide a part into convex pieces for the simulation of heaps, and cache the pieces."""
    make_body(load_part(file, "mm"), is_target=True).pieces  # noqa: B018


class Replay(Dataset[Sample], Sampler[tuple[int, int, int]]):
    """Endless training images of the streams, indexed by (stream, number of the view, render).

    A share of each stream's views shows new renders, so the network never waits for the renderer.
    """

    def __init__(self, streams: Sequence[PoseDataModule], seed: int) -> None:
        self._streams, self._rng = streams, np.random.default_rng(seed)

    def __getitem__(self, key: tuple[int, int, int]) -> Sample:
        stream, view, render = key
        return self._streams[stream].train_item(view, render)

    def __iter__(self) -> Iterator[tuple[int, int, int]]:
        rendered = [0] * len(STREAMS)
        for view in itertools.count():
            number = self._rng.choice(len(STREAMS), p=[stream.share for stream in STREAMS])
            most = len(self._streams[number].train_source)
            # Renders of the last batches may be in progress in another worker.
            if rendered[number] < min(500, most) or (
                rendered[number] < most and self._rng.random() < STREAMS[number].new_share
            ):
                rendered[number] += 1
                yield number, view, rendered[number] - 1
            else:
                yield number, view, int(self._rng.integers(rendered[number]))


def learn(system: PoseSystem, loader: Iterable[Batch], minutes: float, device: str) -> int:
    """Train for a given time with a one-cycle schedule; return the number of images."""
    optimizer = system.make_optimizer(system.parameters())
    rates = [group["lr"] for group in optimizer.param_groups]
    system.to(device).train()
    images = 0
    begin = time.perf_counter()
    for batch in loader:
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
            seconds, total = time.perf_counter() - begin, loss.item() * len(system.parts)
            print(f"{images} images, {seconds:.0f} s: loss {total:.3f}", flush=True)
    return images


def save_start(network: PoseNetwork, path: Path) -> None:
    """Write the weights of all layers except the output layers, in half precision."""
    outputs = output_tensors(network)
    weights = {
        name: value.half() if value.is_floating_point() else value
        for name, value in network.state_dict().items()
        if name not in outputs
    }
    write_safetensors(path, weights, {})


def stream_config(stream: Stream, files: Sequence[Path], args: argparse.Namespace) -> RunConfig:
    """Return the config of a stream for part files and the command's arguments."""
    return config_of(
        "dopepp_fast", "experiment=my_part", "optimizer.lr=0.012",
        *stream.overrides, *args.overrides,
        f"data.parts=[{','.join(str(file.resolve()) for file in files)}]",
        f"virtual.camera={_CAMERA}", "virtual.working_distance=[0.25,0.5]",
        "data.symmetries=none", f"data.samples_per_epoch={args.renders}", "data.num_val=1",
        # Most maps belong to absent parts; belief terms of the loss are averages over all maps.
        f"model.loss.field_weight={2 / args.parts}", f"init_from={args.start}",
    )  # fmt: skip


def main() -> None:
    """Learn the weights and write them."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--minutes", type=float, default=6.0)
    parser.add_argument("--parts", type=int, default=96)
    parser.add_argument("--seed", type=int, default=0, help="seed of the parts")
    parser.add_argument("--from", dest="start", default="null", help="initial weights")
    parser.add_argument("--device", default="cuda")
    parser.add_argument("--batch", type=int, default=256)
    parser.add_argument("--workers", type=int, default=available_cores())
    parser.add_argument("--renders", type=int, default=100_000, help="most renders of a stream")
    parser.add_argument("--prepare", action="store_true", help="write parts and heaps, then stop")
    parser.add_argument("overrides", nargs="*", help="e.g. optimizer.lr=0.01")
    args = parser.parse_intermixed_args()
    files = write_parts(args.folder, args.parts, args.seed)
    if args.prepare:
        with ProcessPoolExecutor(args.workers, get_context("fork")) as pool:
            list(pool.map(_split, files))
    configs = [stream_config(stream, files, args) for stream in STREAMS]
    parts = build_parts(configs[0].data)
    configs = [fit_to_camera(config, parts) for config in configs]
    streams, seed = [], configs[0].seed
    for config in configs:
        stream = build_datamodule(config.data, parts, seed)
        # Each render is requested by its index, so this source is not shuffled.
        backgrounds = training_backgrounds(config.data)
        stream.train_source = training_renders(config.data, parts, seed, backgrounds)
        stream.train_item(0, 0)  # compiles the rendering code before the workers fork
        streams.append(stream)
    torch.manual_seed(seed)
    replay = Replay(streams, seed)
    options = {"num_workers": args.workers, "multiprocessing_context": "fork"}
    if args.prepare:
        starts = range(0, args.renders, _BLOCK)
        keys = [(1, 0, start + heap) for start in starts for heap in range(_PILES)]
        list(DataLoader(replay, None, sampler=keys, collate_fn=lambda sample: None, **options))
        return
    index = {part.name: number for number, part in enumerate(parts)}
    merge = partial(collate, object_index=index)
    loader = DataLoader(replay, args.batch, sampler=replay, collate_fn=merge, **options)
    system = build_system(configs[0], parts, "")
    print(f"{learn(system, loader, args.minutes, args.device)} images")
    save_start(system.network, args.folder / "dopepp_fast.safetensors")


if __name__ == "__main__":
    main()
