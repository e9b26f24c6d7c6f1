from __future__ import annotations

import random

import numpy as np
import torch

from dopepp.training.checkpointing.files import AtomicCheckpointIO
from dopepp.training.checkpointing.resume_point import capture, restore


def test_random_states_come_back_through_a_file(tmp_path):
    def draw() -> list[float]:
        return [random.gauss(0, 1), np.random.randn(), float(torch.randn(()))]  # noqa: NPY002

    draw()
    AtomicCheckpointIO().save_checkpoint({"random": capture()}, tmp_path / "a.ckpt")
    expected = [draw() for _ in range(3)]
    restore(torch.load(tmp_path / "a.ckpt", weights_only=True)["random"])
    assert [draw() for _ in range(3)] == expected
