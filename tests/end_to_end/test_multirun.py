import json
from pathlib import Path

import pytest

from dopepp.experiment.reports.tables import read_csv


def only_sweep(output_dir: Path) -> Path:
    (sweep,) = (output_dir / "compare").iterdir()
    return sweep


@pytest.mark.slow
def test_a_failing_job_is_a_row_and_the_others_run(call, tiny, tmp_path):
    jobs = ("optimizer.lr=-1,1e-3", "seed=1,2")
    done = call("train.py", "-m", *tiny, *jobs, f"output_dir={tmp_path}")
    assert done.code == 1
    sweep = only_sweep(tmp_path)
    rows = read_csv(sweep / "compare.csv")
    assert [row["method"] for row in rows[:3]] == [
        "dopepp optimizer.lr=-1 seed=1", "dopepp optimizer.lr=-1 seed=2",
        "dopepp optimizer.lr=0.001",
    ]  # fmt: skip
    assert rows[0]["object"].startswith("failed: got torch.optim.AdamW")
    assert "| [0](0/) | failed: got torch.optim.AdamW" in (sweep / "README.md").read_text()
    assert "learning rate" in rows[0]["object"]
    # The other two differ in their seed only, and were measured on the same images.
    assert (rows[2]["instances"], rows[2]["seeds"]) == ("3", "1, 2")
    measured = [json.loads((sweep / job / "metrics.json").read_text()) for job in "23"]
    assert measured[0]["test_set"] == measured[1]["test_set"] != ""
    assert len(measured[0]["rotation_deg"]["pivconnector"]) == 3
    assert measured[0]["diameters"]["pivconnector"] > 0.05
    prints = [
        json.loads((sweep / job / "versions.json").read_text())["data_fingerprint"] for job in "23"
    ]
    assert prints[0] != prints[1]  # trained on other images
    assert "failed: got torch.optim.AdamW" in (sweep / "compare.md").read_text()
    assert not (sweep / "0" / "metrics.json").exists()


def test_a_program_error_is_a_row_and_several_devices_are_refused(call, tiny, tmp_path):
    """What no check foresaw: here, a training that Lightning cannot begin."""
    jobs = ("trainer.gradient_clip_val=wrong", "trainer.devices=1,2")
    assert call("train.py", "-m", *tiny, *jobs, f"output_dir={tmp_path}").code == 1
    program_error, refused = (
        row["object"] for row in read_csv(only_sweep(tmp_path) / "compare.csv")
    )
    assert program_error.startswith("failed: ")
    assert "\n" not in program_error
    assert "trainer.devices=2 in a multirun" in refused
    assert "one process per job" in refused


def test_a_choice_that_does_not_exist_stops_the_sweep_before_it_begins(call, tiny, tmp_path):
    done = call("train.py", "-m", *tiny, "model=dopepp,dop", f"output_dir={tmp_path}")
    assert "model=dop; allowed: dope dopepp" in done.line
    assert not list(tmp_path.glob("**/metrics.json"))
