"""The diagnosis of empty maps, on synthetic validations."""

import logging
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from dopepp.training.guards import EmptyMaps
from dopepp.training.system import ValidationOutput

STEPS, RATE, LABELS = "too few training steps", "a learning rate", "labels or units"


class Validations:
    """Calls a callback with validations of one batch."""

    def __init__(self, system, batch):
        self.system, self.batch, self.callback = system, batch, EmptyMaps(patience=2)
        self.trainer = SimpleNamespace(
            world_size=1, is_global_zero=True, global_step=0, estimated_stepping_batches=1000,
            callback_metrics={}, optimizers=[SimpleNamespace(param_groups=[{"lr": 0.5}])],
        )  # fmt: skip

    def __call__(self, highest, loss, channel=0):
        belief = torch.zeros(2, 9, 16, 16)
        belief[:, channel, 3, 4] = highest
        output = ValidationOutput(torch.tensor(loss), belief, torch.zeros(2, 16, 16, 16))
        self.trainer.global_step += 10
        self.trainer.callback_metrics["val/loss"] = torch.tensor(loss)
        self.callback.on_validation_epoch_start(self.trainer, self.system)
        self.callback.on_validation_batch_end(self.trainer, self.system, output, self.batch, 0)
        self.callback.on_validation_end(self.trainer, self.system)

    def end(self):
        self.callback.on_train_end(self.trainer, self.system)


@pytest.fixture
def validations(make_system, batch):
    """Two images of 128×128 pixels, an object of 60 pixels in the middle of each."""
    rng = np.random.default_rng(0)
    keypoints = torch.tensor(rng.uniform(34, 94, (2, 1, 9, 2)), dtype=torch.float32)
    batch = replace(batch, keypoints=keypoints, visible_fraction=torch.ones(2, 1))
    return Validations(make_system(), batch)


def first_cause(caplog):
    (warning,) = caplog.messages
    caplog.clear()
    title, first, *_ = lines = warning.splitlines()
    assert title.startswith("all belief maps are empty")
    assert len(lines) == 4
    assert [warning.count(cause) for cause in (STEPS, RATE, LABELS)] == [1, 1, 1]
    assert "(likely here)" in first
    return first


@pytest.fixture(autouse=True)
def warnings(caplog):
    caplog.set_level(logging.WARNING, "dopepp.training.guards")


def test_a_falling_loss_needs_more_steps(validations, caplog):
    validations(0.001, 2.0)
    assert not caplog.messages
    validations(0.001, 1.0)
    cause = first_cause(caplog)
    assert STEPS in cause
    assert "step 20 of 1,000" in cause
    validations(0.001, 0.9)
    validations.end()
    assert not caplog.messages  # it warns once


@pytest.mark.parametrize(
    ("scale", "shift", "index", "loss", "cause", "text"),
    [
        (1.0, 0.0, 0, 2.0, RATE, "from 2 to 2, the rate is 0.5"),
        (1.0, 1e4, 0, 1.0, LABELS, "0 % of the keypoints are inside"),
        (1e-3, 50.0, 0, 1.0, LABELS, "0.0 cells of the maps wide"),
        (1.0, float("nan"), 0, 1.0, LABELS, "0 % of the keypoints are inside"),
        (1.0, 0.0, -1, 1.0, LABELS, "no object in the validation images"),
    ],
)
def test_a_flat_loss_or_labels_off_the_image_are_the_cause(
    scale, shift, index, loss, cause, text, validations, caplog
):
    validations.batch = replace(
        validations.batch,
        keypoints=scale * validations.batch.keypoints + shift,
        object_index=torch.full((2, 1), index),
    )
    validations(0.001, 2.0)
    validations(0.001, loss)
    first = first_cause(caplog)
    assert cause in first
    assert text in first


def test_a_short_training_warns_at_its_end_and_a_resumed_training_continues_the_count(
    validations, caplog
):
    validations(0.001, 2.0)
    state = validations.callback.state_dict()
    validations.end()
    assert STEPS in first_cause(caplog)
    validations.callback = EmptyMaps(patience=2)
    validations.callback.load_state_dict(state)
    validations.end()  # without a validation
    assert not caplog.messages
    validations(0.001, 1.0)
    assert "from 2 to 1" in caplog.messages[0]


def test_a_pose_needs_both_corners_and_centroids(validations, caplog):
    for channel in (0, 8):
        validations.callback = EmptyMaps(patience=1)
        validations(0.9, 2.0, channel)
        assert caplog.messages
        caplog.clear()
    validations.callback = EmptyMaps(patience=1)
    validations(0.9, 2.0, slice(None))
    validations.end()
    assert not caplog.messages
