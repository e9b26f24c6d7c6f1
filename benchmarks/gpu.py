"""Speed of the networks on a GPU, and of rendering on the machine's cores, within forty minutes.

    python benchmarks/gpu.py [--out outputs/gpu] [--minutes 40] [--device cuda]

For the untrained ``dope``, ``dopepp`` and ``dopepp_fast`` at 416×416, the tables have

- milliseconds of one image's maps (median, 95th percentile), images per second in batches of 64;
- training images per second (targets, forward, loss, backward, optimiser);
- images per second that the data loader renders, and training images per second on these renders.

Each row is written to ``rows.json`` and ``rows.md`` in ``--out`` when it is measured. After an
interruption or the end of the time, the same command measures missing and failed rows.
``--device cpu --quick`` runs everything in miniature.
"""

from __future__ import annotations

import argparse
import gc
import json
import platform
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from runtimes import config_of

from dopepp.core.files import write_file
from dopepp.core.pool import available_cores
from dopepp.data.batch import Batch, collate
from dopepp.data.datamodule import PoseDataModule
from dopepp.experiment.assembly.build_parts import build_parts
from dopepp.experiment.assembly.build_sources import build_datamodule
from dopepp.experiment.assembly.build_system import build_system
from dopepp.inference import runtimes
from dopepp.training.system import PoseSystem

MODELS = ("dope", "dopepp", "dopepp_fast")
DTYPES = {
    "fp32": torch.float32,
    "tf32": torch.float32,
    "fp16": torch.float16,
    "bf16": torch.bfloat16,
}
WARM_UP = 3

Values = dict[str, float | str]


class Size(NamedTuple):
    """Sizes of the measurements: pixels, batch sizes, seconds per measurement, network width."""

    pixels: int
    batch: int
    training_batch: int
    seconds: float
    width: float


FULL, QUICK = Size(416, 64, 32, 5.0, 1.0), Size(64, 4, 4, 0.3, 0.25)


class Row(NamedTuple):
    """A row of a table: table, settings, and the function that measures it."""

    table: str
    setting: dict[str, str]
    measure: Callable[[], Values]

    @property
    def name(self) -> str:
        """The unique name of the row."""
        return " ".join([self.table, *self.setting.values()])


class Measurements:
    """Measures networks of one size on one device."""

    def __init__(self, device: str, size: Size) -> None:
        self.device, self.size = torch.device(device), size

    def rows(self) -> Iterator[Row]:
        """Yield all rows, the most important first."""
        on_gpu = self.device.type == "cuda"
        eager, compiled = ([*DTYPES], ["tf32", "bf16"]) if on_gpu else (["fp32", "bf16"], ["fp32"])
        ways = [*product(eager, ["eager"]), *product(compiled, ["compiled"])]
        cores = available_cores()
        for table, measure in (("inference", self.inference), ("training", self.training)):
            for precision, how in ways:
                if table == "training" and precision == "fp16":
                    continue  # training uses bf16
                fast = how == "eager" or self.size != QUICK  # compiling takes minutes on a CPU
                for model in MODELS if fast else MODELS[-1:]:
                    setting = {"network": model, "precision": precision, "how": how}
                    yield Row(table, setting, partial(measure, model, precision, how == "compiled"))
        for workers in sorted({1, cores}):
            yield Row("rendering", {"workers": str(workers)}, partial(self.rendering, workers))
        for model in MODELS:
            setting = {"network": model, "precision": "bf16", "workers": str(cores)}
            measure = partial(self.training_on_renders, model, cores)
            yield Row("training on renders", setting, measure)

    def inference(self, model: str, precision: str, compiled: bool) -> Values:
        """Measure single images and batches, from pixels on the device to maps on the device."""
        network = runtimes.move_to_device(self._system(model)[0].network, self.device)
        network = network.to(DTYPES[precision])
        if compiled:
            network.compile(dynamic=False)
        side = self.size.pixels
        values: Values = {}
        for count in (1, self.size.batch):
            images = torch.randint(0, 256, (count, 3, side, side), dtype=torch.uint8)
            images = images.to(self.device).contiguous(memory_format=torch.channels_last)
            with torch.inference_mode(), self._precision(precision):
                seconds = self._times(lambda images=images: network.maps(images))
            if count == 1:
                p50, p95 = np.percentile(seconds, (50, 95))
                values |= {"ms": 1000 * p50, "ms, p95": 1000 * p95}
            else:
                values[f"images/s, batch {count}"] = count / float(np.median(seconds))
        return values

    def training(self, model: str, precision: str, compiled: bool) -> Values:
        """Measure training steps on one batch of renders on the device."""
        system, data = self._system(model, compiled)
        items = [data.train_item(0, index) for index in range(self.size.training_batch)]
        batch = collate(items, {name: number for number, name in enumerate(data.object_names)})
        step = self._step(system, precision)
        with self._precision(precision):
            seconds = self._times(partial(step, batch.to(self.device)))
        return {"images/s": len(batch) / float(np.median(seconds))}

    def rendering(self, workers: int) -> Values:
        """Measure the images per second that the loader renders, masks and augments."""
        _, data = self._system("dopepp_fast", workers=workers)
        return {"images/s": self._rate(data, lambda _: None)}

    def training_on_renders(self, model: str, workers: int) -> Values:
        """Measure training images per second while the loader renders them."""
        system, data = self._system(model, workers=workers)
        step = self._step(system, "bf16")
        return {"images/s": self._rate(data, lambda batch: step(batch.to(self.device)))}

    def _system(
        self, model: str, compiled: bool = False, workers: int = 0
    ) -> tuple[PoseSystem, PoseDataModule]:
        """Return an untrained network with its loss and optimiser, and rendered data."""
        side, count = self.size.pixels, self.size.training_batch
        config = config_of(
            model,
            f"data.input_size=[{side},{side}]",
            f"data.batch_size={count}",
            f"model.width={self.size.width}",
            f"data.num_workers={workers}",
            f"compile={compiled}",
        )
        parts = build_parts(config.data)
        system = build_system(config, parts, "").to(self.device).train()
        return system, build_datamodule(config.data, parts, config.seed)

    def _step(self, system: PoseSystem, precision: str) -> Callable[[Batch], None]:
        """Return a function that makes a training step on a batch."""
        parameters = [*system.network.parameters()]
        optimizer = system.make_optimizer(parameters)
        half = precision == "bf16"

        def step(batch: Batch) -> None:
            with torch.autocast(self.device.type, torch.bfloat16, enabled=half):
                stages = system(batch.images)
                loss, _ = system.loss(stages, *system.targets(batch, stages))
            optimizer.zero_grad(set_to_none=True)
            loss.backward()
            torch.nn.utils.clip_grad_norm_(parameters, 1.0)
            optimizer.step()

        return step

    def _precision(self, precision: str) -> AbstractContextManager[Any]:
        """Allow or forbid TensorFloat-32 in convolutions and matrix products."""
        torch.set_float32_matmul_precision("high" if precision == "tf32" else "highest")
        return torch.backends.cudnn.flags(benchmark=True, allow_tf32=precision == "tf32")

    def _times(self, call: Callable[[], object]) -> list[float]:
        """Return the seconds of calls, each until the device has finished."""
        seconds: list[float] = []
        begun = time.perf_counter()
        while len(seconds) < 2 * WARM_UP or time.perf_counter() - begun < self.size.seconds:
            if len(seconds) == WARM_UP:
                begun = time.perf_counter()
            start = time.perf_counter()
            call()
            self._wait()
            seconds.append(time.perf_counter() - start)
        return seconds[WARM_UP:]

    def _rate(self, data: PoseDataModule, use: Callable[[Batch], None]) -> float:
        """Return images per second, without the batches that workers prepare in advance."""
        loader, images, begun, ready = data.train_dataloader(), 0, 0.0, 2 * data.num_workers
        for number, batch in enumerate(loader):
            use(batch)
            if number < ready + WARM_UP:
                self._wait()
                begun = time.perf_counter()
                continue
            images += len(batch)
            if time.perf_counter() - begun > 4 * self.size.seconds:
                break
        self._wait()
        return images / (time.perf_counter() - begun)

    def _wait(self) -> None:
        if self.device.type == "cuda":
            torch.cuda.synchronize(self.device)


def measure(rows: list[Row], folder: Path, machine: str, minutes: float) -> int:
    """Measure the rows missing in a folder; return the number of rows that are still missing.

    A row that needs too much memory or that torch cannot compile is written with the reason.
    """
    file, begun = folder / "rows.json", time.monotonic()
    kept = json.loads(file.read_text()) if file.is_file() else {"machine": machine, "rows": {}}
    if kept["machine"] != machine:
        raise SystemExit(
            f"{file} was measured on {kept['machine']}, not on {machine}: pass another --out"
        )
    done: dict[str, Values] = kept["rows"]
    for row in rows:
        if row.name in done and "failed" not in done[row.name]:
            continue
        if time.monotonic() - begun > 60 * minutes:
            break
        try:
            values = row.measure()
        except (RuntimeError, NotImplementedError) as error:
            values = {"failed": f"{type(error).__name__}: {str(error).strip():.120}".split("\n")[0]}
        done[row.name] = values
        write_file(file, json.dumps(kept, indent=1).encode())
        write_file(folder / "rows.md", "\n".join(markdown(rows, done, machine)).encode())
        print(row.name, *(f"{key}: {shown(value)}" for key, value in values.items()), flush=True)
        gc.collect()
        torch._dynamo.reset()
        torch.cuda.empty_cache()
    return sum(row.name not in done for row in rows)


def markdown(rows: list[Row], done: Mapping[str, Values], machine: str) -> Iterator[str]:
    """Yield the lines of all tables."""
    yield machine
    for table in dict.fromkeys(row.table for row in rows):
        listed = [row for row in rows if row.table == table and row.name in done]
        heads = dict.fromkeys(key for row in listed for key in (*row.setting, *done[row.name]))
        if listed:
            yield from ("", f"**{table}**", "", f"| {' | '.join(heads)} |")
            yield f"|{' --- |' * len(heads)}"
        for row in listed:
            values = {**row.setting, **done[row.name]}
            yield f"| {' | '.join(shown(values.get(head, '')) for head in heads)} |"
    yield ""


def shown(value: float | str) -> str:
    """Return a number with three digits."""
    return value if isinstance(value, str) else f"{value:.3g}" if value < 100 else f"{value:.0f}"


def main() -> None:
    """Measure missing rows, and print whether rows are still missing."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("outputs/gpu"))
    parser.add_argument("--minutes", type=float, default=35, help="start no row after this time")
    parser.add_argument("--device", default="cuda")
    parser.add_argument("--quick", action="store_true", help="small networks and images")
    asked = parser.parse_args()
    if asked.device.startswith("cuda") and not torch.cuda.is_available():
        raise SystemExit("PyTorch finds no GPU; --device cpu --quick tests the command")
    on_gpu = asked.device.startswith("cuda")
    name = torch.cuda.get_device_name(asked.device) if on_gpu else platform.machine()
    size, cores = QUICK if asked.quick else FULL, available_cores()
    side = f"{size.pixels}×{size.pixels} pixels"
    machine = f"{name}, {cores} cores, PyTorch {torch.__version__}, {side}"
    rows = [*Measurements(asked.device, size).rows()]
    try:
        missing = measure(rows, asked.out, machine, asked.minutes)
    except KeyboardInterrupt:
        raise SystemExit(f"interrupted; {asked.out} holds the measured rows") from None
    state = f"lacks {missing} rows: run the command again" if missing else "is complete"
    print(asked.out / "rows.md", state)


if __name__ == "__main__":
    main()
