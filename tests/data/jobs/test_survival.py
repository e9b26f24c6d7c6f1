"""Render jobs whose processes are killed at random moments."""

import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from dopepp.data.check import check_dataset
from dopepp.data.render_job import WRITERS

pytestmark = pytest.mark.skipif(os.name != "posix", reason="signals are asked of POSIX")

COMMAND = "import sys; from dopepp.cli import app; sys.argv[0] = 'dopepp'; app()"
NUM = 200


def command(out: Path, layout: str, workers: int) -> list[str]:
    return [
        sys.executable, "-c", COMMAND, "render", "servoholder", "-n", str(NUM), "--out", str(out),
        "--preset", "quickstart", "--size", "64x48", "--format", layout, "--workers", str(workers),
    ]  # fmt: skip


def run(out: Path, layout: str, workers: int) -> None:
    subprocess.run(command(out, layout, workers), timeout=250, check=True)


def wait_for_group(process: int) -> None:
    """Wait until all processes of a group have ended."""
    for _ in range(600):
        try:
            os.killpg(process, 0)
        except ProcessLookupError:
            return
        time.sleep(0.05)
    pytest.fail("workers outlive the job")


@pytest.mark.slow
@pytest.mark.parametrize("layout", WRITERS)
def test_a_job_killed_at_random_moments_writes_the_same_files(layout, tmp_path, contents):
    run(tmp_path / "whole", layout, 1)
    out, rng, codes = tmp_path / "out", random.Random(layout), []
    kinds = [signal.SIGKILL, signal.SIGINT, signal.SIGKILL, signal.SIGTERM, signal.SIGKILL]
    for place, number in enumerate(kinds):
        process = subprocess.Popen(
            command(out, layout, 2),
            start_new_session=True, text=True, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE,
        )  # fmt: skip
        before = len(contents(out)) if out.exists() else 0
        # Killed at any moment after the first new file, while writing images or finalizing chunks.
        while process.poll() is None and (not out.exists() or len(contents(out)) <= before):
            time.sleep(0.01)
        time.sleep(rng.uniform(0, 0.5))
        # Ctrl-C and a scheduler's signal reach the group; the first kill reaches the parent only.
        (os.killpg if place else os.kill)(process.pid, number)
        _, err = process.communicate(timeout=60)
        codes.append(process.returncode)
        wait_for_group(process.pid)
        if process.returncode > 0:
            assert err == "interrupted; run the same command again to continue\n"
            assert not list(out.rglob("*.partial"))
    # A run may end before its signal arrives.
    allowed = {signal.SIGKILL: -9, signal.SIGINT: 130, signal.SIGTERM: 143}
    for code, number in zip(codes, kinds, strict=True):
        assert code in (allowed[number], 0)
    assert codes[0] == -9
    run(out, layout, 2)
    assert contents(out) == contents(tmp_path / "whole")
    report = check_dataset(out)
    assert (report.num_images, report.ok) == (NUM, True), report.lines()
