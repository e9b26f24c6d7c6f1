import subprocess
import sys

import pytest
import torch
from torch import nn

from dopepp.core.errors import UserError
from dopepp.models import backbones
from dopepp.models.network import BACKBONES, LOSSES, PoseNetwork, build_network
from dopepp.models.registry import Registry

OPTIMIZERS = Registry("optimizer", torch.optim.Optimizer, ["torch.optim.AdamW", "torch.optim.SGD"])
DSC = "dopepp.models.backbones.DSC"


def test_builds_a_network_from_plain_values(make_spec):
    options = {"num_objects": 3, "backbone_width": 0.25, "head_width": 0.125}
    spec = make_spec("DSC", "SE", "Cascade", "identity", **options)
    before = repr(spec)
    network = build_network(spec)
    assert repr(spec) == before
    assert isinstance(network, PoseNetwork)
    assert (network.num_objects, network.stride, network.activation) == (3, 8, "identity")
    assert network.attention.mlp[0].in_features == network.backbone.out_channels == 32


HOSTILE = [
    *("os.system", "dopepp.models.network.os.system", "dopepp.models.network.backbones.DSC", "."),
    *(f"dopepp.models.backbones.{n}" for n in ("Path", "nn.Sequential", "conv_block", "Backbone")),
    *(None, 7, nn.Identity, b"os.system"),
]
"""Hostile checkpoints have further targets: ``tests/security/test_hostile_checkpoints.py``."""


@pytest.mark.parametrize(
    ("part", "target"),
    [*(("backbone", item) for item in HOSTILE), ("attention", "os.system"), ("head", "os.system")],
)
def test_other_targets_are_refused(make_spec, part, target):
    spec = make_spec()
    spec[part] = {"_target_": target, "command": "true"}
    with pytest.raises(UserError, match=rf"got {part} _target_ .* allowed: dopepp\.models\."):
        build_network(spec)


def test_a_refused_target_is_not_even_imported(tmp_path, monkeypatch):
    (tmp_path / "never_imported.py").write_text("x = 1\n")
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(UserError, match=r"never_imported\.x"):
        BACKBONES.build({"_target_": "never_imported.x"})
    assert "never_imported" not in sys.modules


def test_a_rebound_name_is_refused(monkeypatch):
    """The allow-list names a class, not an object that replaced the class."""
    for other in (nn.Identity, backbones.VGG19):
        monkeypatch.setattr(backbones, "DSC", other)
        with pytest.raises(UserError, match=rf"which is <class .*{other.__name__}.*defined in"):
            BACKBONES.build({"_target_": DSC})


class Tiny(backbones.Backbone):
    """A backbone of a user."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.out_channels = channels

    def forward(self, images):
        return images


@pytest.fixture
def tiny_module(monkeypatch):
    """Make Tiny importable like a class of an installed package."""
    module = type(sys)("somebodys_package")
    monkeypatch.setattr(Tiny, "__module__", "somebodys_package")
    module.Tiny, module.Stolen, module.run = Tiny, subprocess.Popen, subprocess.run
    monkeypatch.setitem(sys.modules, "somebodys_package", module)
    return "somebodys_package"


def test_a_registered_class_can_be_built(make_spec, tiny_module):
    registry = Registry("backbone", backbones.Backbone)
    with pytest.raises(UserError, match="allowed: nothing"):
        registry.build({"_target_": f"{tiny_module}.Tiny", "channels": 8})
    registry.register(f"{tiny_module}.Tiny")
    assert registry.build({"_target_": f"{tiny_module}.Tiny", "channels": 8}).out_channels == 8


@pytest.mark.parametrize("name", ["Stolen", "run", "missing"])
def test_registering_anything_else_fails_at_once(tiny_module, name):
    before = BACKBONES.targets
    with pytest.raises(UserError, match=rf"{tiny_module}.{name}"):
        BACKBONES.register(f"{tiny_module}.{name}")
    for target in ("no_such_package.Backbone", "Backbone"):
        with pytest.raises(UserError, match="cannot be imported"):
            BACKBONES.register(target)
    assert BACKBONES.targets == before


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"wdth": 1}, "argument 'wdth' of dopepp.*DSC; allowed: width, batch_norm; fix"),
        ({"_args_": [1]}, "argument '_args_'"),
        ({3: 1}, "argument 3"),
        ({"width": {"_target_": "os.getcwd"}}, "key '_target_' in .*argument width.*plain values"),
        ({"width": [{"a": {"_target_": DSC, "width": 1}}]}, "without nested targets"),
        ({"width": object()}, "a object in .*argument width"),
        ({"width": torch.ones(1)}, "a Tensor in"),
        ({"width": [1]}, r"width=\[1\]"),
    ],
)
def test_arguments_are_named_and_plain(arguments, message):
    with pytest.raises(UserError, match=message):
        BACKBONES.build({"_target_": DSC, **arguments})


def test_arguments_provided_by_the_program_cannot_be_set(make_spec):
    for options, message in (
        ({"attention_channels": 7}, "argument 'channels' of .*CBAM; allowed: reduction, kernel"),
        ({"head_num_objects": 2}, "argument 'num_objects' of .*MultiScale"),
    ):
        with pytest.raises(UserError, match=message):
            build_network(make_spec(**options))


@pytest.mark.parametrize("node", [None, [DSC], DSC, 3])
def test_a_node_and_a_spec_are_mappings(node):
    with pytest.raises(UserError, match="a model spec with"):
        build_network(node)
    with pytest.raises(UserError, match=r"got backbone .* allowed: a mapping with _target_"):
        BACKBONES.build(node)


def change(**fields):
    return lambda spec: spec.update(fields)


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        (lambda spec: spec.pop("head"), "a model spec with .* allowed: exactly backbone, atten"),
        (change(stride=4), "'stride'.* allowed: exactly"),
        (change(activation="softmax"), "activation 'softmax'; allowed: identity, exp"),
        (change(num_objects=0), "num_objects=0; allowed: an integer from 1 to 256"),
        (change(num_objects=10**9), "num_objects=1000000000"),
        (change(num_objects=True), "num_objects=True"),
        (lambda spec: spec["head"].update(width=1e6), "width=1000000.0"),
    ],
)
def test_a_spec_is_checked_and_bounded(make_spec, edit, message):
    spec = make_spec()
    edit(spec)
    with pytest.raises(UserError, match=message):
        build_network(spec)


def test_a_registry_takes_classes_that_a_package_re_exports():
    """torch.optim.AdamW is defined in torch.optim.adamw: below the module that the list names."""
    parameters = [nn.Parameter(torch.zeros(1))]
    node = {"_target_": "torch.optim.AdamW", "lr": 1e-3, "betas": [0.9, 0.99]}
    optimizer = OPTIMIZERS.build(node, params=parameters)
    assert type(optimizer) is torch.optim.AdamW
    assert optimizer.param_groups[0]["lr"] == 1e-3
    with pytest.raises(UserError, match="argument 'params'"):
        OPTIMIZERS.build({"_target_": "torch.optim.AdamW", "params": []}, params=parameters)
    with pytest.raises(UserError, match=r"got optimizer _target_ 'torch.optim.Adam'"):
        OPTIMIZERS.build({"_target_": "torch.optim.Adam"}, params=parameters)


def test_invalid_and_missing_arguments_are_user_errors():
    parameters = [nn.Parameter(torch.zeros(1))]
    with pytest.raises(UserError, match=r"which failed: Invalid learning rate: -1"):
        OPTIMIZERS.build({"_target_": "torch.optim.SGD", "lr": -1}, params=parameters)
    with pytest.raises(UserError, match=r"SpatialCrossEntropy without sigma"):
        LOSSES.build({"_target_": "dopepp.models.losses.SpatialCrossEntropy"})


class Logger:
    """Accepts unlisted keywords, like Lightning's loggers."""

    def __init__(self, path: str, **more: object) -> None:
        self.path, self.more = path, more


def test_a_class_may_accept_any_keywords(monkeypatch, tiny_module):
    monkeypatch.setattr(Logger, "__module__", tiny_module)
    sys.modules[tiny_module].Logger = Logger
    registry = Registry("logger", Logger, [f"{tiny_module}.Logger"])
    node = {"_target_": f"{tiny_module}.Logger", "project": "parts"}
    assert registry.build(node, path="here").more == {"project": "parts"}
    for name, value in (("path", "there"), ("_partial_", True)):
        with pytest.raises(UserError, match=f"argument '{name}'"):
            registry.build({**node, name: value}, path="here")
