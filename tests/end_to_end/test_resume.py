import json
import os
import signal
import subprocess
import time
import zipfile
from pathlib import Path
from typing import Any

import pytest
import torch

from dopepp.core.files import read_csv
from dopepp.experiment.run.resume import read_overrides
from dopepp.training.run_checkpoints import newest_checkpoint
from dopepp.training.system import PoseSystem


def rows(run: Path) -> list[dict[str, str]]:
    return read_csv(run / "metrics.csv")


def steps(run: Path) -> list[int]:
    return [int(row["step"]) for row in rows(run)]


def last(run: Path) -> dict[str, Any]:
    return torch.load(run / "checkpoints" / "last.ckpt", weights_only=True)


def test_resume_goes_on_in_the_same_folder(run, call, find_run):
    before = rows(run)
    assert steps(run) == [0, 1]
    call("train.py", f"resume={run}", "trainer.max_epochs=2", code=0)
    assert find_run(run.parents[1]) == run  # no second folder
    assert steps(run) == [0, 1, 2, 3]
    for old, new in zip(before, rows(run)[:2], strict=True):
        assert {name: new[name] for name in old} == old
    assert last(run)["global_step"] == 4
    assert last(run)["epoch"] == 2  # so many are done
    assert json.loads((run / "metrics.json").read_text())["num_images"] == 3

    # A finished run has nothing to continue: it is measured again, nothing else.
    options = read_overrides(run)
    call("train.py", f"resume={run}", code=0)
    assert steps(run) == [0, 1, 2, 3]
    assert read_overrides(run) == options  # none is added to at every resume


def test_an_interrupted_run_ends_as_a_whole_one(call, find_run, tiny, tmp_path, monkeypatch):
    overrides = [*tiny, "trainer.max_epochs=2"]
    call("train.py", *overrides, f"output_dir={tmp_path / 'whole'}", code=0)
    # The last epoch's, though nothing has become better since the first one's.
    assert last(find_run(tmp_path / "whole"))["global_step"] == 4

    def press_ctrl_c(system: PoseSystem, batch: object, batch_idx: int) -> None:
        (text,) = (path.read_text() for path in (tmp_path / "cut").glob("*/*/README.md"))
        assert text.startswith("# dopepp on virtual: running\n")
        if (system.current_epoch, batch_idx) == (1, 1):
            raise KeyboardInterrupt

    handler = signal.getsignal(signal.SIGINT)
    with monkeypatch.context() as patch:
        patch.setattr(PoseSystem, "on_train_batch_start", press_ctrl_c, raising=False)
        done = call("train.py", *overrides, f"output_dir={tmp_path / 'cut'}")
    signal.signal(signal.SIGINT, handler)  # Lightning ignores it from the first one on
    assert done.code == 130, done.err
    assert "Traceback" not in done.err
    run = find_run(tmp_path / "cut")
    # After the first epoch there was a new best one, and a checkpoint to go on from.
    saved = "saved up to step 2 in checkpoints/last.ckpt"
    assert done.last_line == f"interrupted; {saved}; continue with resume={run}"
    assert not (run / "metrics.json").exists()
    readme = (run / "README.md").read_text()
    assert readme.startswith(f"# dopepp on virtual: interrupted\n\n{saved}; continue with")
    assert f"python train.py resume={run}  # continue" in readme

    call("train.py", f"resume={run}", code=0)
    whole, resumed = (rows(folder) for folder in (find_run(tmp_path / "whole"), run))
    assert [row["step"] for row in resumed] == ["0", "1", "2", "3"]
    for name in ("epoch", "train/loss", "val/loss", "lr-Muon"):
        values = [[float(row[name] or "nan") for row in table] for table in (whole, resumed)]
        assert values[1] == pytest.approx(values[0], rel=1e-4, nan_ok=True), name
    ends = [json.loads((folder / "metrics.json").read_text())["objects"]
            for folder in (find_run(tmp_path / "whole"), run)]  # fmt: skip
    assert ends[0] == ends[1]


def test_init_from_starts_a_new_run_with_the_weights(run, call, find_run, tiny, tmp_path):
    path = run / "checkpoints" / "best.ckpt"
    call(
        "train.py", *tiny, f"init_from={path}", "optimizer.lr=1e-12", "scheduler=constant",
        "optimizer.weight_decay=0", f"output_dir={tmp_path / 'new'}", code=0,
    )  # fmt: skip
    fresh = find_run(tmp_path / "new")
    assert fresh != run
    assert last(fresh)["global_step"] == 2  # counted anew
    trained = torch.load(path, weights_only=True)["state_dict"]
    for name, value in last(fresh)["state_dict"].items():
        if "running_" not in name and "num_batches" not in name:  # batch norm still counts
            torch.testing.assert_close(value, trained[name], atol=1e-6, rtol=0)


def test_mistakes_in_the_three_words(run, call, tiny, tmp_path):
    new = f"output_dir={tmp_path / 'new'}"
    checkpoint = run / "checkpoints" / "best.ckpt"
    for overrides, expected in (
        (["resume=/nowhere"], "resume=/nowhere, which has no checkpoints/last.ckpt"),
        ([f"init_from={run}"], "which is not a file"),
        ([f"init_from={checkpoint}", "model.width=0.125"], "whose network differs"),
    ):
        done = call("train.py", *tiny, *overrides, new)
        assert expected in done.line, overrides
        assert not list((tmp_path / "new").glob("*"))  # no folder is left

    done = call("train.py", f"resume={run}", "model/attention=se")
    assert "whose network differs from the config's" in done.line


def damage(path: Path, how: str) -> None:
    content = bytearray(path.read_bytes())
    if how == "cut":
        content = content[: len(content) // 2]
    elif how == "empty":
        content = bytearray()
    else:  # a single byte, inside the largest tensor
        with zipfile.ZipFile(path) as archive:
            largest = max(archive.infolist(), key=lambda member: member.file_size)
        place = largest.header_offset + largest.file_size
        content[place] = (content[place] + 1) % 256
    path.write_bytes(content)


SLOW = [pytest.param(how, marks=pytest.mark.slow) for how in ("cut", "empty")]


@pytest.mark.parametrize("how", ["byte", *SLOW])
def test_resume_takes_the_newest_whole_checkpoint(how, run, call, caplog):
    whole = last(run)["state_dict"]
    folder = run / "checkpoints"
    (folder / "previous.ckpt").write_bytes((folder / "last.ckpt").read_bytes())
    damage(folder / "last.ckpt", how)
    assert newest_checkpoint(run)[0] == folder / "previous.ckpt"
    damage(folder / "previous.ckpt", how)
    done = call("train.py", f"resume={run}", "trainer.max_epochs=2")  # from best.ckpt
    assert done.code == 0, done.err
    assert f"ignoring {folder}/last.ckpt" in caplog.text
    assert f"ignoring {folder}/previous.ckpt" in caplog.text
    assert "continuing from best.ckpt, step 2" in caplog.text
    assert (folder / "last.ckpt.damaged").exists()
    assert steps(run) == [0, 1, 2, 3]
    assert last(run)["global_step"] == 4
    assert not torch.equal(next(iter(last(run)["state_dict"].values())), next(iter(whole.values())))

    for path in folder.glob("*.ckpt"):
        damage(path, how)
    expected = "whose checkpoints are all damaged (last.ckpt, previous.ckpt, best.ckpt)"
    assert expected in call("train.py", f"resume={run}").line


def test_a_run_killed_before_its_first_checkpoint_starts_again_in_its_folder(run, call, find_run):
    losses = [row["train/loss"] for row in rows(run)]
    for path in (run / "checkpoints").iterdir():
        path.unlink()
    done = call("train.py", f"resume={run}", code=0)
    assert f"no checkpoint yet in {run}" in done.out
    assert [row["train/loss"] for row in rows(run)] == losses
    assert find_run(run.parents[1]) == run


def test_hydras_note_of_the_options_is_believed_as_a_whole_or_not_at_all(run):
    options = read_overrides(run)
    (run / ".hydra" / "resume.json").unlink()  # killed before it was written
    assert read_overrides(run) == options
    note = run / ".hydra" / "overrides.yaml"
    note.write_text("".join(note.read_text().splitlines(keepends=True)[:3]))
    assert read_overrides(run) is None


@pytest.mark.slow
@pytest.mark.ddp
@pytest.mark.timeout(900)
def test_two_killed_processes_end_as_whole_ones(start, command, tiny, tmp_path):
    per_epoch = 16
    arguments = [
        *tiny, "trainer=ddp", "trainer.accelerator=cpu", "trainer.max_epochs=3",
        f"data.samples_per_epoch={2 * 4 * per_epoch}", "data/masking=random",
        "callbacks.last.every_s=0.2", "callbacks.last.max_share=1",
    ]  # fmt: skip
    whole, killed = tmp_path / "whole", tmp_path / "killed"
    done = command("train.py", *arguments, f"hydra.run.dir={whole}", timeout=600, code=0)
    # Both together make one run and one report: of the config's tree, of the images, of the folder.
    for text in ("num_test: 3", "3 test images", "run folder"):
        assert done.out.count(text) == 1, text
    assert json.loads((whole / "metrics.json").read_text())["num_images"] == 3
    # The leader of a session, so that all its processes can be killed.
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    process = start(
        "train.py", *arguments, f"hydra.run.dir={killed}", start_new_session=True, **quiet
    )
    deadline = time.monotonic() + 300
    while not (found := steps(killed)) or found[-1] % per_epoch < 3:
        assert process.poll() is None
        assert time.monotonic() < deadline
        time.sleep(0.02)
    os.killpg(process.pid, signal.SIGKILL)
    process.wait()
    assert last(killed)["global_step"] % per_epoch, "a checkpoint in the middle of an epoch"
    command("train.py", f"resume={killed}", timeout=600, code=0)
    assert steps(killed) == steps(whole) == list(range(3 * per_epoch))
    first, other = (last(run)["state_dict"] for run in (killed, whole))
    assert all(torch.equal(first[name], value) for name, value in other.items())


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_a_run_killed_three_times_ends_as_one_left_in_peace(command):
    """At random moments; ``benchmarks/crash.py`` does fifty."""
    done = command("benchmarks/crash.py", "--kills=3", "--epochs=4", timeout=580, code=0)
    assert "3 kills: " in done.out
    assert ", 0 lost []" in done.out
    assert "differences from the uninterrupted run: none" in done.out
