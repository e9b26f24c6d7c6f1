"""``job=cost``: what a network costs in parameters, operations and time (paper Tables 4 and 8).

Nothing is trained. A frame's time is that of the whole way from a picture of the configured data's
test set, at its own resolution, to poses (:mod:`dopepp.experiment.timing` says how an untrained
network can go it), with the network's share beside it.
"""

from __future__ import annotations

import csv
import platform
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from torch import nn

from dopepp.core.checks import check_integer
from dopepp.core.files import write_png, write_whole
from dopepp.data.sample import Sample
from dopepp.drawing.curves import figure_image
from dopepp.drawing.panels import PlotLine, lines_figure
from dopepp.experiment.build.objects import build_parts
from dopepp.experiment.build.sources import build_test_source, held_out_seed
from dopepp.experiment.build.system import build_untrained, map_geometry
from dopepp.experiment.reports.tables import Row, csv_text
from dopepp.experiment.runs import display, record
from dopepp.experiment.runs.readme import write_job_readme
from dopepp.experiment.timing import WARM_UP, FrameTimes, RehearsedEstimator, time_frames
from dopepp.models.network import PoseNetwork, network_cost
from dopepp.parts.part import Part

COST_FILE: Final = "cost.json"
FRAMES_FILE: Final = "frames.csv"

NOTE: Final = (
    "ms/frame: the whole way from a test picture to poses. The network is untrained and would find "
    "nothing, so poses are recovered from the picture's true maps with a trained network's noise."
)
"""What a reader of the times must know."""

_NUM_PICTURES: Final = 8
_BATCHES: Final = 3
_MAX: Final = 10**6


@dataclass(frozen=True)
class NetworkCost:
    """What a network costs on this machine.

    Attributes:
        name: The model's name.
        backbone_weights: Weights of the backbone's convolutions, as the paper counts: no biases.
        parameters: All trained numbers.
        gmacs: Multiply-accumulates of one image of the input size, 10⁹.
        input_size: The network's input (width, height), pixels.
        picture_size: The timed pictures' (width, height), pixels; they are scaled into the input
            and padded no further than the network needs.
        device: What it ran on.
        threads: CPU threads.
        ms_per_frame: Median time from one picture to its poses, milliseconds.
        network_ms: Median time of the network in them, milliseconds.
        recovery_ms: Median time from maps to poses in them, milliseconds.
        batch_size: Images in a batch.
        frames_per_s: Images of the input size that the network alone turns into maps in a second
            in such batches, the fastest of a few.
    """

    name: str
    backbone_weights: int
    parameters: int
    gmacs: float
    input_size: tuple[int, int]
    picture_size: tuple[int, int]
    device: str
    threads: int
    ms_per_frame: float
    network_ms: float
    recovery_ms: float
    batch_size: int
    frames_per_s: float

    def texts(self) -> dict[str, str]:
        """Return what tables print, heading to text."""
        (width, height), (columns, rows) = self.picture_size, self.input_size
        return {
            "picture": f"{width}×{height}",
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


def measure_cost(config: Mapping[str, Any], run_dir: Path) -> NetworkCost:
    """Count and time the chosen network, untrained; write ``cost.json`` and the frames' times.

    Args:
        config: The composed and resolved config, plain values.
        run_dir: Folder that everything is written to.

    Raises:
        UserError: A choice or an option is wrong.
    """
    num_frames = check_integer("cost.num_frames", config["cost"]["num_frames"], 1, _MAX)
    batch_size = check_integer("cost.batch_size", config["cost"]["batch_size"], 1, _MAX)
    seed = check_integer("seed", config["seed"], 0, 2**32 - 1)
    torch.manual_seed(seed)
    has_gpu = torch.cuda.is_available() and config["trainer"]["accelerator"] != "cpu"
    parts = build_parts(config["data"])
    network, description = build_untrained(config, parts)
    parameters, gmacs = network_cost(network, description.input_size)
    samples = _pictures(config["data"], parts)
    estimator = RehearsedEstimator(network, description, "cuda" if has_gpu else "cpu")
    geometry = map_geometry(config["maps"], network.stride)
    frames = time_frames(estimator, samples, geometry, num_frames, seed)
    cost = NetworkCost(
        name=str(config["model"]["name"]),
        backbone_weights=_num_weights(network.backbone),
        parameters=parameters,
        gmacs=gmacs,
        input_size=description.input_size,
        picture_size=samples[0].size,
        device=torch.cuda.get_device_name() if has_gpu else platform.machine(),
        threads=torch.get_num_threads(),
        ms_per_frame=1000 * float(np.median(frames.seconds)),
        network_ms=1000 * float(np.median(frames.network_seconds)),
        recovery_ms=1000 * float(np.median(frames.recovery_seconds)),
        batch_size=batch_size,
        frames_per_s=batch_size / _seconds_of_batch(network, batch_size, description.input_size),
    )
    record.write_config(run_dir, config)
    record.write_json(run_dir / COST_FILE, asdict(cost))
    record.write_json(run_dir / record.VERSIONS_FILE, record.environment(seed, ""))
    write_whole(run_dir / FRAMES_FILE, csv_text(_frame_rows(frames)).encode())
    save_frame_rates(run_dir / "frame_rate.png", {cost.name: frames})
    write_job_readme(run_dir, f"Cost of {cost.name}")
    display.show_table(
        f"{cost.name}, untrained, on {cost.device}",
        [{"measure": measure, "": text} for measure, text in cost.texts().items()],
    )
    display.console.print(NOTE)
    return cost


def read_frames(path: Path) -> FrameTimes:
    """Return what each frame of a cost job took; earlier versions timed the network alone."""
    with path.open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    whole = np.array([float(row["seconds"]) for row in rows])
    network = np.array([float(row.get("network_seconds", row["seconds"])) for row in rows])
    recovery = np.array([float(row.get("recovery_seconds", 0)) for row in rows])
    return FrameTimes(whole, network, recovery)


def save_frame_rates(path: Path, frames: Mapping[str, FrameTimes]) -> None:
    """Draw frames a second over time, two curves per network (paper Fig. 13).

    From picture to poses, and dashed what the network alone would reach.

    Args:
        path: The PNG.
        frames: Times of each frame, by name.
    """
    lines = [
        PlotLine(
            f"{name}, {what}", np.cumsum(times.seconds), 1 / seconds[None], f"C{number}", dashed
        )
        for number, (name, times) in enumerate(frames.items())
        for what, seconds, dashed in (
            ("picture to poses", times.seconds, False),
            ("network alone", times.network_seconds, True),
        )
    ]
    write_png(path, figure_image(lines_figure(lines, "time (s)", "frames a second")))


def _pictures(data: Mapping[str, Any], parts: Sequence[Part]) -> list[Sample]:
    """Render or read the first test pictures, so that no frame's time has that in it."""
    source = build_test_source(data, parts, held_out_seed(data))
    return [source.sample(index) for index in range(min(_NUM_PICTURES, len(source)))]


def _frame_rows(frames: FrameTimes) -> list[Row]:
    columns = vars(frames).items()
    return [
        {"frame": str(number), **{name: f"{values[number]:.6f}" for name, values in columns}}
        for number in range(len(frames.seconds))
    ]


def _num_weights(module: nn.Module) -> int:
    convolutions = (layer for layer in module.modules() if isinstance(layer, nn.Conv2d))
    return sum(layer.weight.numel() for layer in convolutions)


@torch.inference_mode()
def _seconds_of_batch(network: PoseNetwork, batch_size: int, size: tuple[int, int]) -> float:
    """Return the seconds of the fastest of some passes over random images."""
    device = next(network.parameters()).device
    shape = (batch_size, 3, size[1], size[0])
    images = torch.randint(0, 256, shape, dtype=torch.uint8, device=device)
    images = images.contiguous(memory_format=torch.channels_last)
    times = []
    for _ in range(WARM_UP + _BATCHES):
        start = time.perf_counter()
        network.maps(images)
        if device.type == "cuda":
            torch.cuda.synchronize(device)
        times.append(time.perf_counter() - start)
    return min(times[WARM_UP:])
