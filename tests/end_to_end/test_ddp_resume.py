"""A run of two processes is killed in mid-epoch, and goes on as if it had not been."""

from __future__ import annotations

import csv
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch

ROOT = Path(__file__).parents[2]
STEPS_PER_EPOCH = 16

pytestmark = [pytest.mark.slow, pytest.mark.ddp, pytest.mark.timeout(900)]


def start(folder: Path, *arguments: str) -> subprocess.Popen[bytes]:
    """Start ``train.py`` as the leader of a session, so that all its processes can be killed."""
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": str(ROOT)}
    return subprocess.Popen(
        [sys.executable, str(ROOT / "train.py"), *arguments],
        cwd=folder, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE,
        start_new_session=True,
    )  # fmt: skip


def finish(folder: Path, *arguments: str) -> None:
    process = start(folder, *arguments)
    _, said = process.communicate(timeout=600)
    assert process.returncode == 0, said.decode()[-4000:]


def steps(run: Path) -> list[int]:
    """Return the steps whose loss is in the metrics."""
    path = run / "metrics.csv"
    if not path.is_file():
        return []
    with path.open(newline="") as stream:
        return [int(row["step"]) for row in csv.DictReader(stream) if row["train/loss"]]


def test_two_processes_go_on_in_mid_epoch(tiny, tmp_path):
    arguments = [
        *tiny, "trainer=ddp", "trainer.accelerator=cpu", "trainer.max_epochs=3",
        f"data.samples_per_epoch={2 * 4 * STEPS_PER_EPOCH}", "data/masking=random",
        "callbacks.last.every_s=0.2", "callbacks.last.max_share=1",
    ]  # fmt: skip
    whole, killed = tmp_path / "whole", tmp_path / "killed"
    finish(tmp_path, *arguments, f"hydra.run.dir={whole}")
    process = start(tmp_path, *arguments, f"hydra.run.dir={killed}")
    deadline = time.monotonic() + 300
    while not (found := steps(killed)) or found[-1] % STEPS_PER_EPOCH < 3:
        assert process.poll() is None
        assert time.monotonic() < deadline
        time.sleep(0.02)
    os.killpg(process.pid, signal.SIGKILL)
    process.communicate()
    saved = torch.load(killed / "checkpoints" / "last.ckpt", weights_only=True)["global_step"]
    assert saved % STEPS_PER_EPOCH, "a checkpoint in the middle of an epoch"
    finish(tmp_path, f"resume={killed}")
    assert steps(killed) == steps(whole) == list(range(3 * STEPS_PER_EPOCH))
    one, other = (
        torch.load(run / "checkpoints" / "last.ckpt", weights_only=True)["state_dict"]
        for run in (killed, whole)
    )
    assert all(torch.equal(one[name], value) for name, value in other.items())
