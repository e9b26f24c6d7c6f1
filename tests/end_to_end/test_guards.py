"""Runs that go on changed, break, or are measured on images that have changed."""

import json
from typing import Any

import numpy as np
import pytest
import torch
import yaml

from dopepp.models.losses import SpatialCrossEntropy
from dopepp.virtual.factory import Factory


def test_a_run_that_goes_on_tells_what_changed(run, call):
    before = (run / ".hydra" / "overrides.yaml").read_text()
    refused = call("train.py", f"resume={run}", "seed=5", "trainer.max_epochs=2")
    assert "(seed: 0 → 5)" in refused.line
    refused = call("train.py", f"resume={run}", "optimizer=sgd", "resume_anyway=true")
    assert "another optimiser" in refused.line
    # What was refused has left nothing, so the run can go on as it was.
    assert (run / ".hydra" / "overrides.yaml").read_text() == before

    # A folder from anybody: Hydra builds what its own nodes name, on the user's word alone.
    trace = run / "trace"
    hostile = f"++hydra.callbacks.x={{_target_: os.mkdir, path: '{trace}'}}"
    stored = yaml.safe_dump([*yaml.safe_load(before), hostile])
    (run / ".hydra" / "overrides.yaml").write_text(stored)
    done = call("train.py", f"resume={run}", "trainer.max_epochs=2", "optimizer.weight_decay=0.5",
                "data.batch_size=2", "resume_anyway=true", code=0)  # fmt: skip
    assert not trace.exists()
    said = [line for line in done.out.splitlines() if line.startswith("changed since")]
    changes = ["data.batch_size: 4 → 2", "optimizer.weight_decay: 0.01 → 0.5",
               "trainer.max_epochs: 1 → 2"]  # fmt: skip
    assert [line.partition(": ")[2] for line in said] == changes
    versions = json.loads((run / "versions.json").read_text())
    assert versions["changes"] == changes
    (earlier,) = versions["earlier"]
    assert earlier["changes"] == []
    content = torch.load(run / "checkpoints" / "last.ckpt", weights_only=True)
    (group,) = content["optimizer_states"][0]["param_groups"]
    assert group["weight_decay"] == 0.5  # and not the one that the checkpoint brought back
    overrides = yaml.safe_load((run / ".hydra" / "overrides.yaml").read_text())
    assert "trainer.max_epochs=2" in overrides
    assert hostile not in overrides


def test_losses_that_are_not_finite_end_the_run_and_keep_what_it_had(run, call, monkeypatch):
    good = (run / "checkpoints" / "best.ckpt").read_bytes()
    compare = SpatialCrossEntropy.forward

    def broken(self: Any, *args: Any) -> Any:
        loss, terms = compare(self, *args)
        return loss * (torch.nan if self.training else 1), terms

    monkeypatch.setattr(SpatialCrossEntropy, "forward", broken)
    again = ("trainer.max_epochs=2", "callbacks.finite.max_in_a_row=2")
    done = call("train.py", f"resume={run}", *again, code=1)
    line = done.last_line
    assert "not finite in step 3 (2 steps in a row)" in line
    assert str(run / "nonfinite") in line
    assert line.endswith(f"resume={run}")
    assert "Traceback" not in done.err
    for name in ("best.ckpt", "last.ckpt"):
        content = torch.load(run / "checkpoints" / name, weights_only=True)
        assert all(value.isfinite().all() for value in content["state_dict"].values())
    assert (run / "checkpoints" / "best.ckpt").read_bytes() == good
    dumped = torch.load(run / "nonfinite" / "step_3_rank_0.pt", weights_only=True)
    assert dumped["images"].shape == (4, 3, 64, 64)

    monkeypatch.undo()
    call("train.py", f"resume={run}", *again, code=0)


@pytest.mark.slow
def test_a_run_with_changed_images_is_not_resumed(run, call, monkeypatch):
    render = Factory.render

    def darker(self: Factory, *place: Any) -> Any:
        rendered = render(self, *place)
        np.floor_divide(rendered.image, 2, out=rendered.image)
        return rendered

    monkeypatch.setattr(Factory, "render", darker)
    refused = call("train.py", f"resume={run}", "trainer.max_epochs=2")
    assert "train images: as trained on → changed (pixels of the first image)" in refused.line
