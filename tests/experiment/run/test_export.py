"""Exports are checked before they are written."""

import errno
import os
from dataclasses import replace
from pathlib import Path

import pytest

from dopepp.core.errors import RunError, UserError
from dopepp.experiment.run import export_checked as module
from dopepp.experiment.run.export_checked import export
from dopepp.inference.estimator import PoseEstimator

RELEASED = Path("pretrained/pivconnector")


@pytest.fixture(autouse=True)
def _few_images(monkeypatch, tmp_path):
    monkeypatch.setattr(module, "NUM_CHECKED", 3)
    monkeypatch.chdir(tmp_path)


def test_safetensors_exports_of_a_released_checkpoint(tmp_path):
    done = export(RELEASED, "safetensors")
    assert done.path == Path("pivconnector.safetensors")
    assert done.agreement.is_exact
    assert done.agreement.num_poses > 0
    assert done.commands == (
        "dopepp predict pivconnector.safetensors IMAGE --K FX FY CX CY",
        "dopepp evaluate ckpt_path=pivconnector.safetensors",
    )
    again = export(done.path, "safetensors", "fp16", tmp_path / "half.safetensors")
    assert again.path.stat().st_size < 0.6 * done.path.stat().st_size
    assert PoseEstimator.load(again.path).parts[0].name == "pivconnector"


def test_a_failed_check_writes_nothing(monkeypatch, tmp_path):
    compare_export = module.compare_export

    monkeypatch.setattr(
        module, "compare_export", lambda *models: replace(compare_export(*models), maps=2e-4)
    )
    with pytest.raises(RunError, match=r"pivconnector\.safetensors was not written: it differs"):
        export(RELEASED, "safetensors")
    assert list(tmp_path.iterdir()) == []
    assert export(RELEASED, "safetensors", "fp16").agreement.maps == 2e-4


def test_a_full_disk_keeps_the_old_file(monkeypatch, tmp_path):
    old = tmp_path / "a.safetensors"
    old.write_bytes(b"old")

    def full(path: Path, content: bytes) -> int:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(Path, "write_bytes", full)
    with pytest.raises(RunError, match=r"cannot write .*a\.safetensors: No space left on device"):
        export(RELEASED, "safetensors", out=old)
    assert old.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [old]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"layout": "torchscript"}, "--format torchscript; allowed: onnx, openvino, safetensors"),
        ({"precision": "bf16"}, "--precision bf16; allowed: fp32, fp16, int8"),
        ({"layout": "safetensors", "precision": "int8"}, "allowed: fp32 or fp16"),
        ({"out": Path("a.pt")}, r"--out a\.pt for --format onnx; allowed: a file NAME\.onnx"),
        ({"layout": "openvino", "out": Path("a.xml")}, "allowed: a folder"),
        ({"layout": "openvino", "out": Path("full")}, "which exists and is not an export"),
        ({"path": Path("a.onnx")}, "which is an export; allowed: a checkpoint"),
        ({"path": Path("none.ckpt")}, "which is not a file"),
    ],
)
def test_wrong_options(options, message, tmp_path, monkeypatch):
    monkeypatch.setattr(module, "validation_renders", None)  # which takes a minute
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "thesis.tex").touch()
    before = sorted(tmp_path.rglob("*"))
    with pytest.raises(UserError, match=message):
        export(**{"path": RELEASED, **options})
    assert sorted(tmp_path.rglob("*")) == before


@pytest.mark.slow
@pytest.mark.parametrize("layout", ["onnx", "openvino"])
def test_int8_exports_state_both_accuracies(layout):
    pytest.importorskip("nncf")
    done = export(RELEASED, layout, "int8", num_images=20)
    assert set(done.export.add_01d) == {"fp32", "int8"}
    assert done.export.add_01d["int8"] > done.export.add_01d["fp32"] - 0.1
    stored = PoseEstimator.load(done.path).network.export
    assert stored == done.export
    assert 0 < done.agreement.position_mm < 20
