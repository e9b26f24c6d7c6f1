import pytest
import torch

from dopepp.core.errors import UserError
from dopepp.experiment.assembly import build_system as built
from dopepp.experiment.assembly.build_parts import build_parts
from dopepp.experiment.assembly.build_system import (
    build_untrained,
    choose_precision,
)
from dopepp.experiment.config.run_config import TrainerConfig


@pytest.mark.parametrize(
    ("accelerator", "vendor", "flags", "gpu_is_fast", "expected"),
    [
        ("cpu", "AuthenticAMD", "sse2 avx512_bf16", False, "bf16-mixed"),
        ("cpu", "GenuineIntel", "sse2 avx512_bf16", False, "32-true"),
        ("cpu", "GenuineIntel", "sse2 avx512_bf16 amx_bf16", False, "bf16-mixed"),
        ("cpu", "", "asimd bf16", False, "bf16-mixed"),
        ("cpu", "AuthenticAMD", "sse2 avx2", True, "32-true"),
        ("cpu", "", "", True, "32-true"),
        ("cuda", "", "", True, "bf16-mixed"),
        ("cuda", "AuthenticAMD", "avx512_bf16", False, "32-true"),
        ("mps", "AuthenticAMD", "avx512_bf16", True, "32-true"),
    ],
)
def test_bf16_needs_fast_hardware(accelerator, vendor, flags, gpu_is_fast, expected, monkeypatch):
    facts = {("vendor_id",): vendor, ("flags", "Features"): flags}
    monkeypatch.setattr(built, "cpu_fact", lambda *names: facts[names])
    monkeypatch.setattr(torch.cuda, "is_bf16_supported", lambda **_: gpu_is_fast)
    assert choose_precision("auto", accelerator)[0] == expected
    assert choose_precision("16-mixed", accelerator) == ("16-mixed", "as requested")


@pytest.fixture(autouse=True)
def alone(monkeypatch):
    monkeypatch.delenv("WORLD_SIZE", raising=False)


@pytest.mark.parametrize(("count", "options"), [
    *((1, options) for options in (
        {}, {"devices": 1}, {"devices": "1"}, {"devices": [3]}, {"devices": "3,"},
        {"devices": 1, "strategy": "ddp"},  # the strategy does not change the number
        {"devices": "auto", "accelerator": "cpu"},
    )),
    *((2, {"devices": devices}) for devices in (2, "2", [0, 1], "0,1")),
    *((4, options) for options in (
        {"devices": "auto", "accelerator": "auto"}, {"devices": -1, "accelerator": "gpu"},
        {"devices": "-1", "accelerator": "gpu"},
    )),
    (2, {"devices": 1, "num_nodes": 2}),
    (6, {"devices": 2, "num_nodes": 3}),
], ids=str)  # fmt: skip
def test_number_of_processes(count, options, monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 4)
    assert TrainerConfig(max_epochs=1, **options).num_processes == count


def test_processes_of_torchrun_count(monkeypatch):
    monkeypatch.setenv("WORLD_SIZE", "2")
    assert TrainerConfig(max_epochs=1, devices=1).num_processes == 2


@pytest.mark.parametrize("devices", [0, [], "all", 1.5, True, None, -2], ids=repr)
def test_impossible_devices_are_rejected(devices):
    with pytest.raises(UserError, match=r"trainer\.devices="):
        _ = TrainerConfig(max_epochs=1, devices=devices).num_processes


def test_a_checkpoint_has_the_geometry_of_the_maps(tiny):
    config = tiny("maps.field_radius=3.5", "maps.sigma=1.5")
    recovery = build_untrained(config, build_parts(config.data))[1].recovery
    assert (recovery["sigma"], recovery["field_radius"]) == (1.5, 3.5)
