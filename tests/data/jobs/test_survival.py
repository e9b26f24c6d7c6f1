"""Render jobs that die for real: killed at random moments, and on a disk that is full."""

from __future__ import annotations

import os
import random
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from dopepp.data.check import check_dataset
from dopepp.data.jobs.job import WRITERS

pytestmark = pytest.mark.skipif(os.name != "posix", reason="signals are asked of POSIX")

Contents = Callable[[Path], dict[str, bytes]]
COMMAND = "import sys; from dopepp.cli import app; sys.argv[0] = 'dopepp'; app()"
NUM = 200


def command(out: Path, layout: str, num: int, *more: str) -> list[str]:
    return [
        sys.executable, "-c", COMMAND, "render", "servoholder", "-n", str(num), "--out", str(out),
        "--preset", "quickstart", "--size", "64x48", "--format", layout, *more,
    ]  # fmt: skip


def run(out: Path, layout: str, num: int, *more: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        command(out, layout, num, *more), capture_output=True, text=True, timeout=250, check=False
    )


def wait_for_group(process: int) -> None:
    """Wait until nobody of a process group is left."""
    for _ in range(600):
        try:
            os.killpg(process, 0)
        except ProcessLookupError:
            return
        time.sleep(0.05)
    pytest.fail("workers outlive the job")


@pytest.mark.slow
@pytest.mark.parametrize("layout", WRITERS)
def test_killed_at_random_moments_it_ends_with_the_same_files(
    layout: str, tmp_path: Path, contents: Contents
) -> None:
    whole = run(tmp_path / "whole", layout, NUM, "--workers", "1")
    assert whole.returncode == 0, whole.stderr
    out, rng, codes = tmp_path / "out", random.Random(layout), []
    kinds = [signal.SIGKILL, signal.SIGINT, signal.SIGKILL, signal.SIGTERM, signal.SIGKILL]
    for place, number in enumerate(kinds):
        process = subprocess.Popen(
            command(out, layout, NUM, "--workers", "2"),
            start_new_session=True, text=True, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE,
        )  # fmt: skip
        before = len(contents(out)) if out.exists() else 0
        # From the first new file on, at any moment: while images are written, or chunks finalized.
        while process.poll() is None and (not out.exists() or len(contents(out)) <= before):
            time.sleep(0.01)
        time.sleep(rng.uniform(0, 0.5))
        # Ctrl-C and a scheduler's signal reach the whole group; the first kill the parent alone.
        (os.killpg if place else os.kill)(process.pid, number)
        _, err = process.communicate(timeout=60)
        codes.append(process.returncode)
        wait_for_group(process.pid)
        if process.returncode > 0:
            assert err == "interrupted; the same command goes on where this one stopped\n"
            assert not list(out.rglob("*.partial"))
    # A run that was done before its signal came is no failure of the job.
    allowed = {signal.SIGKILL: -9, signal.SIGINT: 130, signal.SIGTERM: 143}
    for code, number in zip(codes, kinds, strict=True):
        assert code in (allowed[number], 0)
    assert codes[0] == -9
    last = run(out, layout, NUM, "--workers", "2")
    assert last.returncode == 0, last.stderr
    assert contents(out) == contents(tmp_path / "whole")
    report = check_dataset(out)
    assert (report.num_images, report.ok) == (NUM, True), report.lines()


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """Mount a disk of 600 kB; only root may."""
    disk = tmp_path / "disk"
    disk.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=600k", "tmpfs", str(disk)]
    try:
        done = subprocess.run(mount, capture_output=True, check=False)
    except FileNotFoundError:
        pytest.skip("there is no mount")
    if done.returncode:
        pytest.skip("a disk cannot be mounted here")
    yield disk
    subprocess.run(["umount", "-l", str(disk)], check=True)


@pytest.mark.parametrize(
    "layout",
    ["ndds", *(pytest.param(name, marks=pytest.mark.slow) for name in WRITERS if name != "ndds")],
)
def test_on_a_full_disk_it_stops_and_goes_on_with_more_room(
    layout: str, small_disk: Path, tmp_path: Path, contents: Contents
) -> None:
    num = 60
    out = small_disk / "out"
    full = run(out, layout, num, "--workers", "1")
    assert (full.returncode, full.stdout) == (1, "")
    assert full.stderr.startswith(f"no space left for {out}")
    assert full.stderr.count("\n") == 1
    assert not list(out.rglob("*.partial"))
    enlarge = ["mount", "-o", "remount,size=50m", str(small_disk)]
    subprocess.run(enlarge, check=True)
    again = run(out, layout, num, "--workers", "1")
    assert again.returncode == 0, again.stderr
    assert not again.stdout.startswith(f"{num} of")  # what had been made was kept
    whole = run(tmp_path / "whole", layout, num, "--workers", "1")
    assert whole.returncode == 0, whole.stderr
    assert contents(out) == contents(tmp_path / "whole")
