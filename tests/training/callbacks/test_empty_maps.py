"""The diagnosis, on validations whose maps, labels and losses are made up."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from dopepp.core.errors import UserError
from dopepp.data.batch import Batch
from dopepp.training.callbacks.empty_maps import EmptyMaps
from dopepp.training.system import PoseSystem, ValidationOutput

SystemMaker = Callable[..., PoseSystem]
CAUSES = ("too little training", "a learning rate", "labels or units")


class Validations:
    """Feeds a callback with validations of one batch."""

    def __init__(self, system: PoseSystem, batch: Batch, patience: int = 2) -> None:
        self.system, self.batch, self.callback = system, batch, EmptyMaps(patience)
        self.trainer: Any = SimpleNamespace(
            world_size=1, is_global_zero=True, global_step=0, estimated_stepping_batches=1000,
            callback_metrics={}, optimizers=[SimpleNamespace(param_groups=[{"lr": 0.5}])],
        )  # fmt: skip

    def __call__(self, highest: float, loss: float, channel: int = 0) -> None:
        belief = torch.zeros(2, 9, 16, 16)
        belief[:, channel, 3, 4] = highest
        output = ValidationOutput(torch.tensor(loss), belief, torch.zeros(2, 16, 16, 16))
        self.trainer.global_step += 10
        self.trainer.callback_metrics["val/loss"] = torch.tensor(loss)
        self.callback.on_validation_epoch_start(self.trainer, self.system)
        self.callback.on_validation_batch_end(self.trainer, self.system, output, self.batch, 0)
        self.callback.on_validation_end(self.trainer, self.system)


@pytest.fixture
def validations(make_system: SystemMaker) -> Validations:
    """Two images of 128×128 pixels, an object of 60 pixels in the middle of each."""
    rng = np.random.default_rng(0)
    keypoints = torch.tensor(rng.uniform(34, 94, (2, 1, 9, 2)), dtype=torch.float32)
    batch = Batch(
        images=torch.zeros(2, 3, 128, 128, dtype=torch.uint8),
        K=torch.eye(3).expand(2, 3, 3),
        T_cam_obj=torch.eye(4).expand(2, 1, 4, 4),
        keypoints=keypoints,
        object_index=torch.zeros(2, 1, dtype=torch.int64),
        visible_fraction=torch.ones(2, 1),
        masked_fraction=torch.zeros(2, 1),
        keys=["0", "1"],
        sources=["made up"] * 2,
    )
    return Validations(make_system(), batch)


def first_cause(caplog: pytest.LogCaptureFixture) -> str:
    (warning,) = caplog.messages
    caplog.clear()
    lines = warning.splitlines()
    assert lines[0].startswith("all belief maps are empty")
    assert len(lines) == 4
    for cause in CAUSES:
        assert warning.count(cause) == 1
    assert "(likely here)" in lines[1]
    return lines[1]


@pytest.fixture(autouse=True)
def warnings(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.WARNING, "dopepp.training.callbacks.empty_maps")


def test_a_falling_loss_needs_more_steps(
    validations: Validations, caplog: pytest.LogCaptureFixture
) -> None:
    validations(0.001, 2.0)
    assert not caplog.messages
    validations(0.001, 1.0)
    cause = first_cause(caplog)
    assert "too little training" in cause
    assert "step 20 of 1,000" in cause
    validations(0.001, 0.9)
    validations.callback.on_train_end(validations.trainer, validations.system)
    assert not caplog.messages  # once is enough


def test_a_flat_loss_is_the_learning_rates(
    validations: Validations, caplog: pytest.LogCaptureFixture
) -> None:
    validations(0.001, 2.0)
    validations(0.001, 2.0)
    cause = first_cause(caplog)
    assert "from 2 to 2, the rate is 0.5" in cause
    assert "job=lr_finder" in cause


@pytest.mark.parametrize(("scale", "shift"), [(1.0, 1e4), (1e-3, 50.0), (1.0, float("nan"))])
def test_keypoints_off_the_image_or_in_one_cell_are_the_labels(
    scale: float, shift: float, validations: Validations, caplog: pytest.LogCaptureFixture
) -> None:
    keypoints = scale * validations.batch.keypoints + shift
    validations.batch = replace(validations.batch, keypoints=keypoints)
    validations(0.001, 2.0)
    validations(0.001, 1.0)
    assert "labels or units" in first_cause(caplog)


def test_images_without_objects_are_the_labels(
    validations: Validations, caplog: pytest.LogCaptureFixture
) -> None:
    index = torch.full_like(validations.batch.object_index, -1)
    validations.batch = replace(validations.batch, object_index=index)
    validations(0.001, 2.0)
    validations(0.001, 1.0)
    assert "no object in the validation images" in first_cause(caplog)


def test_a_short_training_says_it_at_its_end_and_a_resumed_one_counts_on(
    validations: Validations, caplog: pytest.LogCaptureFixture
) -> None:
    validations(0.001, 2.0)
    state = validations.callback.state_dict()
    validations.callback.on_train_end(validations.trainer, validations.system)
    assert "too little training" in first_cause(caplog)
    validations.callback = EmptyMaps(patience=2)
    validations.callback.load_state_dict(state)
    validations(0.001, 1.0)
    assert "from 2 to 1" in caplog.messages[0]


def test_corners_or_centroids_alone_give_no_pose_both_do(
    validations: Validations, caplog: pytest.LogCaptureFixture
) -> None:
    for channel in (0, 8):
        validations.callback = EmptyMaps(patience=1)
        validations(0.9, 2.0, channel)
        assert caplog.messages
        caplog.clear()
    validations.callback = EmptyMaps(patience=1)
    validations(0.9, 2.0, slice(None))  # type: ignore[arg-type]
    validations.callback.on_train_end(validations.trainer, validations.system)
    assert not caplog.messages


def test_patience_out_of_range() -> None:
    with pytest.raises(UserError, match="patience=0"):
        EmptyMaps(0)
