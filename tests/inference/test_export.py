"""Exported networks: the same maps and poses as PyTorch's."""

import os
import shutil
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose
from torch import nn

from dopepp.core.errors import UserError
from dopepp.core.pool import num_threads
from dopepp.geometry.camera import camera_matrix
from dopepp.inference.estimator import PoseEstimator
from dopepp.inference.export import EXPORTERS, check_possible
from dopepp.inference.runtimes import Export
from dopepp.models import network as specs
from dopepp.models.backbones import Backbone
from dopepp.models.checkpoint import Checkpoint, load_network
from dopepp.models.storage import write_atomic
from dopepp.parts.catalogue import pivconnector

K = camera_matrix(130, 130, 63.5, 47.5)


CASCADE = {"_target_": "dopepp.models.heads.Cascade", "width": 0.0625, "stages": 1}
SCALES = {"_target_": "dopepp.models.heads.MultiScale", "width": 0.0625}
PYRAMID = {"_target_": "dopepp.models.backbones.Pyramid", "width": 0.0625}


@pytest.fixture(scope="module", params=["small", pytest.param("large", marks=pytest.mark.slow)])
def original(request, tiny_spec, tmp_path_factory):
    """A network with attention, batch norm and random weights whose maps vary strongly."""
    attention = {"_target_": "dopepp.models.attention.CBAM", "reduction": 4}
    head = {**(CASCADE if request.param == "small" else SCALES), "batch_norm": True}
    spec = {**tiny_spec, "attention": attention, "head": head}
    if request.param == "large":
        spec["backbone"] = PYRAMID
    torch.manual_seed(0)
    network = specs.build_network(spec)
    for module in network.modules():
        if isinstance(module, nn.BatchNorm2d):
            nn.init.normal_(module.running_mean)
            nn.init.uniform_(module.running_var, 0.5, 2)
    for branch in (*network.head.belief_branches, *network.head.field_branches):
        nn.init.normal_(branch.outputs[-1].weight, std=0.5)  # default weights yield constant maps
    checkpoint = Checkpoint(
        spec, network.state_dict(), [pivconnector()], (128, 96), 8, 1.5, {"peak_threshold": 1e-3}
    )
    path = tmp_path_factory.mktemp("checkpoint") / "best.ckpt"
    write_atomic(checkpoint.to_file(), path)
    return path


def written(original, layout, folder, precision="fp32", images=()):
    network, checkpoint = load_network(original)
    save = EXPORTERS[layout][0](network, precision, images)
    path = folder / f"any name{EXPORTERS[layout][1]}"
    save(path, checkpoint, Export(layout, precision, network.size_multiple, 7, 0.5))
    return path


@pytest.fixture(scope="module", params=EXPORTERS)
def exported(request, original, tmp_path_factory):
    packages = {"onnx": ("onnx", "onnxruntime", "onnxscript"), "openvino": ("openvino",)}
    for package in packages.get(request.param, ()):
        pytest.importorskip(package)
    return written(original, request.param, tmp_path_factory.mktemp("exported"))


def random_images(*shape):
    return torch.from_numpy(np.random.default_rng(0).integers(0, 256, shape, np.uint8))


def test_export_has_the_same_maps_for_any_batch_and_size(exported, original):
    networks = [PoseEstimator.load(path).network for path in (exported, original)]
    assert networks[0].size_multiple == networks[1].size_multiple
    for shape in ((1, 3, 96, 128), (1, 3, 32, 32), (3, 3, 160, 64)):
        images = random_images(*shape)
        with torch.inference_mode():
            maps = [network.maps(images) for network in networks]
        for first, other in zip(*maps, strict=True):
            assert other.std() > 0.01
            # Vectors of a random network are up to 20 long, those of a trained network 1.
            size = max(1.0, float(other.abs().max()))
            torch.testing.assert_close(first / size, other / size, atol=1e-4, rtol=0)


def test_export_serves_several_threads(exported):
    network = PoseEstimator.load(exported).network
    images = [random_images(1, 3, 32, side) for side in (32, 64, 96, 128) * 4]
    alone = [network.maps(pixels)[0] for pixels in images]
    with ThreadPoolExecutor(4) as threads:
        for first, other in zip(alone, threads.map(network.maps, images), strict=True):
            torch.testing.assert_close(first, other[0], atol=1e-5, rtol=1e-4)


def test_renamed_export_is_the_same_estimator(exported, original, tmp_path):
    moved = tmp_path / f"renamed{''.join(exported.suffixes)}"
    (shutil.copytree if exported.is_dir() else shutil.copy)(exported, moved)
    ours, theirs = (PoseEstimator.load(path, refine="region") for path in (moved, original))
    assert replace(ours.checkpoint, state_dict={}).to_payload() == theirs.checkpoint.to_payload()
    assert ours.recovery == theirs.recovery
    image = random_images(96, 128, 3).numpy()
    for detection, other in zip(ours.predict(image, K), theirs.predict(image, K), strict=True):
        assert_allclose(detection.T_cam_obj, other.T_cam_obj, atol=1e-4)


@pytest.mark.slow
def test_half_precision_halves_the_file(original, tmp_path):
    pytest.importorskip("onnxscript")
    whole, half = (written(original, "onnx", tmp_path / item, item) for item in ("fp32", "fp16"))
    assert len(half.read_bytes()) < 2 * len(whole.read_bytes())
    images = random_images(1, 3, 96, 128)
    belief, _ = PoseEstimator.load(half).network.maps(images)
    with torch.inference_mode():
        expected, _ = PoseEstimator.load(original).network.maps(images)
    assert 0 < (belief - expected).abs().max() < 0.01


def test_export_contains_no_source_path(exported):
    for path in [exported, *exported.glob("*")]:
        if path.is_file():
            content = path.read_bytes()
            assert str(__file__).encode() not in content
            assert b"network.py" not in content


def test_export_runs_on_the_cpu_only(original, tmp_path, monkeypatch):
    path = tmp_path / "a.onnx"
    monkeypatch.setattr("dopepp.inference.estimator.check_device", torch.device)
    with pytest.raises(UserError, match=r"device cuda for .*a\.onnx; allowed: cpu"):
        PoseEstimator.load(path, "cuda")


@pytest.mark.parametrize(
    ("layout", "package"), [("onnx", "onnxscript"), ("openvino", "openvino"), ("onnx", "onnx")]
)
def test_missing_extra_is_reported(layout, package, tmp_path, monkeypatch):
    monkeypatch.setattr("dopepp.core.errors.find_spec", lambda name: None if name == package else 1)
    message = rf"without the package {package}.*dopepp\[{layout}\]"
    with pytest.raises(UserError, match=message):
        check_possible(layout, "fp32")
    if package != "onnxscript":
        (tmp_path / "model.xml").touch()
        with pytest.raises(UserError, match=message):
            PoseEstimator.load(tmp_path / "a.onnx" if layout == "onnx" else tmp_path)


@pytest.mark.parametrize("package", ["nncf", "openvino"])
def test_int8_of_onnx_requires_both_extras(package, monkeypatch):
    monkeypatch.setattr("dopepp.core.errors.find_spec", lambda name: None if name == package else 1)
    check_possible("onnx", "fp16")
    with pytest.raises(UserError, match=rf"int8 without the package {package}.*dopepp\[openvino\]"):
        check_possible("onnx", "int8")


def cubed(values: torch.Tensor) -> torch.Tensor:  # torch reads the types
    return values**3


class Cubed(Backbone):
    """A backbone with a custom operator that no format supports."""

    out_channels, stride, cell_multiple = 8, 8, 1

    def __init__(self) -> None:
        super().__init__()
        self.layer = nn.Conv2d(3, 8, 8, stride=8)

    def forward(self, images: torch.Tensor) -> torch.Tensor:
        return torch.ops.dopepp_test.cubed(self.layer(images))


@pytest.mark.parametrize("layout", ["onnx", pytest.param("openvino", marks=pytest.mark.slow)])
def test_unsupported_operator_is_reported(layout, original, tmp_path, monkeypatch):
    pytest.importorskip("onnxscript" if layout == "onnx" else "openvino")
    if not hasattr(torch.ops.dopepp_test, "cubed"):
        operator = torch.library.custom_op("dopepp_test::cubed", mutates_args=())(cubed)
        operator.register_fake(torch.empty_like)
    network, _ = load_network(original)
    network.backbone = Cubed()
    network.attention = nn.Identity()
    wired = {"in_channels": 8, "num_objects": 1, "activation": "exp"}
    network.head = specs.HEADS.build(CASCADE, **wired)
    with pytest.raises(UserError, match=r"Cubed, Identity, .* cannot express") as e:
        EXPORTERS[layout][0](network.eval(), "fp32", ())
    assert "\n" not in str(e.value)


def test_threads(monkeypatch):
    monkeypatch.setenv("OMP_NUM_THREADS", "3")
    assert num_threads() == 3
    for text in ("", "many", "0"):
        monkeypatch.setenv("OMP_NUM_THREADS", text)
        assert 1 <= num_threads() <= len(os.sched_getaffinity(0))
