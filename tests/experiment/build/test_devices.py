from __future__ import annotations

from typing import Any

import pytest
import torch

from dopepp.core.errors import RunError, UserError
from dopepp.experiment.config.run import TrainerConfig


@pytest.fixture(autouse=True)
def alone(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("WORLD_SIZE", raising=False)


@pytest.mark.parametrize(
    ("options", "count"),
    [
        ({}, 1),
        ({"devices": 1}, 1),
        ({"devices": "1"}, 1),
        ({"devices": [3]}, 1),
        ({"devices": "3,"}, 1),
        ({"devices": 1, "strategy": "ddp"}, 1),  # one process, whatever it is called
        ({"devices": 2}, 2),
        ({"devices": "2"}, 2),
        ({"devices": [0, 1]}, 2),
        ({"devices": "0,1"}, 2),
        ({"devices": "auto", "accelerator": "cpu"}, 1),
        ({"devices": "auto", "accelerator": "auto"}, 4),
        ({"devices": -1, "accelerator": "gpu"}, 4),
        ({"devices": "-1", "accelerator": "gpu"}, 4),
        ({"devices": 1, "num_nodes": 2}, 2),
        ({"devices": 2, "num_nodes": 3}, 6),
    ],
)
def test_how_many_processes_there_will_be(
    options: dict[str, Any], count: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 4)
    assert TrainerConfig(max_epochs=1, **options).num_processes == count


def test_processes_that_torchrun_has_started_count_too(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("WORLD_SIZE", "2")
    assert TrainerConfig(max_epochs=1, devices=1).num_processes == 2


@pytest.mark.parametrize(
    "options",
    [{"devices": 0}, {"devices": []}, {"devices": "all"}, {"devices": 1.5}, {"devices": True},
     {"devices": None}, {"devices": -2}, {"devices": 1, "num_nodes": 0}],
)  # fmt: skip
def test_a_number_that_means_nothing_is_refused(options: dict[str, Any]) -> None:
    with pytest.raises(UserError, match=r"trainer\.(devices|num_nodes)="):
        _ = TrainerConfig(max_epochs=1, **options).num_processes


def test_a_runs_failure_is_one_line() -> None:
    assert str(RunError("a reason\n  of two lines")) == "a reason of two lines"
