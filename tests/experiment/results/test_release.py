"""A released checkpoint and its card."""

import pytest
import torch

from dopepp.core.errors import UserError
from dopepp.experiment.results import release as module
from dopepp.experiment.results.evaluators import Cost
from dopepp.experiment.results.folder import read_json, write_json
from dopepp.experiment.results.release import release
from dopepp.experiment.results.report import Report
from dopepp.metrics.row import PoseRow
from dopepp.models.checkpoint import Checkpoint, read, write_atomic
from dopepp.models.network import build_network
from dopepp.parts import load_part


@pytest.fixture
def run(tiny_spec, tmp_path):
    """A run's folder: checkpoint and result."""
    config = {"virtual": {"preset": "wide"}, "masking": {"probability": 0.3}, "cache_dir": "/x/y"}
    checkpoint = Checkpoint(
        tiny_spec, build_network(tiny_spec).state_dict(), [load_part("pivconnector")],
        (64, 64), 8, 1.0, data={"name": "dopepp", "config": config},
    )  # fmt: skip
    write_atomic(checkpoint.to_file(), tmp_path / "best.ckpt")
    rows = {name: PoseRow(name, "dopepp", 300, 0.843) for name in ("pivconnector", "mean")}
    chance = {name: PoseRow(name, "chance", 300, 0.125) for name in rows}
    report = Report("dopepp", rows, {"chance": chance}, {}, Cost(), 300)
    write_json(tmp_path / "metrics.json", report.to_record())
    return tmp_path


def test_the_card_says_what_it_can_do(run):
    weights, card = release(run / "best.ckpt", run / "metrics.json", "bracket", run / "out")
    assert (weights.name, card.name) == ("bracket.safetensors", "bracket.md")
    assert read(weights).data["config"]["cache_dir"] is None
    text = card.read_text()
    assert "ckpt_path=pretrained/bracket" in text
    assert "- pivconnector: 108 mm across" in text
    assert "preset `wide`" in text
    assert "random masks on 30 %" in text
    assert "| pivconnector | dopepp | 300 | 84.3 |" in text
    assert "| pivconnector | chance | 300 | 12.5 |" in text
    assert "| mean |" not in text


def test_the_card_has_the_network_beside_its_refined_poses(run):
    plain = read_json(run / "metrics.json")
    rows = {
        name: {**row, "method": "dopepp + region", "add_01d": 0.97}
        for name, row in plain["objects"].items()
    }
    write_json(run / "metrics.json", {**plain, "refined": {**plain, "objects": rows}})
    _, card = release(run / "best.ckpt", run / "metrics.json", "bracket", run / "out")
    text = card.read_text()
    assert text.index("| dopepp | 300 | 84.3 |") < text.index("| dopepp + region | 300 | 97.0 |")
    assert "ckpt_path=pretrained/bracket refine=region" in text


def test_what_cannot_be_released(run, monkeypatch):
    out = run / "out"
    with pytest.raises(UserError, match=r"name '\.\./x'; allowed: letters"):
        release(run / "best.ckpt", run / "metrics.json", "../x", out)
    with pytest.raises(UserError, match=r"other\.json"):
        release(run / "best.ckpt", run / "other.json", "x", out)
    torch.save({"a": 1}, run / "other.ckpt")
    with pytest.raises(UserError, match=r"other\.ckpt"):
        release(run / "other.ckpt", run / "metrics.json", "x", out)
    monkeypatch.setattr(module, "MAX_BYTES", 100)
    with pytest.raises(UserError, match=r"of weights in half precision; allowed: at most 100"):
        release(run / "best.ckpt", run / "metrics.json", "x", out)
    assert not out.exists()
