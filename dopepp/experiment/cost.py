"""``job=cost``: what a network costs in parameters, operations and time (paper Tables 4 and 8).

Nothing is trained, so times are of the network alone, from images to maps; what the way from maps
to poses takes on real maps stands in every evaluation's ``ms/frame``.
"""

from __future__ import annotations

import csv
import platform
import time
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from jaxtyping import Float
from torch import nn

from dopepp.drawing.curves import training_figure
from dopepp.drawing.png import figure_image, write_png, write_whole
from dopepp.experiment import display, record
from dopepp.experiment.build import network_spec
from dopepp.experiment.objects import build_parts
from dopepp.experiment.readme import write_job_readme
from dopepp.experiment.tables import csv_text
from dopepp.models.cost import network_cost
from dopepp.models.gate import check_integer
from dopepp.models.network import PoseNetwork
from dopepp.models.spec import LOSSES, build_network

COST_FILE: Final = "cost.json"
FRAMES_FILE: Final = "frames.csv"

_WARM_UP: Final = 3
"""Passes that allocate memory and choose kernels; they are not timed."""
_BATCHES: Final = 3
_MAX: Final = 10**6


@dataclass(frozen=True)
class NetworkCost:
    """What a network costs on this machine.

    Attributes:
        name: The model's name.
        backbone_weights: Weights of the backbone's convolutions, as the paper counts: no biases.
        parameters: All trained numbers.
        gmacs: Multiply-accumulates of one image, 10⁹.
        input_size: Image (width, height), pixels.
        device: What it ran on.
        threads: CPU threads.
        ms_per_frame: Median time of one image, milliseconds.
        batch_size: Images in a batch.
        frames_per_s: Images a second in such batches, the fastest of a few.
    """

    name: str
    backbone_weights: int
    parameters: int
    gmacs: float
    input_size: tuple[int, int]
    device: str
    threads: int
    ms_per_frame: float
    batch_size: int
    frames_per_s: float

    def texts(self) -> dict[str, str]:
        """Return what tables print, heading to text."""
        return {
            "backbone weights": f"{self.backbone_weights:,}",
            "parameters": f"{self.parameters:,}",
            "GMACs": f"{self.gmacs:.3f}",
            "ms/frame": f"{self.ms_per_frame:.1f}",
            f"frames/s, batch {self.batch_size}": f"{self.frames_per_s:.1f}",
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
    torch.manual_seed(check_integer("seed", config["seed"], 0, 2**32 - 1))
    has_gpu = torch.cuda.is_available() and config["trainer"]["accelerator"] != "cpu"
    model, size = config["model"], tuple(config["data"]["input_size"])
    activation = LOSSES.build(model["loss"]).activation
    network = build_network(network_spec(model, activation, len(build_parts(config["data"]))))
    parameters, gmacs = network_cost(network, size)
    network = network.eval().to("cuda" if has_gpu else "cpu", memory_format=torch.channels_last)  # type: ignore[call-overload]
    seconds = _times(network, 1, size, num_frames)
    cost = NetworkCost(
        name=str(model["name"]),
        backbone_weights=_num_weights(network.backbone),
        parameters=parameters,
        gmacs=gmacs,
        input_size=size,
        device=torch.cuda.get_device_name() if has_gpu else platform.machine(),
        threads=torch.get_num_threads(),
        ms_per_frame=1000 * float(np.median(seconds)),
        batch_size=batch_size,
        frames_per_s=batch_size / float(_times(network, batch_size, size, _BATCHES).min()),
    )
    record.write_config(run_dir, config)
    record.write_json(run_dir / COST_FILE, asdict(cost))
    record.write_json(run_dir / record.VERSIONS_FILE, record.environment(int(config["seed"]), ""))
    frames = [{"frame": n, "seconds": f"{one:.6f}"} for n, one in enumerate(seconds)]
    write_whole(run_dir / FRAMES_FILE, csv_text(frames).encode())
    save_frame_rates(run_dir / "frame_rate.png", {cost.name: seconds})
    write_job_readme(run_dir, f"Cost of {cost.name}")
    display.show_table(
        f"{cost.name}, {size[0]}×{size[1]} pixels, untrained, on {cost.device}",
        [{"measure": measure, "": text} for measure, text in cost.texts().items()],
    )
    return cost


def read_frames(path: Path) -> Float[np.ndarray, "frames"]:
    """Return the seconds that each frame of a cost job took."""
    with path.open(newline="") as stream:
        return np.array([float(row["seconds"]) for row in csv.DictReader(stream)])


def save_frame_rates(path: Path, frames: Mapping[str, Float[np.ndarray, "frames"]]) -> None:
    """Draw frames a second over time, a curve per network (paper Fig. 13).

    Args:
        path: The PNG.
        frames: Seconds of each frame, by name.
    """
    curves = {
        name: (np.cumsum(seconds).tolist(), (1 / seconds).tolist())
        for name, seconds in frames.items()
    }
    log_y = len(frames) > 1  # networks differ by factors; one network's frames hardly vary
    figure = training_figure(curves, "frames a second", "time (s)", log_y)
    write_png(path, figure_image(figure))


def _num_weights(module: nn.Module) -> int:
    convolutions = (layer for layer in module.modules() if isinstance(layer, nn.Conv2d))
    return sum(layer.weight.numel() for layer in convolutions)


@torch.inference_mode()
def _times(
    network: PoseNetwork, batch_size: int, size: tuple[int, int], repeats: int
) -> Float[np.ndarray, "repeats"]:
    """Return the seconds of each of some passes over random images."""
    device = next(network.parameters()).device
    shape = (batch_size, 3, size[1], size[0])
    images = torch.randint(0, 256, shape, dtype=torch.uint8, device=device)
    images = images.contiguous(memory_format=torch.channels_last)
    times = []
    for _ in range(_WARM_UP + repeats):
        start = time.perf_counter()
        network.maps(images)
        if device.type == "cuda":
            torch.cuda.synchronize(device)
        times.append(time.perf_counter() - start)
    return np.array(times[_WARM_UP:])
