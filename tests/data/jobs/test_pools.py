"""Pools of processes, Ray clusters and killed jobs write the same bytes."""

import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from dopepp.core.errors import StoppedError, UserError
from dopepp.core.pool import ClusterPool, ProcessPool
from dopepp.data.check import check_dataset
from dopepp.data.render_job import WRITERS
from dopepp.data.render_run import Shard, render_dataset
from tests.core.test_pool import wait_for_group
from tests.data.makers import contents, small_job

NUM = 60
posix = pytest.mark.skipif(os.name != "posix", reason="signals are asked of POSIX")


def test_an_error_of_a_worker_keeps_its_type(tmp_path):
    def open_pool(content):
        (tmp_path / "_dopepp_render.json").unlink()
        return ProcessPool(content, 1)

    with pytest.raises(UserError, match="in which a worker finds no"):
        render_dataset(small_job(), tmp_path, 3, open_pool)


@posix
def test_a_dead_worker_is_one_line(tmp_path):
    pools = []

    def open_pool(content):
        pools.append(ProcessPool(content, 1))
        return pools[0]

    def kill_the_worker(done, total):
        if done == 2:
            os.kill(pools[0]._processes[0].pid, signal.SIGKILL)

    message = r"a worker process died \(signal 9\); if memory .*; run the same command again"
    with pytest.raises(StoppedError, match=message):
        render_dataset(small_job("ndds"), tmp_path, NUM, open_pool, on_progress=kill_the_worker)


@pytest.mark.slow
@pytest.mark.parametrize("layout", WRITERS)
def test_workers_and_nodes_write_the_same_bytes(layout, two_nodes, tmp_path):
    job = small_job(layout, size="64x48")
    for num in (1, 2):
        render_dataset(job, tmp_path / str(num), NUM, lambda work: ProcessPool(work, num))  # noqa: B023
    for number in range(2):
        pools = []

        def open_pool(content):
            pools.append(ClusterPool(content, two_nodes.address, 1))  # noqa: B023
            return pools[0]  # noqa: B023

        render_dataset(job, tmp_path / "ray", NUM, open_pool, Shard(number, 2))
        assert len(pools[0].num_tasks) == 2  # both nodes had work
    whole = contents(tmp_path / "1")
    assert sum(len(content) for content in whole.values()) > 1000 * NUM
    assert (contents(tmp_path / "2"), contents(tmp_path / "ray")) == (whole, whole)


COMMAND = "import sys; from dopepp.cli import app; sys.argv[0] = 'dopepp'; app()"
NUM_KILLED = 200


def command(out: Path, layout: str, workers: int) -> list[str]:
    return [
        sys.executable, "-c", COMMAND, "render", "servoholder", "-n", str(NUM_KILLED),
        "--preset", "quickstart", "--size", "64x48", "--format", layout, "--workers", str(workers),
        "--out", str(out),
    ]  # fmt: skip


def run(out: Path, layout: str, workers: int) -> None:
    subprocess.run(command(out, layout, workers), timeout=250, check=True)


@posix
@pytest.mark.slow
@pytest.mark.parametrize("layout", WRITERS)
def test_a_job_killed_at_random_moments_writes_the_same_files(layout, tmp_path):
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
    assert (report.num_images, report.ok) == (NUM_KILLED, True), report.lines()
