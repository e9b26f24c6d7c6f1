import errno
import os
import subprocess

import pytest
import torch

from dopepp.core.files import partial_path
from dopepp.training.run_checkpoints import AtomicCheckpointIO, SavingFailedError, sweep


@pytest.mark.parametrize("weights_only", [None, False, True])
def test_loading_runs_no_code(weights_only, tmp_path):
    path, trace = tmp_path / "hostile.ckpt", tmp_path / "trace"

    class Hostile:
        def __reduce__(self):
            return os.mkdir, (str(trace),)

    torch.save({"state_dict": Hostile()}, path)
    with pytest.raises(Exception, match=r"[Ww]eights"):
        AtomicCheckpointIO().load_checkpoint(path, weights_only=weights_only)
    assert not trace.exists()


def test_files_that_cannot_be_written_are_written_later_in_order(tmp_path, caplog):
    errors = [OSError(errno.ENOSPC, "No space left on device")]

    def prepare():
        for error in errors:
            raise error

    io = AtomicCheckpointIO(prepare=prepare)
    with pytest.raises(Exception, match="pickle"):  # a retry would not help
        AtomicCheckpointIO().save_checkpoint({"step": lambda: 0}, tmp_path / "best.ckpt")
    weights = torch.zeros(2)
    io.save_checkpoint({"step": 1, "weights": weights}, tmp_path / "best.ckpt")
    weights += 1  # training continues
    io.save_checkpoint({"step": 1}, tmp_path / "last.ckpt")
    io.save_checkpoint({"step": 2}, tmp_path / "last.ckpt")
    assert io.waiting == [tmp_path / "best.ckpt", tmp_path / "last.ckpt"]
    assert f"cannot save best.ckpt in {tmp_path}: No space left on device" in caplog.text
    assert list(tmp_path.iterdir()) == []
    with pytest.raises(SavingFailedError, match=r"cannot save best.ckpt in .*: No space left"):
        io.finish()
    errors.clear()
    io.finish()
    assert io.waiting == []
    best = io.load_checkpoint(tmp_path / "best.ckpt")
    assert (best["step"], best["weights"].tolist()) == (1, [0.0, 0.0])
    assert io.load_checkpoint(tmp_path / "last.ckpt") == {"step": 2}


def test_files_outside_the_run_are_not_removed(tmp_path, caplog):
    run, other = tmp_path / "run", tmp_path / "other.ckpt"
    io = AtomicCheckpointIO(folder=run)
    io.save_checkpoint({"step": 1}, run / "checkpoints" / "old.ckpt")
    other.write_bytes(b"mine")
    (run / "link").symlink_to(tmp_path)
    for path in (run / "checkpoints" / ".." / ".." / "other.ckpt", other, run / "link/other.ckpt"):
        io.remove_checkpoint(path)
    assert other.read_bytes() == b"mine"
    assert caplog.text.count("does not belong to this run and is kept") == 3
    io.remove_checkpoint(run / "checkpoints")  # a folder is no checkpoint
    io.remove_checkpoint(run / "checkpoints" / "old.ckpt")
    assert list((run / "checkpoints").iterdir()) == []


def test_a_moved_run_refers_to_its_moved_files(tmp_path):
    old, new = tmp_path / "old" / "checkpoints", tmp_path / "new" / "checkpoints"

    def state(folder, last):
        best = {
            "dirpath": str(folder), "monitor": "val/x", "last_model_path": last,
            "best_model_path": str(folder / "best.ckpt"), "kth_best_model_path": "",
            "best_k_models": {str(folder / "best.ckpt"): torch.tensor(0.5)},
        }  # fmt: skip
        return {"callbacks": {"ModelCheckpoint": best, "other": {"a": 1}}, "epoch": 3}

    AtomicCheckpointIO().save_checkpoint(state(old, "/etc/passwd"), old / "last.ckpt")
    old.parent.rename(new.parent)
    loaded = AtomicCheckpointIO(folder=new.parent).load_checkpoint(new / "last.ckpt")
    assert loaded == state(new, str(new / "passwd"))


def test_the_previous_file_is_kept(tmp_path):
    io, options = AtomicCheckpointIO(), {"previous": tmp_path / "previous.ckpt"}
    for step in range(3):
        io.save_checkpoint({"step": step}, tmp_path / "last.ckpt", storage_options=options)
    for name, step in (("last", 2), ("previous", 1)):
        assert io.load_checkpoint(tmp_path / f"{name}.ckpt") == {"step": step}


def test_partial_files_of_dead_processes_are_removed(tmp_path):
    with subprocess.Popen(["true"]) as process:
        process.wait()
    (tmp_path / "checkpoints").mkdir()
    mine = partial_path(tmp_path / "checkpoints" / "last.ckpt")
    gone = mine.with_name(mine.name.replace(str(os.getpid()), str(process.pid)))
    mine.touch()
    gone.touch()
    sweep(tmp_path)
    assert list((tmp_path / "checkpoints").iterdir()) == [mine]
