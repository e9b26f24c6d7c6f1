"""A process of two is killed, and a service cannot be reached: real ones, tens of seconds each."""

import contextlib
import ctypes
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from dopepp.core.files import read_csv
from dopepp.models.checkpoint import load_network

_PR_SET_CHILD_SUBREAPER = 36

pytestmark = [pytest.mark.slow, pytest.mark.timeout(600)]


def end_of(pid: int, within_s: float) -> int:
    """Wait for a process that this one has started or adopted; return its exit code."""
    deadline = time.monotonic() + within_s
    while time.monotonic() < deadline:
        with contextlib.suppress(ChildProcessError):  # not adopted yet
            result, status = os.waitpid(pid, os.WNOHANG)
            if result:
                return os.waitstatus_to_exitcode(status)
        time.sleep(0.2)
    os.kill(pid, signal.SIGKILL)
    raise AssertionError(f"process {pid} is still there after {within_s} s")


@pytest.mark.ddp
@pytest.mark.skipif(sys.platform != "linux", reason="uses /proc and prctl")
@pytest.mark.parametrize("killed", ["rank 0", "rank 1"])
def test_the_others_end_when_a_process_is_killed(killed, start, tiny, tmp_path):
    ctypes.CDLL(None).prctl(_PR_SET_CHILD_SUBREAPER, 1)  # a child of a dead child is ours
    endless = ("trainer=ddp", "trainer.accelerator=cpu", "trainer.max_epochs=100000")
    with (tmp_path / "err").open("w") as err:
        streams = {"stdout": subprocess.DEVNULL, "stderr": err}
        first = start("train.py", *tiny, *endless, f"output_dir={tmp_path}", **streams)
    try:
        deadline = time.monotonic() + 240
        while not (saved := list(tmp_path.glob("*/*/checkpoints/last.ckpt"))):
            assert first.poll() is None, (tmp_path / "err").read_text()[-4000:]
            assert time.monotonic() < deadline
            time.sleep(0.5)
        children = Path(f"/proc/{first.pid}/task/{first.pid}/children").read_text()
        second = int(children)
        victim, other = (first.pid, second) if killed == "rank 0" else (second, first.pid)
        os.kill(victim, signal.SIGKILL)
        code = end_of(other, within_s=60)
    finally:
        first.kill()
    assert code == 1
    said = (tmp_path / "err").read_text()
    line = said.rstrip("\n").rpartition("\n")[2]
    assert f"process {victim} ({killed} on this machine)" in line
    assert line.endswith(f"the run ends; continue with resume={saved[0].parents[1]}")
    assert "Traceback" not in said
    load_network(saved[0])


def test_a_run_goes_on_without_weights_and_biases(command, tiny, tmp_path, find_run):
    """The real client, online, and a machine that takes no connection."""
    address = {"WANDB_BASE_URL": "http://127.0.0.1:9", "WANDB_API_KEY": "0" * 40}
    started = time.monotonic()
    done = command(
        "train.py", *tiny, "logger=wandb", "logger.wandb.offline=false",
        "logger.wandb.settings.init_timeout=3", f"output_dir={tmp_path}", timeout=400,
        env={**address, "WANDB_MODE": "online", "HOME": str(tmp_path)}, code=0,
    )  # fmt: skip
    assert done.err.count("a logger failed") == 1
    assert time.monotonic() - started < 300
    steps = [row["step"] for row in read_csv(find_run(tmp_path) / "metrics.csv")]
    assert steps == ["0", "1"]
