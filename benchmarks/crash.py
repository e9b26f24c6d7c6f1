"""Kill a training run at random moments, resume it, and compare it with an uninterrupted run.

    python benchmarks/crash.py --kills 50

The script prints in which phase the runs were killed, how many runs were lost, and whether weights,
best checkpoint and metrics of each run equal those of the uninterrupted run, to the last bit. Each
start of a run is a separate process, forked after importing the libraries, which takes longer than
the training.
"""

from __future__ import annotations

import argparse
import csv
import os
import random
import runpy
import signal
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from multiprocessing import get_context
from multiprocessing.process import BaseProcess as Process
from pathlib import Path

import torch

import dopepp.experiment.run.train  # noqa: F401 -- import the libraries before forking
from dopepp.parts.catalogue import BUILTIN
from dopepp.virtual.factory import Factory
from dopepp.virtual.presets import PRESETS

ROOT = Path(__file__).parents[1]
STEPS_PER_EPOCH = 8
SMALL = (
    "data=virtual",
    "data.parts=[pivconnector]",
    "virtual.preset=quickstart",
    "data/masking=random",
    "data/augment=photometric",
    "data.input_size=[64,64]",
    f"data.samples_per_epoch={4 * STEPS_PER_EPOCH}",
    "data.batch_size=4",
    "data.num_val=24",
    "data.num_test=2",
    "data.num_workers=2",
    "model.width=0.0625",
    "trainer=cpu",
    "trainer.log_every_n_steps=1",
    "callbacks.last.every_s=0.3",
    "callbacks.last.max_share=1",
)
TIMES = frozenset({"throughput/images_per_s", "throughput/loader_wait"})
"""Columns that differ between equal runs."""
PATIENCE_S = 600


@dataclass
class Tally:
    """Results of all kills."""

    phases: Counter[str] = field(default_factory=Counter)  # Number of kills per phase
    lost: list[str] = field(default_factory=list)  # Runs that could not be resumed, with the reason
    # Differences between finished runs and the uninterrupted run.
    different: list[str] = field(default_factory=list)
    finished: int = 0  # Number of finished runs


def start(*arguments: str, log: Path) -> Process:
    """Start ``train.py`` in a separate process, which appends its output to a file."""
    process = get_context("fork").Process(target=train, args=(arguments, log))
    process.start()
    return process


def train(arguments: tuple[str, ...], log: Path) -> None:
    """Run ``train.py`` with command-line arguments."""
    stream = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_APPEND)
    for number in (1, 2):
        os.dup2(stream, number)
    os.chdir(log.parent)
    sys.argv = [str(ROOT / "train.py"), *arguments]
    runpy.run_path(sys.argv[0], run_name="__main__")


def ends_well(process: Process) -> bool:
    """Wait for a run, and return whether it succeeded."""
    process.join(PATIENCE_S)
    return process.exitcode == 0


def table(run: Path) -> list[dict[str, str]]:
    """Return the metrics; times are replaced by whether the cell has a value."""
    path = run / "metrics.csv"
    if not path.is_file():
        return []
    with path.open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    return [{k: str(bool(v)) if k in TIMES else v for k, v in row.items()} for row in rows]


def is_saving(run: Path, pid: int) -> bool:
    """Return whether a process is writing a checkpoint; earlier processes may have left files."""
    return any((run / "checkpoints").glob(f".*-{pid}.partial"))


def phase(run: Path, pid: int, begun: bool) -> str:
    """Return the phase of a stopped process, determined from its files."""
    if is_saving(run, pid):
        return "saving"
    if not begun:
        return "start-up"
    last = table(run)[-1]
    at_end = int(last["step"]) % STEPS_PER_EPOCH == STEPS_PER_EPOCH - 1
    return "validation" if at_end and not last.get("val/loss") else "training"


def differences(run: Path, whole: Path) -> Iterator[str]:
    """Yield the differences between a run and the uninterrupted run."""
    if table(run) != table(whole):
        yield "metrics.csv"
    for name in ("last.ckpt", "best.ckpt"):
        killed, expected = (
            torch.load(folder / "checkpoints" / name, weights_only=True) for folder in (run, whole)
        )
        if killed["global_step"] != expected["global_step"]:
            yield f"{name}: step {killed['global_step']} for {expected['global_step']}"
        for key, value in expected["state_dict"].items():
            if not torch.equal(killed["state_dict"][key], value):
                yield f"{name}: {key}"
                break


def start_and_kill(
    run: Path, arguments: list[str], rng: random.Random, tally: Tally, log: Path
) -> bool:
    """Start or resume a run, and kill it; return whether the run ended before the kill."""
    path = run / "metrics.csv"
    before = path.stat().st_mtime_ns if path.is_file() else 0
    process = start(*arguments, log=log)
    early = rng.random() < 0.1
    deadline = time.monotonic() + (rng.uniform(0.5, 8) if early else PATIENCE_S)

    def begun() -> bool:
        return path.is_file() and path.stat().st_mtime_ns != before

    while process.is_alive() and not begun() and time.monotonic() < deadline:
        time.sleep(0.01)
    assert process.pid is not None
    if begun():
        time.sleep(rng.uniform(0, 2))
        # Saving takes a hundredth of the time, so random moments would rarely hit it.
        deadline = time.monotonic() + (5 if rng.random() < 0.4 else 0)
        while time.monotonic() < deadline and not is_saving(run, process.pid):
            time.sleep(0.001)
    if process.is_alive():
        os.kill(process.pid, signal.SIGSTOP)
        tally.phases[phase(run, process.pid, begun())] += 1
        process.kill()
        process.join()
        return False
    if process.exitcode:
        tally.lost.append(f"{run.name}: exit {process.exitcode}")
    return True


def crash(folder: Path, kills: int, max_epochs: int, seed: int) -> Tally:
    """Kill runs until the number of kills is reached, and let the last run end."""
    rng, tally = random.Random(seed), Tally()
    small = [*SMALL, f"trainer.max_epochs={max_epochs}"]
    whole, log = folder / "whole", folder / "log.txt"
    if not ends_well(start(*small, f"hydra.run.dir={whole}", log=log)):
        raise SystemExit(f"the uninterrupted run failed, see {log}")
    number = 0
    while sum(tally.phases.values()) < kills:
        run, ended = folder / f"run{number}", False
        begin = [*small, f"hydra.run.dir={run}"]
        while not ended and sum(tally.phases.values()) < kills:
            again = (run / ".hydra" / "resume.json").is_file()
            words = [f"resume={run}"] if again else begin
            ended = start_and_kill(run, words, rng, tally, log)
            print(dict(tally.phases), flush=True)
        if not ended and not ends_well(start(f"resume={run}", log=log)):
            tally.lost.append(f"{run.name}: the last resume failed")
        if not any(text.startswith(f"{run.name}:") for text in tally.lost):
            tally.finished += 1
            tally.different += [f"{run.name}: {entry}" for entry in differences(run, whole)]
        number += 1
    return tally


def main() -> None:
    """Print the kills per phase, and lost and different runs; exit with 1 if there are any."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kills", type=int, default=50)
    parser.add_argument("--epochs", type=int, default=12)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    torch.set_num_threads(1)
    Factory([BUILTIN["pivconnector"]()], PRESETS["paper"], 0)  # the surface is cached
    with tempfile.TemporaryDirectory() as temporary:
        tally = crash(Path(temporary), options.kills, options.epochs, options.seed)
    kills = ", ".join(f"{count} in {name}" for name, count in sorted(tally.phases.items()))
    print(f"{sum(tally.phases.values())} kills: {kills}")
    print(f"{tally.finished} runs ended, {len(tally.lost)} lost {tally.lost}")
    print(f"differences from the uninterrupted run: {tally.different or 'none'}")
    raise SystemExit(bool(tally.lost or tally.different))


if __name__ == "__main__":
    main()
