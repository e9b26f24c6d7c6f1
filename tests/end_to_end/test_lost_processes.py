"""A process of two is killed, and a service cannot be reached: real ones, tens of seconds each."""

from __future__ import annotations

import contextlib
import ctypes
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest

from dopepp.models.checkpoint.schema import load_network

ROOT = Path(__file__).parents[2]
_PR_SET_CHILD_SUBREAPER = 36

pytestmark = [pytest.mark.slow, pytest.mark.timeout(600)]


def environment(folder: Path) -> dict[str, str]:
    return {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": str(ROOT), "HOME": str(folder)}


def end_of(pid: int, within_s: float) -> int:
    """Wait for a process that this one has started or adopted; return its exit code."""
    deadline = time.monotonic() + within_s
    while time.monotonic() < deadline:
        with contextlib.suppress(ChildProcessError):  # not adopted yet
            found, status = os.waitpid(pid, os.WNOHANG)
            if found:
                return os.waitstatus_to_exitcode(status)
        time.sleep(0.2)
    os.kill(pid, signal.SIGKILL)
    raise AssertionError(f"process {pid} is still there after {within_s} s")


def children(pid: int) -> list[int]:
    listed = Path(f"/proc/{pid}/task/{pid}/children").read_text()
    return [int(text) for text in listed.split()]


@pytest.mark.ddp
@pytest.mark.skipif(sys.platform != "linux", reason="uses /proc and prctl")
@pytest.mark.parametrize("killed", ["rank 0", "rank 1"])
def test_the_others_end_when_a_process_is_killed(killed, tiny, tmp_path):
    ctypes.CDLL(None).prctl(_PR_SET_CHILD_SUBREAPER, 1)  # a child of a dead child is ours
    with (tmp_path / "err").open("w") as err:
        first = subprocess.Popen(
            [
                sys.executable, str(ROOT / "train.py"), *tiny, "trainer=ddp",
                "trainer.accelerator=cpu", "trainer.max_epochs=100000", f"output_dir={tmp_path}",
            ],
            env=environment(tmp_path), cwd=tmp_path, stdout=subprocess.DEVNULL, stderr=err,
        )  # fmt: skip
    try:
        deadline = time.monotonic() + 240
        while not (saved := list(tmp_path.glob("*/*/checkpoints/last.ckpt"))):
            assert first.poll() is None, (tmp_path / "err").read_text()[-4000:]
            assert time.monotonic() < deadline
            time.sleep(0.5)
        (second,) = children(first.pid)
        victim, other = (first.pid, second) if killed == "rank 0" else (second, first.pid)
        os.kill(victim, signal.SIGKILL)
        code = end_of(other, within_s=60)
    finally:
        first.kill()
    assert code == 1
    said = (tmp_path / "err").read_text()
    line = said.rstrip("\n").rpartition("\n")[2]
    assert f"process {victim} ({killed} on this machine)" in line
    assert line.endswith(f"the run ends; go on with resume={saved[0].parents[1]}")
    assert "Traceback" not in said
    load_network(saved[0])


def test_a_run_goes_on_without_weights_and_biases(tiny, tmp_path, find_run):
    """The real client, online, and a machine that takes no connection."""
    address = {"WANDB_BASE_URL": "http://127.0.0.1:9", "WANDB_API_KEY": "0" * 40}
    kept = {k: v for k, v in environment(tmp_path).items() if not k.startswith("WANDB_")}
    started = time.monotonic()
    done: Any = subprocess.run(
        [
            sys.executable, str(ROOT / "train.py"), *tiny, "logger=wandb",
            "logger.wandb.offline=false", "logger.wandb.settings.init_timeout=3",
            f"output_dir={tmp_path}",
        ],
        env={**kept, **address}, cwd=tmp_path, text=True, timeout=400, check=False,
        stdout=subprocess.DEVNULL, stderr=subprocess.PIPE,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr[-4000:]
    assert done.stderr.count("a logger failed") == 1
    assert time.monotonic() - started < 300
    table = (find_run(tmp_path) / "metrics.csv").read_text().splitlines()
    assert [row.split(",")[0] for row in table] == ["step", "0", "1"]
