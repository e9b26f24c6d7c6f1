"""What the README promises of whole runs; minutes each, so only ``pytest -m slow`` runs them."""

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).parents[2]

pytestmark = [pytest.mark.slow, pytest.mark.render, pytest.mark.timeout(1800)]


def train(tmp_path: Path, *overrides: str) -> dict[str, Any]:
    command = [sys.executable, "train.py", *overrides, f"output_dir={tmp_path}"]
    subprocess.run(command, cwd=ROOT, check=True)
    (metrics,) = tmp_path.glob("*/*/metrics.json")
    record: dict[str, Any] = json.loads(metrics.read_text())
    return record


def test_the_quickstart_learns(tmp_path):
    record = train(tmp_path, "model=dopepp", "data=hybrid", "experiment=quickstart")
    row = record["objects"]["pivconnector"]
    assert row["num_instances"] == 300
    assert row["add_01d"] >= 0.40
    assert row["median_rotation_deg"] < 12.0
    assert record["checkpoint"] == "checkpoints/best_tuned.ckpt"
    references = record["references"]
    assert row["add_01d"] > references["best constant pose"]["pivconnector"]["add_01d"]


def test_one_real_frame_is_learned_by_heart(tmp_path, ycb_root):
    record = train(tmp_path, "debug=overfit", f"data.root={ycb_root}")
    assert record["objects"]["003_cracker_box"]["add_01d"] == 1.0
