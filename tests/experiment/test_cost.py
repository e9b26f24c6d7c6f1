"""``job=cost``: counts and times of an untrained network."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from dopepp.drawing.pictures import read_rgb
from dopepp.errors import UserError
from dopepp.experiment.cost import measure_cost, read_frames
from dopepp.experiment.jobs import do_job

Composer = Callable[..., dict[str, Any]]

SMALL = ("scale=laptop", "data.input_size=[32,32]", "cost.num_frames=4", "cost.batch_size=2")


def test_counts_are_the_papers_and_times_are_written(composed: Composer, tmp_path: Path) -> None:
    config = composed("experiment=table4_parameters", *SMALL, "model.width=1", "job=cost")
    cost = measure_cost(config, tmp_path)
    assert cost.backbone_weights == 1_107_776
    assert cost.input_size == (32, 32)
    seconds = read_frames(tmp_path / "frames.csv")
    assert len(seconds) == 4
    assert (seconds > 0).all()
    assert cost.ms_per_frame == pytest.approx(1000 * float(np.median(seconds)), rel=1e-2)
    record = json.loads((tmp_path / "cost.json").read_text())
    assert record["parameters"] == cost.parameters
    assert record["frames_per_s"] > 0
    assert read_rgb(tmp_path / "frame_rate.png").std() > 0


def test_the_original_backbone(composed: Composer, tmp_path: Path) -> None:
    config = composed(*SMALL, "model/backbone=vgg19_original", "model.width=1", "job=cost")
    assert measure_cost(config, tmp_path).backbone_weights == 9_696_960


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("job=mow", "job='mow'; allowed: train, cost"),
        ("cost.num_frames=0", "cost.num_frames=0"),
        ("cost.batch_size=0.5", "cost.batch_size=0.5"),
    ],
)
def test_impossible_jobs(composed: Composer, tmp_path: Path, override: str, message: str) -> None:
    with pytest.raises(UserError, match=message):
        do_job(composed(*SMALL, "job=cost", override), tmp_path)
    assert not any(tmp_path.iterdir())


def test_the_time_does_not_depend_on_torchs_mode(composed: Composer, tmp_path: Path) -> None:
    measure_cost(composed(*SMALL, "job=cost"), tmp_path)
    assert torch.is_grad_enabled()
