"""Whole frames on this machine: network × runtime × precision × instruction set, DOPE beside.

    OMP_NUM_THREADS=2 python benchmarks/speed.py [--isa AVX2 native] [--seconds 6] [--only fast]

A frame of 640×480 goes in, refined poses come out. Each instruction set has a process of its own,
which proves the limit by the kernels that PyTorch and OpenVINO choose; onnxruntime knows no limit
and is left out under one. In a process all take turns, frame by frame of the same scenes.

``pivconnector`` is the released network of 128×128. The others are untrained, at 416×416, where a
frame of 640×480 is 416×320: their maps are made, timed and put aside, and poses are recovered from
the true maps with a trained network's noise (:mod:`dopepp.experiment.results.cost`); int8 is
calibrated on random pixels. ``tracker`` follows a part through a rendered sequence
(``benchmarks/track.py``) with the released ``pivconnector_wide``. Milliseconds; *CPU*, the
process's time on all its threads, and
the parts are 10th percentiles, which neighbours disturb least: with one thread they are about what
an idle core takes.
"""

from __future__ import annotations

import argparse
import os
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from functools import cache
from itertools import count, islice
from pathlib import Path

from runtimes import config_of, limit, show_kernels

SIZE = (640, 480)
SCENES, ROUNDS, TRACKED = 8, 3, range(30, 130)
EVERY = (
    ("safetensors", "fp32"),
    ("openvino", "fp32"),
    ("openvino", "int8"),
    ("onnx", "fp32"),
    ("onnx", "int8"),
)
NETWORKS = {
    "pivconnector": EVERY,
    "dopepp_fast": EVERY,
    "dopepp_fast width=0.5": EVERY,
    "dope": EVERY[:2],
    "tracker": (EVERY[0], EVERY[2]),
}
"""What is timed, and in which formats; safetensors is PyTorch."""

RELEASED = {"pivconnector": "pivconnector", "tracker": "pivconnector_wide"}


def export(name: str, layout: str, precision: str, folder: Path) -> Path:
    """Return a network's file, which is written where it is not there yet."""
    import numpy as np
    import torch

    from dopepp.experiment.assembly.build_parts import build_parts
    from dopepp.experiment.assembly.build_system import build_untrained
    from dopepp.inference.export import EXPORTERS
    from dopepp.inference.runtimes import Export
    from dopepp.models.checkpoint import load_network

    exporter, ending = EXPORTERS[layout]
    path = folder / f"{name.replace(' ', '_')}_{precision}{ending}"
    if path.exists():
        return path
    if name in RELEASED:
        network, checkpoint = load_network(f"pretrained/{RELEASED[name]}")
    else:
        model, *width = name.split()
        config = config_of(model, *(f"model.{option}" for option in width))
        torch.manual_seed(0)
        network, checkpoint = build_untrained(config, build_parts(config.data))
        checkpoint.state_dict.update(network.state_dict())
    rng, (width, height) = np.random.default_rng(0), checkpoint.input_size
    images = [rng.integers(0, 256, (1, 3, height, width), np.uint8) for _ in range(4)]
    described = Export(layout, precision, network.size_multiple, 0, 0.0)
    exporter(network.eval(), precision, images)(path, checkpoint, described)
    return path


class Side:
    """One network in one runtime: a call a frame, and what the frames took.

    ``steps`` are what of a frame preparing, network, decoding and refining took.
    """

    def __init__(self, path: Path, tracked: bool) -> None:
        import torch

        from dopepp.experiment.results.cost import SimulatedMapsEstimator
        from dopepp.inference import runtimes
        from dopepp.inference.estimator import PoseEstimator
        from dopepp.parts.catalogue import with_meshes

        network, checkpoint = runtimes.load(path, torch.device("cpu"))
        trained = bool(checkpoint.seen)
        kind = PoseEstimator if trained else SimulatedMapsEstimator
        parts = with_meshes(checkpoint.parts)
        self.estimator = kind(network, checkpoint, "cpu", "region", parts)
        self.calls = self._tracked() if tracked else self._frames(trained)
        self.frame: list[float] = []
        self.cpu: list[float] = []
        self.steps: list[list[float]] = []
        self.num_found = 0

    def next(self) -> None:
        """Time a frame."""
        call, before = next(self.calls), self.estimator.spent_ms.copy()
        start, cpu_start = time.perf_counter(), time.process_time()
        detections = call()
        self.frame.append(1000 * (time.perf_counter() - start))
        self.cpu.append(1000 * (time.process_time() - cpu_start))
        self.steps.append([spent - before[step] for step, spent in self.estimator.spent_ms.items()])
        self.num_found += len(detections)

    def row(self) -> list[str]:
        """Return first frame, median, 95th percentile, CPU, parts, frames a second, found."""
        later = self.frame[2:]  # the first allocates, compiles and chooses kernels
        p50, p95 = (
            statistics.median(later),
            statistics.quantiles(later, n=20, method="inclusive")[-1],
        )
        spent = (self.cpu[2:], *zip(*self.steps[2:], strict=True))
        least = [statistics.quantiles(times, n=10, method="inclusive")[0] for times in spent]
        values = [self.frame[0], p50, p95, *least]
        detected = f"{self.num_found} of {len(self.frame)}"
        return [*(f"{value:.1f}" for value in values), f"{1000 / p50:.1f}", detected]

    def _frames(self, trained: bool) -> Iterator[Callable[[], list]]:
        """Yield a prediction on one rendered scene after the other."""
        import torch

        from dopepp.experiment.results.cost import likely_maps
        from dopepp.maps.codec import MapGeometry

        estimator, generator = self.estimator, torch.Generator().manual_seed(0)
        geometry = MapGeometry(estimator.network.stride, estimator.recovery.sigma)
        answers = [
            None if trained else likely_maps(sample, estimator, geometry, generator)
            for sample in scenes()
        ]

        def predict(number: int) -> list:
            estimator.answer, sample = answers[number], scenes()[number]
            return estimator.predict(sample.image, sample.K, cropped=True)

        for number in count():
            yield lambda number=number: predict(number % SCENES)

    def _tracked(self) -> Iterator[Callable[[], list]]:
        """Yield the following of a part from frame to frame, again and again."""
        from dopepp.inference.tracker import PoseTracker

        while True:
            tracker = PoseTracker(self.estimator)
            for frame in motion():
                yield lambda frame=frame, tracker=tracker: tracker.track(frame.image, frame.K)


@cache
def scenes() -> list:
    """Render the scenes that all networks see."""
    from dopepp.data.rendered import RenderedSource
    from dopepp.parts.catalogue import pivconnector
    from dopepp.virtual import PRESETS, Factory

    factory = Factory([pivconnector()], PRESETS["quickstart"].reframed(*SIZE), 5)
    source = RenderedSource(factory, SCENES, "test")
    return [source.sample(number) for number in range(SCENES)]


@cache
def motion() -> list:
    """Render the frames that the tracker follows."""
    from track import sequence

    from dopepp.parts.catalogue import pivconnector

    return [*islice(sequence(pivconnector(), 0, 300), TRACKED.start, TRACKED.stop)]


def measure(isa: str, folder: Path, seconds: float, only: str) -> None:
    """Print the table of one instruction set, in this process."""
    limit(None if isa == "native" else isa)
    import torch

    from dopepp.core.pool import num_threads

    torch.set_num_threads(num_threads())
    print(
        f"\n{isa}: {num_threads()} threads, ATen {torch.backends.cpu.get_cpu_capability()}, "
        f"load {os.getloadavg()[0]:.1f}"
    )
    show_kernels()
    sides = {}
    for name, formats in NETWORKS.items():
        for layout, precision in formats if only in name else ():
            if layout != "onnx" or isa == "native":
                runtime = {"safetensors": "PyTorch", "onnx": "onnxruntime"}.get(layout, "OpenVINO")
                side = Side(export(name, layout, precision, folder), name == "tracker")
                sides[name, runtime, precision] = side
                side.next()
                side.next()
    for _ in range(ROUNDS):
        for side in sides.values():
            until = time.perf_counter() + seconds / ROUNDS
            side.next()
            while time.perf_counter() < until:
                side.next()
    heads = (
        "network",
        "runtime",
        "precision",
        "first",
        "p50",
        "p95",
        "CPU",
        "pre",
        "maps",
        "decode",
        "refine",
        "frames/s",
        "found",
    )
    print(f"\n| {' | '.join(heads)} |\n|{' --- |' * 3}{' ---: |' * 10}")
    for names, side in sides.items():
        print(f"| {' | '.join([*names, *side.row()])} |")
    print(f"\nload {os.getloadavg()[0]:.1f}", flush=True)


def main() -> None:
    """Write the files, then measure each instruction set in a fresh process."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--isa", nargs="+", default=["AVX2", "native"], help="oneDNN's names")
    parser.add_argument("--seconds", type=float, default=6, help="of each row")
    parser.add_argument("--only", default="", help="rows with this in the network's name")
    parser.add_argument("--exports", type=Path, default=Path("outputs/speed"), help="kept files")
    parser.add_argument("--here", action="store_true", help="measure in this process")
    asked = parser.parse_args()
    if asked.here:
        measure(asked.isa[0], asked.exports, asked.seconds, asked.only)
        return
    asked.exports.mkdir(parents=True, exist_ok=True)
    for name, formats in NETWORKS.items():
        for layout, precision in formats if asked.only in name else ():
            export(name, layout, precision, asked.exports)
    for isa in asked.isa:
        options = ["--isa", isa, "--seconds", str(asked.seconds), "--only", asked.only]
        command = [sys.executable, __file__, *options, "--exports", str(asked.exports), "--here"]
        lines = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True).stdout
        for line in lines.splitlines():
            if not line.startswith("onednn_verbose") or ",convolution," in line:
                print(line, flush=True)


if __name__ == "__main__":
    main()
