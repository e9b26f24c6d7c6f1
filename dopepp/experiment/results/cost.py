"""Measure the parameters, operations and time of a network (``job=cost``, paper Tables 4 and 8).

The network is not trained. Each frame passes through
:meth:`~dopepp.inference.estimator.PoseEstimator.predict`, from a test image at its own resolution
to poses. An untrained network would detect nothing, and recovery would take no time. Therefore the
network's maps are computed, timed and discarded, and poses are recovered from the true maps of the
image plus the noise of a trained network (:data:`BELIEF_NOISE`).
"""

from __future__ import annotations

import platform
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import cycle, islice
from pathlib import Path
from typing import Final

import numpy as np
import pandas as pd
import torch
from jaxtyping import UInt8
from torch import nn

from dopepp.core.files import write_file, write_png
from dopepp.data.batch import collate
from dopepp.data.sample import Sample, pad_sample, resize_sample
from dopepp.drawing.curves import PlotLine, figure_image, lines_figure
from dopepp.experiment.assembly.build_parts import build_parts
from dopepp.experiment.assembly.build_sources import held_out_source
from dopepp.experiment.assembly.build_system import build_untrained
from dopepp.experiment.assembly.camera_fit import fit_to_camera
from dopepp.experiment.config.run_config import RunConfig
from dopepp.experiment.results import display
from dopepp.experiment.results.folder import (
    COST_FILE,
    VERSIONS_FILE,
    environment,
    write_config,
    write_json,
)
from dopepp.experiment.results.pages import write_run_readme
from dopepp.geometry.camera import Letterbox
from dopepp.inference.network_estimator import Maps, NetworkEstimator
from dopepp.inference.network_input import resize_and_pad
from dopepp.maps.codec import MapGeometry
from dopepp.models.network import network_cost
from dopepp.training.targets import draw_maps

FRAMES_FILE: Final = "frames.csv"

NOTE: Final = (
    "ms/frame: time from a test image to poses. The untrained network would detect nothing, so "
    "poses are recovered from the image's true maps with the noise of a trained network."
)
"""Note below tables with times."""

BELIEF_NOISE: Final = 0.005
FIELD_NOISE: Final = 0.05
"""Standard deviation per cell of the noise on the true maps. With this noise, recovery takes about
as long as on the maps of trained networks (``benchmarks/decode.py``)."""

WARM_UP: Final = 3  # number of untimed passes, which allocate memory, select kernels and compile


@dataclass(frozen=True)
class NetworkCost:
    """Cost of a network on this machine; sizes are (width, height), pixels; times are medians."""

    name: str
    backbone_weights: int  # of the convolutions, without biases, as in the paper
    parameters: int
    gmacs: float  # 10⁹ multiply-accumulates for one image of the input size
    input_size: tuple[int, int]
    picture_size: tuple[int, int]  # of the timed images, before scaling
    device: str
    threads: int  # of the CPU
    ms_per_frame: float  # from an image to its poses
    network_ms: float  # part of `ms_per_frame`
    recovery_ms: float  # part of `ms_per_frame`, from maps to poses
    batch_size: int
    frames_per_s: float  # of the network alone, in its fastest batch

    def texts(self) -> dict[str, str]:
        """Return sizes, counts and times as texts for tables, by heading."""
        (width, height), (columns, rows) = self.picture_size, self.input_size
        return {
            "image": f"{width}×{height}",
            "input": f"{columns}×{rows}",
            "CPU threads": str(self.threads),
            "backbone weights": f"{self.backbone_weights:,}",
            "parameters": f"{self.parameters:,}",
            "GMACs": f"{self.gmacs:.3f}",
            "ms/frame": f"{self.ms_per_frame:.1f}",
            "of these, the network": f"{self.network_ms:.1f}",
            "of these, maps to poses": f"{self.recovery_ms:.1f}",
            f"network alone, frames/s in batches of {self.batch_size}": f"{self.frames_per_s:.1f}",
        }


class SimulatedMapsEstimator(NetworkEstimator):
    """Estimator that runs its network but recovers poses from the maps in ``answer``."""

    answer: Maps  # for the next prediction, on the device of the estimator
    network_began: float  # of the last pass, in seconds of `perf_counter`
    network_ended: float

    def maps(self, image: UInt8[np.ndarray, "height width 3"]) -> Maps:
        """Run and time the network, then discard its maps and return the maps in ``answer``."""
        self.network_began = time.perf_counter()
        super().maps(image)
        if self.device.type == "cuda":
            torch.cuda.synchronize(self.device)  # wait until the network has finished
        self.network_ended = time.perf_counter()
        return self.answer


def measure_cost(config: RunConfig, run_dir: Path) -> NetworkCost:
    """Measure the untrained network of a config and write ``cost.json`` and the frame times."""
    torch.manual_seed(config.seed)
    has_gpu = torch.cuda.is_available() and config.trainer.accelerator != "cpu"
    parts = build_parts(config.data)
    config = fit_to_camera(config, parts)
    network, description = build_untrained(config, parts)
    parameters, gmacs = network_cost(network, description.input_size)
    source = held_out_source(config.data, parts, "test")
    # Images are prepared first so that frame times exclude reading and rendering.
    samples = [source.sample(index) for index in range(min(8, len(source)))]
    estimator = SimulatedMapsEstimator(network, description, "cuda" if has_gpu else "cpu")
    geometry = MapGeometry(network.stride, config.maps.sigma, config.maps.field_radius)
    frames = time_frames(estimator, samples, geometry, config.cost.num_frames, config.seed)
    convolutions = [layer for layer in network.backbone.modules() if isinstance(layer, nn.Conv2d)]
    cost = NetworkCost(
        name=config.model.name,
        backbone_weights=sum(layer.weight.numel() for layer in convolutions),
        parameters=parameters,
        gmacs=gmacs,
        input_size=description.input_size,
        picture_size=samples[0].size,
        device=torch.cuda.get_device_name() if has_gpu else platform.machine(),
        threads=torch.get_num_threads(),
        ms_per_frame=1000 * float(frames["seconds"].median()),
        network_ms=1000 * float(frames["network_seconds"].median()),
        recovery_ms=1000 * float(frames["recovery_seconds"].median()),
        batch_size=config.cost.batch_size,
        frames_per_s=_frames_per_s(estimator, config.cost.batch_size, description.input_size),
    )
    write_config(run_dir, config.plain)
    write_json(run_dir / COST_FILE, asdict(cost))
    write_json(run_dir / VERSIONS_FILE, environment(config.seed, ""))
    write_file(run_dir / FRAMES_FILE, frames.to_csv(float_format="%.6f").encode())
    save_frame_rates(run_dir / "frame_rate.png", {cost.name: frames})
    write_run_readme(run_dir, f"Cost of {cost.name}")
    display.show_table(
        f"{cost.name}, untrained, on {cost.device}",
        [{"measure": measure, "": text} for measure, text in cost.texts().items()],
    )
    display.console.print(NOTE)
    return cost


def time_frames(
    estimator: SimulatedMapsEstimator,
    samples: Sequence[Sample],
    geometry: MapGeometry,
    num_frames: int,
    seed: int,
) -> pd.DataFrame:
    """Time frames from image to poses, after :data:`WARM_UP` untimed frames.

    ``samples`` are used in turn; ``seed`` is that of the noise on the simulated maps.

    Returns:
        Per frame, the ``seconds`` from image to poses, of which ``network_seconds`` for the
        network and ``recovery_seconds`` for the recovery.
    """
    generator = torch.Generator().manual_seed(seed)
    prepared = [(sample, likely_maps(sample, estimator, geometry, generator)) for sample in samples]
    rows = []
    for sample, estimator.answer in islice(cycle(prepared), WARM_UP + num_frames):
        began = time.perf_counter()
        estimator.predict(sample.image, sample.K, cropped=True)
        ended = time.perf_counter()
        network = estimator.network_ended - estimator.network_began
        rows.append((ended - began, network, ended - estimator.network_ended))
    table = pd.DataFrame(rows[WARM_UP:], columns=["seconds", "network_seconds", "recovery_seconds"])
    return table.rename_axis("frame")


def likely_maps(
    sample: Sample, estimator: NetworkEstimator, geometry: MapGeometry, generator: torch.Generator
) -> Maps:
    """Simulate a trained network's maps of an image: the true poses' maps, with noise."""
    size = estimator.checkpoint.input_size
    letterbox = Letterbox.fit(sample.size, size)
    rows, columns, _ = resize_and_pad(
        sample.image, letterbox, estimator.network.size_multiple
    ).shape
    padded = pad_sample(resize_sample(sample, size), (columns, rows))
    batch = collate([padded], {part.name: number for number, part in enumerate(estimator.parts)})
    true = draw_maps(batch, batch.keypoints, len(estimator.parts), geometry)
    belief, field = (
        (maps[0] + noise * torch.randn(maps[0].shape, generator=generator)).to(estimator.device)
        for maps, noise in zip(true, (BELIEF_NOISE, FIELD_NOISE), strict=True)
    )
    return belief, field


def save_frame_rates(path: Path, frames: Mapping[str, pd.DataFrame]) -> None:
    """Draw frames per second over time, from :func:`time_frames`, as a PNG (paper Fig. 13).

    Each network has a solid curve (image to poses) and a dashed curve (network alone).
    """
    lines = []
    for number, (name, times) in enumerate(frames.items()):
        seconds, colour = times["seconds"].cumsum().to_numpy(), f"C{number}"
        whole, network_rate = (
            1 / times[[name]].to_numpy().T for name in ("seconds", "network_seconds")
        )
        lines.append(PlotLine(f"{name}, image to poses", seconds, whole, colour, False))
        lines.append(PlotLine(f"{name}, network alone", seconds, network_rate, colour, True))
    write_png(path, figure_image(lines_figure(lines, "time (s)", "frames per second")))


@torch.inference_mode()
def _frames_per_s(estimator: NetworkEstimator, batch_size: int, size: tuple[int, int]) -> float:
    """Return the network's frames per second in its fastest pass over random images."""
    device = estimator.device
    shape = (batch_size, 3, size[1], size[0])
    images = torch.randint(0, 256, shape, dtype=torch.uint8, device=device)
    images = images.contiguous(memory_format=torch.channels_last)
    times = []
    for _ in range(WARM_UP + 3):
        start = time.perf_counter()
        estimator.network.maps(images)
        if device.type == "cuda":
            torch.cuda.synchronize(device)
        times.append(time.perf_counter() - start)
    return batch_size / min(times[WARM_UP:])
