"""Render jobs as a user runs them: processes, signals, kills, and a machine without torch."""

from __future__ import annotations

import os
import pickle
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from dopepp.core.errors import UserError
from dopepp.core.interrupts import StoppedError
from dopepp.data.jobs.folder import begin
from dopepp.data.jobs.job import Job, make_job
from dopepp.data.jobs.processes import ProcessPool, available_cores, check_workers
from dopepp.data.jobs.render_dataset import render_dataset
from dopepp.data.jobs.work import Task, Work, Worker

COMMAND = "import sys; from dopepp.cli import app; sys.argv[0] = 'dopepp'; app()"
NUM = 100
OPTIONS = ("--preset", "quickstart", "--size", "128x96", "--format", "ndds")

pytestmark = pytest.mark.skipif(os.name != "posix", reason="signals are asked of POSIX")


def make_work(root: Path) -> Work:
    return Work(small_job().factory, "ndds", root)


def small_job() -> Job:
    return make_job(["servoholder"], preset="quickstart", size="128x96", layout="ndds")


def contents(root: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in root.iterdir()}


@pytest.fixture
def bare_environment(tmp_path: Path) -> dict[str, str]:
    """Return an environment in which nobody can import torch."""
    for name in ("torch", "lightning", "torchmetrics"):
        folder = tmp_path / "poison" / name
        folder.mkdir(parents=True)
        (folder / "__init__.py").write_text("raise RuntimeError('rendering needs no torch')")
    paths = [str(tmp_path / "poison"), *filter(None, [os.environ.get("PYTHONPATH")])]
    return os.environ | {"PYTHONPATH": os.pathsep.join(paths)}


class Run:
    """A running ``dopepp render``, in a process group of its own as a terminal would make it."""

    def __init__(self, out: Path, environment: dict[str, str], workers: int) -> None:
        arguments = ["render", "servoholder", "-n", str(NUM), "--out", str(out), *OPTIONS]
        self._out = out
        self.process = subprocess.Popen(
            [sys.executable, "-c", COMMAND, *arguments, "--workers", str(workers)],
            cwd=out.parent, env=environment, start_new_session=True, text=True,
            stdout=subprocess.PIPE, stderr=subprocess.PIPE,
        )  # fmt: skip

    def wait_for(self, num_images: int) -> None:
        while sum(1 for path in self._out.glob("0*.json")) < num_images:
            assert self.process.poll() is None, self.process.communicate()
            time.sleep(0.005)

    def end(self) -> tuple[int, str, str]:
        out, err = self.process.communicate(timeout=60)
        return self.process.returncode, out, err

    def wait_for_orphans(self) -> None:
        for _ in range(600):
            try:
                os.killpg(self.process.pid, 0)
            except ProcessLookupError:
                return
            time.sleep(0.05)
        pytest.fail("workers outlive the job")


@pytest.mark.slow
def test_killed_interrupted_and_terminated_it_ends_with_the_same_files(
    tmp_path: Path, bare_environment: dict[str, str]
) -> None:
    out, ends = tmp_path / "out", []
    killed = Run(out, bare_environment, workers=2)
    killed.wait_for(10)
    killed.process.kill()
    assert killed.end()[0] == -signal.SIGKILL
    killed.wait_for_orphans()
    for number, num_images in ((signal.SIGINT, 25), (signal.SIGTERM, 45)):
        run = Run(out, bare_environment, workers=2)
        run.wait_for(num_images)
        # Ctrl-C reaches the whole group; a scheduler's signal may reach one or all.
        os.killpg(run.process.pid, number)
        ends.append(run.end())
        run.wait_for_orphans()
        assert not list(out.glob(".*"))
    last = Run(out, bare_environment, workers=1).end()
    line = "interrupted; the same command goes on where this one stopped\n"
    assert ends == [(130, "", line), (143, "", line)]
    assert last[0] == 0, last[2]
    assert f"of {NUM} images rendered in" in last[1]
    # One process here, two there and one again: the same bytes.
    job, whole = small_job(), tmp_path / "whole"
    begin(whole, job.record)
    writer, worker = make_work(whole).writer(), Worker(pickle.dumps(make_work(whole)))
    writer.prepare()
    assert worker.perform(Task(0, range(NUM))).error is None
    assert worker.perform(Task(0, range(NUM), finalizes=True)).finalized
    assert contents(out) == contents(whole)


def test_a_worker_that_dies_is_one_line(tmp_path: Path) -> None:
    root = tmp_path.resolve()
    begin(root, small_job().record)
    content = pickle.dumps(make_work(root))

    def tasks() -> Iterator[Task]:
        for index in range(1000):
            yield Task(0, range(index, index + 1))

    with ProcessPool(content, 1) as pool:
        process = pool._processes[0].process
        outcomes = pool.run(tasks())
        assert next(outcomes).error is None
        os.kill(process.pid or 0, signal.SIGKILL)
        with pytest.raises(StoppedError, match=r"a worker process died \(signal 9\)"):
            list(outcomes)
    assert not process.is_alive()


def test_a_pool_reads_no_further_ahead_than_it_has_room(tmp_path: Path) -> None:
    begin(tmp_path, small_job().record)
    read = 0

    def tasks() -> Iterator[Task]:
        nonlocal read
        for chunk in range(50):
            read = chunk + 1
            yield Task(chunk, range(0), finalizes=False)

    done = []
    with ProcessPool(pickle.dumps(make_work(tmp_path)), 2) as pool:
        for outcome in pool.run(tasks()):
            assert outcome.error is None
            done.append(outcome.task.chunk)
            assert read <= len(done) + 4
        assert list(pool.run([])) == []
    assert sorted(done) == list(range(50))


def test_an_error_in_a_worker_arrives_as_what_it_was(tmp_path: Path) -> None:
    def open_pool(content: bytes, num_tasks: int) -> ProcessPool:
        (tmp_path / "_dopepp_render.json").unlink()
        return ProcessPool(content, min(num_tasks, 2))

    with pytest.raises(UserError, match="as one of the workers sees it"):
        render_dataset(small_job(), tmp_path, 3, open_pool)


def test_cores_and_workers() -> None:
    assert 1 <= available_cores() <= (os.cpu_count() or 1)
    for num in (0, -1, 1025):
        with pytest.raises(UserError, match=f"--workers {num}; allowed: 1 to 1024"):
            check_workers(num)


def test_the_command_line_starts_light() -> None:
    code = "import sys, dopepp.cli; print({'numpy', 'cv2', 'torch', 'numba'} & set(sys.modules))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "set()\n"
