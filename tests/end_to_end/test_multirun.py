"""Multiruns: their table, and what Weights & Biases and TensorBoard hold of runs."""

import json
import os
import shutil
import struct
import subprocess
import threading
import time
from collections.abc import Iterable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import pytest
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from wandb.proto import wandb_internal_pb2

from dopepp.core.files import read_csv

BLOCK = 32768
"""Bytes of a block of LevelDB's log format, which the files have behind seven bytes of their own;
a record's header is checksum, length and type (1: whole, 2–4: first, middle and last piece)."""
HEADER = struct.Struct("<IHB")


def records(path: Path) -> Iterator[Any]:
    """Read a ``.wandb`` file back."""
    content, place, pieces = path.read_bytes(), 7, b""
    assert content.startswith(b":W&B")
    while place + HEADER.size <= len(content):
        left = BLOCK - place % BLOCK
        if left < HEADER.size:
            place += left
            continue
        _, length, kind = HEADER.unpack_from(content, place)
        pieces += content[place + HEADER.size : place + HEADER.size + length]
        place += HEADER.size + length
        if kind in (1, 4):
            record = wandb_internal_pb2.Record()
            record.ParseFromString(pieces)
            pieces = b""
            yield record


def values(items: Iterable[Any]) -> dict[str, Any]:
    return {item.key or "/".join(item.nested_key): json.loads(item.value_json) for item in items}


def read(path: Path) -> Any:
    """Return what one file says of its run."""
    result = SimpleNamespace(config={}, summary={}, history=[])
    for record in records(path):
        kind = record.WhichOneof("record_type")
        if kind == "run":
            result.name, result.group = record.run.display_name, record.run.run_group
            result.job_type = record.run.job_type
            result.config |= values(record.run.config.update)
        elif kind in ("config", "summary"):
            getattr(result, kind).update(values(getattr(record, kind).update))
        elif kind == "history":
            result.history.append(values(record.history.item))
        elif kind == "exit":
            result.exit_code = record.exit.exit_code
    return result


def tracked(path: Path, patience: float = 30.0) -> SimpleNamespace:
    """Read a run back once its end is in the file, which the service writes in its own time."""
    end = time.monotonic() + patience
    while not hasattr(found := read(path), "exit_code") and time.monotonic() < end:
        time.sleep(0.2)
    return found


def only(folder: Path) -> Any:
    (path,) = folder.glob("wandb/offline-run-*/*.wandb")
    return tracked(path)


def sweep_of(output_dir: Path) -> Path:
    (sweep,) = (output_dir / "compare").iterdir()
    return sweep


@pytest.fixture(scope="module")
def sweep(call, tiny, tmp_path_factory):
    """The folder of a multirun of both models that both services follow."""
    folder = tmp_path_factory.mktemp("sweep")
    own_heads = [option for option in tiny if not option.startswith("model/head=")]
    tensorboard = "+logger.tensorboard={_target_: lightning.pytorch.loggers.TensorBoardLogger, "
    done = call(
        "train.py", "-m", *own_heads, "model=dopepp,dope", "logger=wandb",
        tensorboard + "name: tensorboard, version: ''}", f"output_dir={folder}", code=0,
    )  # fmt: skip
    assert "already in progress" not in done.err
    assert "comparison" in done.out
    return sweep_of(folder)


def test_they_end_in_one_table_dope_first(sweep):
    rows = read_csv(sweep / "compare.csv")
    assert [row["method"] for row in rows[:2]] == ["dope", "dopepp"]
    assert rows[0]["Δ ADD-0.1d %"] == ""
    assert rows[1]["Δ ADD-0.1d %"] not in ("", "n/a")
    assert rows[1]["Δ ADD-0.1d % verdict"] == "within noise"  # of three instances each
    assert all(float(row["ms/frame"]) > 0 and float(row["GMACs"]) > 0 for row in rows[:2])
    assert "best constant pose" in [row["method"] for row in rows[2:]]

    text = (sweep / "compare.md").read_text()
    assert "model.width=0.0625" in text
    for name in ("compare", "compare_auc", "compare_loss", "compare_pictures"):
        assert cv2.imread(str(sweep / f"{name}.png")) is not None, name
    readme = (sweep / "README.md").read_text()
    assert readme.startswith("# Multirun: finished\n")
    assert "python train.py -m data=virtual" in readme
    assert "| [1](1/) | finished |" in readme
    assert (sweep / "1" / "README.md").read_text().startswith("# dope on virtual: finished")
    # Both saw the same data.
    versions = [json.loads((sweep / job / "versions.json").read_text()) for job in "01"]
    assert versions[0]["data_fingerprint"] == versions[1]["data_fingerprint"]


def test_a_folder_of_another_multirun_is_refused_untouched(sweep, call):
    files = {path: path.read_bytes() for path in sweep.rglob("*.[jcy]*") if path.is_file()}
    line = call("train.py", "-m", "seed=1,2", f"hydra.sweep.dir={sweep}").line
    assert f"got hydra.sweep.dir={sweep}, which holds a multirun that differs in" in line
    assert "model=dopepp,dope" in line
    assert "seed=1,2" in line
    assert {path: path.read_bytes() for path in files} == files


def test_every_job_is_a_run_and_the_comparison_one_more(sweep):
    for job, model in (("0", "dopepp"), ("1", "dope")):
        run = only(sweep / job)
        assert run.name.startswith(f"{model} virtual")
        assert (run.group, run.job_type, run.exit_code) == (sweep.name, "train", 0)
        assert run.config["model"]["name"] == model
        steps = [step["trainer/global_step"] for step in run.history if "train/loss" in step]
        assert steps == sorted(steps)
        assert len(steps) == 2  # of this job's two steps, and no other's
        measured = json.loads((sweep / job / "metrics.json").read_text())
        auc = measured["objects"]["pivconnector"]["auc_10cm"]
        constant = measured["references"]["best constant pose"]["pivconnector"]["add_01d"]
        assert run.summary["test/pivconnector/auc_10cm"] == pytest.approx(auc)
        reference = "reference/best constant pose/pivconnector/add_01d"
        assert run.summary[reference] == pytest.approx(constant)
        for kind, names in (("test", {"overlay", "auc"}), ("val", {"overlay", "auc", "belief"})):
            images = (sweep / job).glob(f"wandb/offline-run-*/files/media/images/{kind}/*")
            assert {path.name.split("_")[0] for path in images} == names
    comparison = only(sweep)
    assert (comparison.name, comparison.job_type) == ("comparison", "comparison")
    assert (comparison.group, comparison.exit_code) == (sweep.name, 0)
    (file,) = sweep.glob("wandb/offline-run-*/files/media/table/compare_*.table.json")
    table = json.loads(file.read_text())
    assert table["columns"][:2] == ["method", "object"]
    assert [row[0] for row in table["data"]][:2] == ["dope", "dopepp"]
    images = sweep.glob("wandb/offline-run-*/files/media/images/*.png")
    assert {image.name.rsplit("_", 2)[0] for image in images} == {
        "compare_auc", "compare_pictures", "compare_loss",
    }  # fmt: skip


def test_a_resumed_run_goes_on_in_the_same_run(sweep, call, tmp_path):
    run = shutil.copytree(sweep / "0", tmp_path / "run")
    call("train.py", f"resume={run}", "trainer.max_epochs=2", "resume_anyway=true", code=0)
    paths = sorted(run.glob("wandb/offline-run-*/*.wandb"))
    assert len(paths) == 2
    assert paths[0].name == paths[1].name  # it is called after the run's id
    before, after = map(tracked, paths)
    assert before.name == after.name
    assert (before.group, after.group) == (sweep.name, "")  # it went on by itself
    first, second = (
        {step["trainer/global_step"] for step in run.history if "train/loss" in step}
        for run in (before, after)
    )
    assert max(first) < min(second)


@pytest.mark.slow
def test_a_service_that_dies_in_the_middle_ends_nothing(call, tiny, tmp_path, caplog):
    killed = []

    def kill_service() -> None:
        until = time.monotonic() + 200
        while not list(tmp_path.glob("compare/*/0/metrics.csv")):  # after the first epoch
            assert time.monotonic() < until
            time.sleep(0.02)
        command = ["pkill", "-9", "-P", str(os.getpid()), "wandb-core"]
        killed.append(subprocess.run(command, check=False).returncode)

    killer = threading.Thread(target=kill_service)
    killer.start()
    arguments = [*tiny, "trainer.max_epochs=2", "logger=wandb", f"output_dir={tmp_path}"]
    done = call("train.py", "-m", *arguments, "model/attention=none,cbam")
    killer.join()
    assert killed == [0]
    assert done.code == 0, done.err[-3000:]
    assert "a logger failed" in caplog.text
    sweep = sweep_of(tmp_path)
    assert all((sweep / job / "metrics.json").is_file() for job in "01")
    assert "comparison" in done.out
    # The next job starts a service of its own.
    assert only(sweep / "1").exit_code == 0


def test_tensorboard_holds_the_same(sweep):
    events = EventAccumulator(str(sweep / "0" / "tensorboard")).Reload()
    tags = events.Tags()
    assert {"train/loss", "test/pivconnector/add_01d"} <= set(tags["scalars"])
    images = {"test/overlay", "test/auc", "val/overlay", "val/auc", "val/belief"}
    assert images <= set(tags["images"])
    comparison = EventAccumulator(str(sweep / "tensorboard")).Reload()
    (text,) = comparison.Tensors("compare/text_summary")
    assert b"| dopepp" in text.tensor_proto.string_val[0]
    assert "compare_auc" in comparison.Tags()["images"]


def test_a_program_error_is_a_row_and_several_devices_are_refused(call, tiny, tmp_path):
    """What no check foresaw: here, a training that Lightning cannot begin."""
    jobs = ("trainer.gradient_clip_val=wrong", "trainer.devices=1,2")
    call("train.py", "-m", *tiny, *jobs, f"output_dir={tmp_path}", code=1)
    program_error, refused = (row["object"] for row in read_csv(sweep_of(tmp_path) / "compare.csv"))
    assert program_error.startswith("failed: ")
    assert "\n" not in program_error
    assert "trainer.devices=2 in a multirun" in refused
    assert "one process per job" in refused


def test_a_choice_that_does_not_exist_stops_the_sweep_before_it_begins(call, tiny, tmp_path):
    done = call("train.py", "-m", *tiny, "model=dopepp,dop", f"output_dir={tmp_path}")
    assert "model=dop; allowed: dope dopepp" in done.line
    assert not list(tmp_path.glob("**/metrics.json"))
