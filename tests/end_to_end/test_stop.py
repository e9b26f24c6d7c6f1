"""Signals, full disks and folders that cannot be written, in runs inside this process."""

import logging
import os
import signal
import subprocess
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
import torch

from dopepp.core.files import read_csv
from dopepp.training.system import PoseSystem
from tests.end_to_end.test_resume import last, steps


@contextmanager
def at_step(step: int, act: Callable[[], object]) -> Iterator[None]:
    """Do something in the middle of a step of the runs within."""
    forward = PoseSystem.training_step

    def training_step(system: PoseSystem, *arguments: Any) -> Any:
        if system.global_step == step:
            act()
        return forward(system, *arguments)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(PoseSystem, "training_step", training_step)
        yield


def send(*numbers: int) -> Callable[[], None]:
    def act() -> None:
        for number in numbers:
            os.kill(os.getpid(), number)

    return act


def test_a_signal_saves_the_step(call, find_run, tiny, tmp_path):
    with at_step(0, send(signal.SIGTERM)):
        done = call("train.py", *tiny, f"output_dir={tmp_path}", code=143)
    run = find_run(tmp_path)
    assert "step 1" in done.last_line
    assert done.last_line.endswith(f"resume={run}")
    assert "Traceback" not in done.err
    assert last(run)["global_step"] == 1
    call("train.py", f"resume={run}", code=0)
    assert steps(run) == [0, 1]


@pytest.mark.slow
def test_a_second_ctrl_c_keeps_the_old_checkpoint(call, find_run, tiny, tmp_path, monkeypatch):
    save = torch.save

    def interrupted_save(content: dict[str, Any], stream: Any) -> None:
        stream.write(b"half of a file")
        if content["global_step"] == 2:
            send(signal.SIGINT)()
        stream.seek(0)
        save(content, stream)

    each = ("callbacks.last.every_s=0", "callbacks.last.max_share=1")
    monkeypatch.setattr(torch, "save", interrupted_save)
    with at_step(1, send(signal.SIGINT)):
        done = call("train.py", *tiny, *each, f"output_dir={tmp_path}", code=130)
    run = find_run(tmp_path)
    assert "saved up to step 1" in done.last_line
    assert last(run)["global_step"] == 1
    assert [path.name for path in (run / "checkpoints").iterdir()] == ["last.ckpt"]


@pytest.mark.slow
def test_a_requeued_job_goes_on_in_its_folder(call, find_run, tiny, tmp_path, caplog, monkeypatch):
    caplog.set_level(logging.INFO)
    scontrol = tmp_path / "bin" / "scontrol"
    scontrol.parent.mkdir()
    scontrol.write_text(f'#!/bin/sh\necho "$@" >> {tmp_path}/asked\n')
    scontrol.chmod(0o755)
    command = ("train.py", *tiny, f"output_dir={tmp_path / 'outputs'}")
    monkeypatch.setenv("PATH", f"{scontrol.parent}:{os.environ['PATH']}")
    monkeypatch.setenv("SLURM_JOB_ID", "77")
    with at_step(0, send(signal.SIGTERM, signal.SIGTERM)):
        done = call(*command, code=143)
    assert done.last_line.endswith("; SLURM requeues job 77")
    assert (tmp_path / "asked").read_text() == "requeue 77\n"
    monkeypatch.setenv("SLURM_RESTART_COUNT", "1")
    call(*command, code=0)
    assert "job 77 was requeued: continuing in" in caplog.text
    assert steps(find_run(tmp_path / "outputs")) == [0, 1]


@pytest.mark.slow
def test_an_interrupted_sweep_keeps_what_is_finished(call, tiny, tmp_path):
    seeds: list[int] = []

    def second_job() -> None:
        seeds.append(torch.initial_seed())
        if len(set(seeds)) == 2:
            send(signal.SIGTERM)()

    with at_step(0, second_job):
        call("train.py", "-m", *tiny, "seed=1,2,3", f"output_dir={tmp_path}", code=143)
    (sweep,) = (tmp_path / "compare").iterdir()
    rows = read_csv(sweep / "compare.csv")
    assert rows[0]["instances"] == "3"
    assert rows[1]["object"].startswith("failed: unfinished")
    assert not (sweep / "2").exists()
    advice = f"To continue, add `hydra.sweep.dir={sweep}` to this command."
    readme = (sweep / "README.md").read_text()
    assert readme.startswith("# Multirun: interrupted\n")
    assert advice in readme

    options = ("seed=1,2,3", f"output_dir={tmp_path}", f"hydra.sweep.dir={sweep}")
    call("train.py", "-m", *tiny, *options, code=0)  # the page's way to continue
    assert read_csv(sweep / "compare.csv")[0]["seeds"] == "1, 2, 3"
    assert (sweep / "README.md").read_text().startswith("# Multirun: finished\n")


@pytest.fixture
def small_disk(tmp_path):
    """A file system of twelve megabytes."""
    disk = tmp_path / "disk"
    disk.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=12m", "tmpfs", str(disk)]
    if os.geteuid() != 0 or subprocess.run(mount, capture_output=True, check=False).returncode:
        pytest.skip("only root may mount a small file system")
    yield disk
    subprocess.run(["umount", "-l", str(disk)], check=True)


EVERY_STEP = ("callbacks.last.every_s=0", "callbacks.last.max_share=1", "data.samples_per_epoch=16")


def fill(disk: Path) -> None:
    with (disk / "filler").open("wb", buffering=0) as stream:
        try:
            while True:
                stream.write(bytes(4096))
        except OSError:
            return


@pytest.mark.slow
def test_a_disk_that_stays_full_fails_the_run(small_disk, call, find_run, tiny):
    with at_step(2, lambda: fill(small_disk)):
        done = call("train.py", *tiny, *EVERY_STEP, f"output_dir={small_disk}", code=1)
    run = find_run(small_disk)
    assert done.last_line.startswith("cannot save ")
    assert "No space left on device" in done.last_line
    assert done.last_line.endswith(f"resume={run}")
    assert "Traceback" not in done.err
    assert last(run)["global_step"] == 2
    (small_disk / "filler").unlink()
    call("train.py", f"resume={run}", code=0)
    assert last(run)["global_step"] == 4
    assert steps(run) == [0, 1, 2, 3]


def test_a_disk_that_is_too_small_is_refused_before_training(small_disk, call, tiny):
    fill(small_disk)
    with (small_disk / "filler").open("r+b") as stream:
        stream.truncate((small_disk / "filler").stat().st_size - 2**17)
    done = call("train.py", *tiny, f"output_dir={small_disk}")
    assert f"MB free in {small_disk}" in done.line
    assert "for 4 checkpoints" in done.line


@pytest.mark.parametrize("script", ["train.py", "evaluate.py"])
def test_a_folder_that_cannot_be_written_is_named_at_once(script, call, tiny, tmp_path):
    (tmp_path / "file").write_text("")
    output = f"output_dir={tmp_path / 'file' / 'outputs'}"
    done = call(script, *(tiny if script == "train.py" else ()), output)
    assert f"output folder {tmp_path}/file" in done.line
