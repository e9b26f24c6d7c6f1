"""Training on a GPU."""

import pytest
import torch

from dopepp.experiment.results.folder import BEST_CHECKPOINT


@pytest.mark.gpu
def test_training_on_a_gpu_writes_checkpoints_and_can_continue(call, tiny_options, tmp_path):
    """The optimiser's state is on two devices: AdamW counts its steps on the CPU."""
    options = (*tiny_options, "trainer=gpu", f"hydra.run.dir={tmp_path}")
    call("train.py", *options, code=0)
    state = torch.load(tmp_path / BEST_CHECKPOINT, map_location="cpu", weights_only=True)
    assert state["optimizer_states"]
    call("train.py", f"resume={tmp_path}", "trainer.max_epochs=2", code=0)
