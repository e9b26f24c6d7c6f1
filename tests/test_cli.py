from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from dopepp.cli import app
from dopepp.models.checkpoint import Checkpoint, write_atomic
from dopepp.models.spec import build_network
from dopepp.parts.builtin import pivconnector

SPEC = {
    "backbone": {"_target_": "dopepp.models.backbones.DSC", "width": 0.0625},
    "attention": {"_target_": "dopepp.models.attention.Identity"},
    "head": {"_target_": "dopepp.models.heads.MultiScale", "width": 0.0625},
    "activation": "exp",
    "num_objects": 1,
}
K = ["--K", "100", "100", "31.5", "31.5"]


@pytest.fixture
def checkpoint(tmp_path: Path) -> Path:
    network = build_network(SPEC)
    path = tmp_path / "best.ckpt"
    content = Checkpoint(
        SPEC, network.state_dict(), [pivconnector()], (64, 64), 8, 1.0, {"peak_threshold": 1e-4}
    )
    write_atomic(content.to_file(), path)
    return path


@pytest.fixture
def picture(tmp_path: Path) -> Path:
    path = tmp_path / "picture.png"
    cv2.imwrite(str(path), np.random.default_rng(0).integers(0, 256, (64, 64, 3), np.uint8))
    return path


def test_predict_prints_json_lines_and_draws(
    checkpoint: Path, picture: Path, tmp_path: Path
) -> None:
    drawn = tmp_path / "drawn.png"
    arguments = ["predict", str(checkpoint), str(picture), *K, "--overlay", str(drawn)]
    done = CliRunner().invoke(app, arguments)
    assert done.exit_code == 0, done.output
    for line in done.stdout.splitlines():
        record = json.loads(line)
        assert record["object"] == "pivconnector"
        assert np.shape(record["T_cam_obj"]) == (4, 4)
    assert cv2.imread(str(drawn)).shape[2] == 3


def test_a_wrong_file_is_one_line_and_code_2(picture: Path) -> None:
    done = CliRunner().invoke(app, ["predict", str(picture), str(picture), *K])
    assert done.exit_code == 2
    assert done.stderr.count("\n") == 1
    assert done.stderr.startswith("got ")


def test_compare_tells_an_unfinished_run(tmp_path: Path) -> None:
    (tmp_path / "run").mkdir()
    out = tmp_path / "out"
    done = CliRunner().invoke(app, ["compare", str(tmp_path / "run"), "--out", str(out)])
    assert done.exit_code == 0, done.output
    assert "unfinished" in (out / "compare.md").read_text()
