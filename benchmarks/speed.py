"""Time from a 640×480 frame to refined poses, by network, runtime, precision and instruction set.

    OMP_NUM_THREADS=2 python benchmarks/speed.py [--isa AVX2 native] [--seconds 6] [--only fast]

Each instruction set is measured in a separate process, which prints the kernels that PyTorch and
OpenVINO choose. onnxruntime cannot be limited to an instruction set and is measured natively only.
In a process, all networks and runtimes take turns on the same scenes.

``pivconnector`` is the released network of 128×128. The other networks are untrained, at 416×416,
where a frame of 640×480 becomes 416×320. Their maps are computed and timed, but poses are recovered
from the true maps with a trained network's noise (:mod:`dopepp.experiment.results.cost`). int8 is
calibrated on random pixels. ``tracker`` tracks a part through a rendered sequence
(``benchmarks/track.py``) with the released ``pivconnector_wide``.

All times are milliseconds. *CPU* is the process's time on all its threads. CPU and the times of the
steps are 10th percentiles, which other load affects least.
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

from runtimes import limit, show_kernels, untrained, write_export

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
"""The measured networks and their formats; safetensors is PyTorch."""

RELEASED = {"pivconnector": "pivconnector", "tracker": "pivconnector_wide"}


def export(name: str, layout: str, precision: str, folder: Path) -> Path:
    """Export a network unless its file exists, and return the file."""
    from dopepp.models.checkpoint import load_network

    if name in RELEASED:
        network, checkpoint = load_network(f"pretrained/{RELEASED[name]}")
    else:
        model, *width = name.split()
        network, checkpoint = untrained(model, *(f"model.{option}" for option in width))
        checkpoint.state_dict.update(network.state_dict())
    stem = folder / f"{name.replace(' ', '_')}_{precision}"
    return write_export(network, checkpoint, layout, precision, stem, checkpoint.input_size)


class RuntimeTimes:
    """One network in one runtime, with the times of its frames in milliseconds.

    ``steps`` holds the times of preparing the image, network, decoding and refining per frame.
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
        """Process the next frame, and record its times."""
        call, before = next(self.calls), self.estimator.spent_ms.copy()
        start, cpu_start = time.perf_counter(), time.process_time()
        detections = call()
        self.frame.append(1000 * (time.perf_counter() - start))
        self.cpu.append(1000 * (time.process_time() - cpu_start))
        self.steps.append([spent - before[step] for step, spent in self.estimator.spent_ms.items()])
        self.num_found += len(detections)

    def row(self) -> list[str]:
        """Return first frame, median, 95th percentile, CPU, steps, frames/s and detections."""
        later = self.frame[2:]  # the first frames allocate, compile and choose kernels
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
        """Yield predictions on the rendered scenes in turn."""
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
        """Yield calls that track a part from frame to frame; the sequence repeats."""
        from dopepp.inference.tracker import PoseTracker

        while True:
            tracker = PoseTracker(self.estimator)
            for frame in motion():
                yield lambda frame=frame, tracker=tracker: tracker.track(frame.image, frame.K)


@cache
def scenes() -> list:
    """Render the scenes on which all networks predict."""
    from dopepp.data.rendered import RenderedSource
    from dopepp.parts.catalogue import pivconnector
    from dopepp.virtual import PRESETS, Factory

    factory = Factory([pivconnector()], PRESETS["quickstart"].reframed(*SIZE), 5)
    source = RenderedSource(factory, SCENES, "test")
    return [source.sample(number) for number in range(SCENES)]


@cache
def motion() -> list:
    """Render the frames of the tracker."""
    from track import sequence

    from dopepp.parts.catalogue import pivconnector

    return [*islice(sequence(pivconnector(), 0, 300), TRACKED.start, TRACKED.stop)]


def measure(isa: str, folder: Path, seconds: float, only: str) -> None:
    """Measure one instruction set in this process, and print its table."""
    limit(None if isa == "native" else isa)
    import torch
    from common import print_head, print_row

    from dopepp.core.pool import num_threads

    torch.set_num_threads(num_threads())
    print(
        f"\n{isa}: {num_threads()} threads, ATen {torch.backends.cpu.get_cpu_capability()}, "
        f"load {os.getloadavg()[0]:.1f}"
    )
    show_kernels()
    runs = {}
    for name, formats in NETWORKS.items():
        for layout, precision in formats if only in name else ():
            if layout != "onnx" or isa == "native":
                runtime = {"safetensors": "PyTorch", "onnx": "onnxruntime"}.get(layout, "OpenVINO")
                run = RuntimeTimes(export(name, layout, precision, folder), name == "tracker")
                runs[name, runtime, precision] = run
                run.next()
                run.next()
    for _ in range(ROUNDS):
        for run in runs.values():
            until = time.perf_counter() + seconds / ROUNDS
            run.next()
            while time.perf_counter() < until:
                run.next()
    titles = "network runtime precision first p50 p95 CPU pre maps decode refine frames/s detected"
    print()
    print_head(*titles.split())
    for names, run in runs.items():
        print_row(*names, *run.row())
    print(f"\nload {os.getloadavg()[0]:.1f}", flush=True)


def main() -> None:
    """Export the networks, then measure each instruction set in a fresh process."""
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
