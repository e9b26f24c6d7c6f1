"""Kill a training at random moments, resume it each time, and compare it with one left in peace.

    python benchmarks/crash.py --kills 50

Prints in which phase the kills fell, how many runs were lost, and whether weights, best checkpoint
and metrics of every run are those of the undisturbed one, to the last bit. Every life of a run is a
process of its own, forked when the libraries are imported, which takes longer than the training.
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

import dopepp.experiment.run.train  # noqa: F401 -- the libraries, once
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
"""Columns that no two runs share."""
PATIENCE_S = 600


@dataclass
class Tally:
    """What has happened.

    Attributes:
        phases: In which phase each kill fell.
        lost: Runs that could not be resumed, with the reason.
        different: Runs that ended differently, with what differs.
        finished: Runs that ended.
    """

    phases: Counter[str] = field(default_factory=Counter)
    lost: list[str] = field(default_factory=list)
    different: list[str] = field(default_factory=list)
    finished: int = 0


def start(*arguments: str, log: Path) -> Process:
    """Start ``train.py`` in a process of its own, its output at the end of a file."""
    process = get_context("fork").Process(target=train, args=(arguments, log))
    process.start()
    return process


def train(arguments: tuple[str, ...], log: Path) -> None:
    """Run ``train.py`` with arguments as the shell would."""
    stream = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_APPEND)
    for number in (1, 2):
        os.dup2(stream, number)
    os.chdir(log.parent)
    sys.argv = [str(ROOT / "train.py"), *arguments]
    runpy.run_path(sys.argv[0], run_name="__main__")


def ends_well(process: Process) -> bool:
    """Wait for a run that is left in peace."""
    process.join(PATIENCE_S)
    return process.exitcode == 0


def table(run: Path) -> list[dict[str, str]]:
    """Return the metrics without the columns of time; of these only whether they are there."""
    path = run / "metrics.csv"
    if not path.is_file():
        return []
    with path.open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    return [{k: str(bool(v)) if k in TIMES else v for k, v in row.items()} for row in rows]


def is_saving(run: Path, pid: int) -> bool:
    """Tell whether a process is writing a checkpoint; killed ones have left their halves."""
    return any((run / "checkpoints").glob(f".*-{pid}.partial"))


def phase(run: Path, pid: int, begun: bool) -> str:
    """Tell from the files what a stopped process was doing."""
    if is_saving(run, pid):
        return "saving"
    if not begun:
        return "start-up"
    last = table(run)[-1]
    at_end = int(last["step"]) % STEPS_PER_EPOCH == STEPS_PER_EPOCH - 1
    return "validation" if at_end and not last.get("val/loss") else "training"


def differences(run: Path, whole: Path) -> Iterator[str]:
    """Name what a run left that the undisturbed one did not."""
    if table(run) != table(whole):
        yield "metrics.csv"
    for name in ("last.ckpt", "best.ckpt"):
        killed, undisturbed = (
            torch.load(folder / "checkpoints" / name, weights_only=True) for folder in (run, whole)
        )
        if killed["global_step"] != undisturbed["global_step"]:
            yield f"{name}: step {killed['global_step']} for {undisturbed['global_step']}"
        for key, value in undisturbed["state_dict"].items():
            if not torch.equal(killed["state_dict"][key], value):
                yield f"{name}: {key}"
                break


def live(run: Path, arguments: list[str], rng: random.Random, tally: Tally, log: Path) -> bool:
    """Start a run or go on with it, and kill it; return whether it ended before that."""
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
        # Writing takes a hundredth of the time, so a random moment would hardly ever meet it.
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
    """Kill runs until there have been enough kills, and let the last one end."""
    rng, tally = random.Random(seed), Tally()
    small = [*SMALL, f"trainer.max_epochs={max_epochs}"]
    whole, log = folder / "whole", folder / "log.txt"
    if not ends_well(start(*small, f"hydra.run.dir={whole}", log=log)):
        raise SystemExit(f"the undisturbed run failed, see {log}")
    number = 0
    while sum(tally.phases.values()) < kills:
        run, ended = folder / f"run{number}", False
        begin = [*small, f"hydra.run.dir={run}"]
        while not ended and sum(tally.phases.values()) < kills:
            again = (run / ".hydra" / "resume.json").is_file()
            ended = live(run, [f"resume={run}"] if again else begin, rng, tally, log)
            print(dict(tally.phases), flush=True)
        if not ended and not ends_well(start(f"resume={run}", log=log)):
            tally.lost.append(f"{run.name}: the last resume failed")
        if not any(text.startswith(f"{run.name}:") for text in tally.lost):
            tally.finished += 1
            tally.different += [f"{run.name}: {what}" for what in differences(run, whole)]
        number += 1
    return tally


def main() -> None:
    """Run it and print what came of it."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kills", type=int, default=50)
    parser.add_argument("--epochs", type=int, default=12)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--folder", type=Path, help="kept; a temporary one if left out")
    options = parser.parse_args()
    torch.set_num_threads(1)
    Factory([BUILTIN["pivconnector"]()], PRESETS["paper"], 0)  # what it bakes is kept
    with tempfile.TemporaryDirectory() as temporary:
        folder = options.folder or Path(temporary)
        folder.mkdir(parents=True, exist_ok=True)
        tally = crash(folder.absolute(), options.kills, options.epochs, options.seed)
    kills = ", ".join(f"{count} in {name}" for name, count in sorted(tally.phases.items()))
    print(f"{sum(tally.phases.values())} kills: {kills}")
    print(f"{tally.finished} runs ended, {len(tally.lost)} lost {tally.lost}")
    print(f"differences from the undisturbed run: {tally.different or 'none'}")
    raise SystemExit(bool(tally.lost or tally.different))


if __name__ == "__main__":
    main()
