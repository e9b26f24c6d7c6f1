from __future__ import annotations

import csv
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2

Runner = Callable[..., Any]


def table(sweep: Path) -> list[dict[str, str]]:
    with (sweep / "compare.csv").open(newline="") as stream:
        return list(csv.DictReader(stream))


def only_sweep(output_dir: Path) -> Path:
    (sweep,) = (output_dir / "compare").iterdir()
    return sweep


def test_two_models_end_in_one_table_dope_first(
    call: Runner, tiny: tuple[str, ...], tmp_path: Path
) -> None:
    seeds = ("model=dopepp,dope", "seed=1,2")
    done = call("train.py", "-m", *tiny, *seeds, f"output_dir={tmp_path}")
    assert done.code == 0, done.err
    sweep = only_sweep(tmp_path)
    rows = table(sweep)
    assert [row["method"] for row in rows[:2]] == ["dope", "dopepp"]
    assert rows[0]["Δ ADD-0.1d %"] == ""
    assert rows[1]["Δ ADD-0.1d %"] not in ("", "n/a")
    assert rows[1]["Δ ADD-0.1d % verdict"] == "within noise"  # of three instances each
    assert [row["seeds"] for row in rows[:2]] == ["1, 2", "1, 2"]
    assert all(float(row["ms/frame"]) > 0 and float(row["GMACs"]) > 0 for row in rows[:2])
    # The networks were narrowed: what the full ones cost stands beside it.
    assert rows[0]["full-size parameters"] == "50,267,350"
    assert "best constant pose" in [row["method"] for row in rows[2:]]

    text = (sweep / "compare.md").read_text()
    assert text.startswith("| method | object | seeds |")
    assert "model.width=0.0625" in text
    assert "over the seeds of the trainings" in text
    for name in ("compare", "compare_auc", "compare_loss", "compare_pictures"):
        assert cv2.imread(str(sweep / f"{name}.png")) is not None, name
    assert "dopepp" in (sweep / "compare_auc.csv").read_text().splitlines()[0]
    assert "comparison" in done.out
    # Jobs of one seed saw the same data, and all of them were measured on the same images.
    prints = [
        json.loads((sweep / job / "versions.json").read_text())["data_fingerprint"]
        for job in "0123"
    ]
    assert prints[:2] == prints[2:]
    assert prints[0] != prints[1]
    measured = [json.loads((sweep / job / "metrics.json").read_text()) for job in "0123"]
    assert len({one["test_set"] for one in measured}) == 1
    assert len(measured[0]["rotation_deg"]["pivconnector"]) == 3
    assert measured[0]["diameters"]["pivconnector"] > 0.05


def test_a_failing_job_is_a_row_and_the_others_run(
    call: Runner, tiny: tuple[str, ...], tmp_path: Path
) -> None:
    done = call("train.py", "-m", *tiny, "optimizer.lr=-1,1e-3", f"output_dir={tmp_path}")
    assert done.code == 1
    sweep = only_sweep(tmp_path)
    rows = table(sweep)
    assert [row["method"] for row in rows[:2]] == [
        "dopepp optimizer.lr=-1", "dopepp optimizer.lr=0.001",
    ]  # fmt: skip
    assert rows[0]["object"].startswith("failed: got torch.optim.AdamW")
    assert "learning rate" in rows[0]["object"]
    assert rows[1]["instances"] == "3"
    assert "failed: got torch.optim.AdamW" in (sweep / "compare.md").read_text()
    assert not (sweep / "0" / "metrics.json").exists()


def test_a_program_error_is_a_row_too(
    call: Runner, tiny: tuple[str, ...], tmp_path: Path, ycb_root: Path
) -> None:
    """What no check foresaw: here, a training that Lightning cannot begin."""
    broken = "trainer.gradient_clip_val=wrong"
    done = call("train.py", "-m", *tiny, broken, f"output_dir={tmp_path}")
    assert done.code == 1
    (row,) = table(only_sweep(tmp_path))
    assert row["object"].startswith("failed: ")
    assert "\n" not in row["object"]


def test_several_devices_are_refused_with_the_reason(
    call: Runner, tiny: tuple[str, ...], tmp_path: Path
) -> None:
    done = call("train.py", "-m", *tiny, "trainer.devices=2", f"output_dir={tmp_path}")
    assert done.code == 1
    (row,) = table(only_sweep(tmp_path))
    assert "trainer.devices=2 in a multirun" in row["object"]
    assert "each further process would run the whole sweep again" in row["object"]


def test_a_choice_that_does_not_exist_stops_the_sweep_before_it_begins(
    call: Runner, tiny: tuple[str, ...], tmp_path: Path
) -> None:
    done = call("train.py", "-m", *tiny, "model=dopepp,dop", f"output_dir={tmp_path}")
    assert "model=dop; allowed: dope dopepp" in done.line
    assert not list(tmp_path.glob("**/metrics.json"))
