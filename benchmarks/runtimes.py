"""Time per frame of a network in each runtime and precision: PyTorch, onnxruntime, OpenVINO.

``python benchmarks/runtimes.py`` exports ``pretrained/pivconnector`` at 128×128 and the untrained
``dopepp_fast`` at 416×416 in every format and precision. (int8 is calibrated on random pixels,
which do not affect speed.) It times single images in one process: the first frame after loading,
median and 95th percentile, and the speed relative to PyTorch in float32. ``--isa AVX2`` limits
PyTorch and OpenVINO to an instruction set, and prints the kernels that they choose. onnxruntime has
no such limit. ``--dope`` times DOPE at 416×416 as well. ``OMP_NUM_THREADS`` sets the threads.
"""

from __future__ import annotations

import argparse
import os
import statistics
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

FORMATS = (("onnx", "fp32"), ("onnx", "int8"), ("openvino", "fp32"), ("openvino", "int8"))
ROUNDS = 3


def limit(isa: str | None) -> None:
    """Limit PyTorch and OpenVINO to an instruction set; call this before they are imported."""
    if isa is not None:
        os.environ["ONEDNN_MAX_CPU_ISA"] = isa
        os.environ["ATEN_CPU_CAPABILITY"] = isa.lower()


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--isa", help="AVX2, AVX512_CORE, … (oneDNN's names)")
    parser.add_argument("--frames", type=int, default=30)
    parser.add_argument("--sizes", type=int, nargs="+", default=[128, 416])
    parser.add_argument("--dope", action="store_true")
    asked = parser.parse_args()
    limit(asked.isa)
    import torch

    from dopepp.core.pool import num_threads
    from dopepp.models.checkpoint import load_network

    torch.set_num_threads(num_threads())
    print(f"{num_threads()} threads, ATen {torch.backends.cpu.get_cpu_capability()}")
    if asked.isa:
        show_kernels()
    print(f"{'network':>14}{'size':>6}{'runtime':>16}{'first':>9}{'p50':>9}{'p95':>9}{'ratio':>8}")
    for size in asked.sizes:
        if size == 128:
            name, (network, checkpoint) = "pivconnector", load_network("pretrained/pivconnector")
        else:
            name, (network, checkpoint) = "dopepp_fast", untrained("dopepp_fast")
        with tempfile.TemporaryDirectory() as folder:
            runs = dict(candidates(network, checkpoint, size, Path(folder)))
            if asked.dope and size == 416:
                runs["dope pytorch"] = torch_run(untrained("dope")[0], size)
            show(name, size, times(runs, asked.frames))


def config_of(model: str, *overrides: str):
    """Return a config for training a model on renders of one part."""
    from hydra import compose, initialize_config_dir
    from omegaconf import OmegaConf

    from dopepp.experiment.config.run_config import RunConfig

    conf = Path(__file__).parents[1] / "conf"
    chosen = ["data.parts=[pivconnector]", "data=virtual", f"model={model}", *overrides]
    with initialize_config_dir(str(conf), version_base="1.3"):
        return RunConfig.of(OmegaConf.to_container(compose("train", chosen), resolve=True))


def untrained(model: str, *overrides: str):
    """Return an untrained network and its checkpoint."""
    import torch

    from dopepp.experiment.assembly.build_parts import build_parts
    from dopepp.experiment.assembly.build_system import build_untrained

    config = config_of(model, *overrides)
    torch.manual_seed(0)
    return build_untrained(config, build_parts(config.data))


def candidates(network, checkpoint, size: int, folder: Path) -> Iterator[tuple[str, Callable]]:
    """Yield name and prediction of each runtime, PyTorch first, each loaded from its own file."""
    import torch

    from dopepp.inference import runtimes

    yield "pytorch fp32", torch_run(network, size)
    pixels = torch.randint(0, 256, (1, 3, size, size), dtype=torch.uint8)
    for layout, precision in FORMATS:
        path = write_export(
            network, checkpoint, layout, precision, folder / precision, (size, size)
        )
        exported, _ = runtimes.load(path, torch.device("cpu"))
        yield f"{layout} {precision}", lambda run=exported: run.maps(pixels)


def write_export(
    network, checkpoint, layout: str, precision: str, stem: Path, size: tuple[int, int]
) -> Path:
    """Export a network of an input size (width, height) unless its file exists; return the path."""
    import numpy as np

    from dopepp.inference.export import EXPORTERS
    from dopepp.inference.runtimes import Export

    exporter, ending = EXPORTERS[layout]
    path = stem.with_name(stem.name + ending)
    if not path.exists():
        rng, (width, height) = np.random.default_rng(0), size
        images = [rng.integers(0, 256, (1, 3, height, width), np.uint8) for _ in range(4)]
        description = Export(layout, precision, network.size_multiple, 0, 0.0)
        exporter(network.eval(), precision, images)(path, checkpoint, description)
    return path


def torch_run(network, size: int) -> Callable[[], None]:
    """Return a function that computes the maps of one image in PyTorch."""
    import torch

    from dopepp.inference import runtimes

    placed = runtimes.move_to_device(network, torch.device("cpu"))
    pixels = torch.randint(0, 256, (1, 3, size, size), dtype=torch.uint8)

    def run() -> None:
        with torch.inference_mode():
            placed.maps(pixels)

    return run


def times(runs: dict[str, Callable], frames: int) -> dict[str, tuple[float, list[float]]]:
    """Return the milliseconds of each runtime's first call and of later calls, in turn."""
    first = {name: timed(run) for name, run in runs.items()}
    later: dict[str, list[float]] = {name: [] for name in runs}
    for _ in range(ROUNDS):
        for name, run in runs.items():
            run()
            later[name] += [timed(run) for _ in range(-(-frames // ROUNDS))]
    return {name: (first[name], later[name]) for name in runs}


def timed(run: Callable) -> float:
    """Return the wall time of a call in milliseconds."""
    start = time.perf_counter()
    run()
    return 1000 * (time.perf_counter() - start)


def show(name: str, size: int, measured: dict[str, tuple[float, list[float]]]) -> None:
    """Print a line for each runtime of a network."""
    base = statistics.median(measured["pytorch fp32"][1])
    for runtime, (first, later) in measured.items():
        p50, p95 = statistics.median(later), statistics.quantiles(later, n=20)[-1]
        print(
            f"{name:>14}{size:>6}{runtime:>16}{first:9.1f}{p50:9.1f}{p95:9.1f}{base / p50:8.2f}",
            flush=True,
        )


def show_kernels() -> None:
    """Print the kernels that PyTorch and OpenVINO choose for a float32 convolution."""
    import torch

    layer, image = torch.nn.Conv2d(64, 64, 3), torch.zeros(1, 64, 40, 40)
    with torch.inference_mode(), torch.backends.mkldnn.verbose(torch.backends.mkldnn.VERBOSE_ON):
        layer(image)
    from dopepp.inference.runtimes.openvino import compile_model, load_openvino

    model = compile_model(load_openvino("--isa").convert_model(layer.eval(), example_input=image))
    kinds = {
        str(node.get_rt_info()["primitiveType"].astype(str))
        for node in model.get_runtime_model().get_ops()
    }
    print("openvino:", *sorted(kinds))


if __name__ == "__main__":
    main()
