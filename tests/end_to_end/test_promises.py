"""What the README promises of whole runs; minutes each, so only ``pytest -m slow`` runs them."""

import json

import pytest

pytestmark = [pytest.mark.slow, pytest.mark.render, pytest.mark.timeout(1800)]


@pytest.fixture
def train(command, tmp_path):
    def run(*overrides: str):
        command("train.py", *overrides, f"output_dir={tmp_path}", timeout=1700, code=0)
        (metrics,) = tmp_path.glob("*/*/metrics.json")
        return json.loads(metrics.read_text())

    return run


def test_the_quickstart_learns(train):
    record = train("model=dopepp", "data=hybrid", "experiment=quickstart")
    row = record["objects"]["pivconnector"]
    assert row["num_instances"] == 300
    assert row["add_01d"] >= 0.40
    assert row["median_rotation_deg"] < 12.0
    assert record["checkpoint"] == "checkpoints/best_tuned.ckpt"
    references = record["references"]
    assert row["add_01d"] > references["best constant pose"]["pivconnector"]["add_01d"]


def test_one_real_frame_is_learned_by_heart(train, ycb_root):
    record = train("debug=overfit", f"data.root={ycb_root}")
    assert record["objects"]["003_cracker_box"]["add_01d"] == 1.0
