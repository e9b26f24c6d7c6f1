"""What a network takes in each runtime and precision: PyTorch, onnxruntime, OpenVINO; DOPE beside.

``python benchmarks/runtimes.py`` exports ``pretrained/pivconnector`` at 128×128 and the untrained
``dopepp_fast`` at 416×416 in every format and precision (int8 on random pixels: speed does not
depend on them) and times one image after the other, in one process: the first frame after
loading, median and 95th percentile, and the ratio to PyTorch's float32. ``--isa AVX2`` limits
PyTorch and OpenVINO to an instruction set and proves it by the kernels they choose; onnxruntime has
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
    """Set the libraries' own limits, which are read when they load."""
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

    torch.set_num_threads(num_threads())
    print(f"{num_threads()} threads, ATen {torch.backends.cpu.get_cpu_capability()}")
    if asked.isa:
        show_kernels()
    print(f"{'network':>14}{'size':>6}{'runtime':>16}{'first':>9}{'p50':>9}{'p95':>9}{'ratio':>8}")
    for size in asked.sizes:
        name, network, checkpoint = pivconnector() if size == 128 else untrained("dopepp_fast")
        with tempfile.TemporaryDirectory() as folder:
            runs = dict(candidates(network, checkpoint, size, Path(folder)))
            if asked.dope and size == 416:
                runs["dope pytorch"] = torch_run(untrained("dope")[1], size)
            show(name, size, times(runs, asked.frames))


def pivconnector():
    """Return the released network of the quickstart."""
    from dopepp.models.checkpoint import load_network

    return "pivconnector", *load_network(Path("pretrained/pivconnector"))


def config_of(model: str, *overrides: str):
    """Return a training's config with a model in its full width, on renders of one part."""
    from hydra import compose, initialize_config_dir
    from omegaconf import OmegaConf

    from dopepp.experiment.config.run_config import RunConfig

    conf = Path(__file__).parents[1] / "conf"
    chosen = ["data.parts=[pivconnector]", "data=virtual", f"model={model}", *overrides]
    with initialize_config_dir(str(conf), version_base="1.3"):
        return RunConfig.of(OmegaConf.to_container(compose("train", chosen), resolve=True))


def untrained(model: str):
    """Return an untrained network in its full width."""
    import torch

    from dopepp.experiment.assembly.build_parts import build_parts
    from dopepp.experiment.assembly.build_system import build_untrained

    config = config_of(model)
    torch.manual_seed(0)
    return model, *build_untrained(config, build_parts(config.data))


def candidates(network, checkpoint, size: int, folder: Path) -> Iterator[tuple[str, Callable]]:
    """Yield what is timed, PyTorch first, each loaded from its own file."""
    import numpy as np
    import torch

    from dopepp.inference import runtimes
    from dopepp.inference.export import EXPORTERS
    from dopepp.inference.runtimes import Export

    yield "pytorch fp32", torch_run(network, size)
    rng = np.random.default_rng(0)
    images = [rng.integers(0, 256, (1, 3, size, size), np.uint8) for _ in range(4)]
    for layout, precision in FORMATS:
        exporter, ending = EXPORTERS[layout]
        path = folder / f"{precision}{ending}"
        described = Export(layout, precision, network.size_multiple, 0, 0.0)
        exporter(network, precision, images)(path, checkpoint, described)
        exported, _ = runtimes.load(path, torch.device("cpu"))
        pixels = torch.from_numpy(images[0])
        yield f"{layout} {precision}", lambda run=exported, pixels=pixels: run.maps(pixels)


def torch_run(network, size: int) -> Callable[[], None]:
    """Return one image's way through a network of PyTorch's."""
    import torch

    from dopepp.inference import runtimes

    placed = runtimes.placed(network, torch.device("cpu"))
    pixels = torch.randint(0, 256, (1, 3, size, size), dtype=torch.uint8)

    def run() -> None:
        with torch.inference_mode():
            placed.maps(pixels)

    return run


def times(runs: dict[str, Callable], frames: int) -> dict[str, tuple[float, list[float]]]:
    """Time the first call of each, and then blocks of calls in turn, milliseconds."""
    first = {name: timed(run) for name, run in runs.items()}
    later: dict[str, list[float]] = {name: [] for name in runs}
    for _ in range(ROUNDS):
        for name, run in runs.items():
            run()
            later[name] += [timed(run) for _ in range(-(-frames // ROUNDS))]
    return {name: (first[name], later[name]) for name in runs}


def timed(run: Callable) -> float:
    """Time one call, milliseconds."""
    start = time.perf_counter()
    run()
    return 1000 * (time.perf_counter() - start)


def show(name: str, size: int, measured: dict[str, tuple[float, list[float]]]) -> None:
    """Print a network's lines."""
    base = statistics.median(measured["pytorch fp32"][1])
    for runtime, (first, later) in measured.items():
        p50, p95 = statistics.median(later), statistics.quantiles(later, n=20)[-1]
        print(
            f"{name:>14}{size:>6}{runtime:>16}{first:9.1f}{p50:9.1f}{p95:9.1f}{base / p50:8.2f}",
            flush=True,
        )


def show_kernels() -> None:
    """Print the kernels of a convolution, float32, that PyTorch and OpenVINO choose."""
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
