"""The code of the how-to pages "Adding a …" works as printed."""

import itertools
import json
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
import torch
from lightning.pytorch import LightningModule, Trainer
from scipy.spatial.transform import Rotation

from dopepp.core.errors import UserError
from dopepp.core.files import write_png
from dopepp.experiment import entries
from dopepp.experiment.assembly.build_system import CALLBACKS
from dopepp.geometry.camera import camera_matrix, make_transform
from dopepp.metrics.functional import distances
from dopepp.models import backbones
from dopepp.models.registry import Registry
from dopepp.parts import servoholder
from dopepp.virtual import PRESETS, Factory
from dopepp.virtual.renderers import RENDERERS

DOCS = Path(__file__).parents[1] / "docs" / "how-to"


def documented(page, number=1):
    """Return a block of Python code of a page."""
    return (DOCS / page).read_text(encoding="utf-8").split("```python\n")[number].split("```")[0]


def module_of(page, name, monkeypatch):
    """Run a page's module under the module name of the page."""
    module = ModuleType(name)
    exec(documented(page), vars(module))
    monkeypatch.setitem(sys.modules, name, module)
    return module


def test_the_documented_format_works(monkeypatch, tmp_path):
    module = module_of("adding-a-data-format.md", "dopepp.data.formats.posed.reader", monkeypatch)
    part, K = servoholder(), camera_matrix(100, 100, 31.5, 23.5)
    T_cam_obj = make_transform(Rotation.random(random_state=0).as_matrix(), np.array([0, 0, 0.4]))
    record = {"K": K.ravel().tolist(), "object": part.name, "T_cam_obj": T_cam_obj.ravel().tolist()}
    (tmp_path / "a.json").write_text(json.dumps(record))
    write_png(tmp_path / "a.png", np.full((48, 64, 3), 7, np.uint8))
    source = module.PosedReader(tmp_path, [part])
    assert (len(source), source.contains(part.name), source.contains("other")) == (1, True, False)
    sample = source.sample(0)
    np.testing.assert_array_equal(sample.instances[0].T_cam_obj, T_cam_obj)
    assert (sample.image == 7).all()
    (tmp_path / "a.json").write_text(json.dumps(record | {"T_cam_obj": [2.0] * 16}))
    with pytest.raises(UserError, match=r"a\.json: T_cam_obj: not a rotation"):
        module.PosedReader(tmp_path, [part])


def test_the_documented_backbone_works(monkeypatch):
    # On the page, the class is part of backbones.py and has one additional import.
    monkeypatch.setattr(backbones, "pairwise", itertools.pairwise, raising=False)
    monkeypatch.setattr(backbones, "Strided", None, raising=False)
    exec(documented("adding-a-backbone.md"), vars(backbones))
    registry = Registry.of_module("backbone", backbones.Backbone, backbones)
    backbone = registry.build({"_target_": "dopepp.models.backbones.Strided", "width": 0.5})
    assert backbone(torch.zeros(1, 3, 64, 32)).shape == (1, backbone.out_channels, 8, 4)


def test_the_documented_renderer_works(monkeypatch):
    name = "dopepp.virtual.renderers.grey_depth"
    module_of("adding-a-renderer.md", name, monkeypatch)
    monkeypatch.setitem(RENDERERS, "grey_depth", name)
    preset = PRESETS["paper"].resized(96, 64)
    usual, grey = (
        Factory([servoholder()], preset, 0, renderer=renderer).render(0, 0)
        for renderer in ("raster", "grey_depth")
    )
    np.testing.assert_array_equal(grey.depth, usual.depth)
    # The sensor adds noise to both images.
    assert grey.image[usual.depth > 0].max() > 200
    assert grey.image[usual.depth == 0].max() < 30


def test_the_documented_error_is_the_angle_between_axes(monkeypatch):
    monkeypatch.setattr(distances, "axis_error", None, raising=False)
    exec(documented("adding-a-metric.md"), vars(distances))
    turns = Rotation.random(50, random_state=0).as_matrix()
    about_z = Rotation.from_rotvec(np.outer(np.linspace(-3, 3, 50), [0, 0, 1])).as_matrix()
    about_x = Rotation.from_rotvec([np.radians(20), 0, 0]).as_matrix()
    true, same, tilted = (torch.from_numpy(R) for R in (turns, turns @ about_z, turns @ about_x))
    error = distances.axis_error
    torch.testing.assert_close(error(same, true), torch.zeros(50).double(), atol=1e-6, rtol=0)
    torch.testing.assert_close(error(tilted, true), torch.full((50,), 20.0).double())
    assert error(true * torch.nan, true).isinf().all()


class OneWeight(LightningModule):
    """A module with a single weight w and the loss 3·w, whose gradient has length 3."""

    def __init__(self):
        super().__init__()
        self.w = torch.nn.Parameter(torch.ones(1))

    def training_step(self, batch):
        return 3 * self.w.sum()

    def configure_optimizers(self):
        return torch.optim.SGD(self.parameters(), 0.1)


def test_the_documented_callback_works(monkeypatch):
    name = "dopepp.training.gradient_norm"
    module_of("adding-a-callback.md", name, monkeypatch)
    monkeypatch.setattr(CALLBACKS, "_targets", {*CALLBACKS.targets})
    CALLBACKS.register(f"{name}.GradientNorm")
    callback = CALLBACKS.build({"_target_": f"{name}.GradientNorm", "every": 1})
    trainer = Trainer(
        max_steps=2, callbacks=[callback], logger=False, barebones=False,
        enable_checkpointing=False, enable_progress_bar=False, enable_model_summary=False,
    )  # fmt: skip
    trainer.fit(OneWeight(), torch.utils.data.DataLoader(torch.zeros(2)))
    assert trainer.callback_metrics["train/gradient_norm"] == pytest.approx(3.0)


def test_the_documented_script_allows_a_callback_and_trains(monkeypatch):
    package, started = ModuleType("my_package"), []
    package.callbacks = module_of("adding-a-callback.md", "my_package.callbacks", monkeypatch)
    monkeypatch.setitem(sys.modules, "my_package", package)
    monkeypatch.setattr(entries, "start", started.append)
    monkeypatch.setattr(CALLBACKS, "_targets", {*CALLBACKS.targets})
    exec(documented("adding-a-callback.md", 2), {"__name__": "worker"})
    assert "my_package.callbacks.GradientNorm" in CALLBACKS.targets
    assert not started  # a process of hydra/launcher=joblib imports the script
    exec(documented("adding-a-callback.md", 2), {"__name__": "__main__"})
    assert started == ["train"]
