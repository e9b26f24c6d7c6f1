import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors import safe_open

from dopepp.core.errors import UserError
from dopepp.models import checkpoint as module
from dopepp.models import storage
from dopepp.models.checkpoint import (
    Checkpoint,
    load_network,
    read,
    released_paths,
    write_content,
)
from dopepp.models.network import build_network
from dopepp.models.storage import write_atomic
from dopepp.parts.part import Mesh, make_part
from dopepp.parts.size import LearnedRange
from tests.models.conftest import assert_weights


@pytest.fixture
def part():
    vertices = np.array([[0.0, 0, 0], [0.1, 0, 0], [0, 0.05, 0], [0, 0, 0.02]])
    faces = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]], np.int32)
    return make_part("bracket", Mesh(vertices, faces))


@pytest.fixture
def checkpoint(small_spec, part):
    return Checkpoint(
        spec=small_spec,
        state_dict=build_network(small_spec).state_dict(),
        parts=[part],
        input_size=(128, 96),
        stride=8,
        sigma=1.0,
        recovery={"threshold": 0.3, "max_instances": 4},
        data={
            "preset": "paper", "K": [[1.0, 0, 0]], "root": "/data/someone/ycb", "cache_dir": "~/c",
            "parts": ["pivconnector", "/home/someone/bracket.stl"],
            "virtual": {"backgrounds": "photos/2024", "preset": "wide"},
        },
        data_fingerprint="abc",
        seen={"bracket": LearnedRange(40.0, 90.0, 0.2, 0.5)},
    )  # fmt: skip


@pytest.fixture
def saved(checkpoint, tmp_path):
    write_atomic(checkpoint.to_file(), tmp_path / "best.ckpt")
    return tmp_path / "best.ckpt"


def test_round_trip(checkpoint, saved, part):
    network, loaded = load_network(saved)
    for name in set(vars(checkpoint)) - {"state_dict", "parts"}:
        assert getattr(loaded, name) == getattr(checkpoint, name)
    assert isinstance(loaded.recovery["max_instances"], int)
    assert (loaded.parts[0].name, loaded.parts[0].mesh_hash) == ("bracket", part.mesh_hash)
    np.testing.assert_array_equal(loaded.parts[0].cuboid, part.cuboid)
    np.testing.assert_array_equal(loaded.parts[0].points, part.points)
    assert not network.training
    assert_weights(network, checkpoint.state_dict)


def test_a_spec_with_lists_survives_a_round_trip(checkpoint, small_fast_spec, tmp_path):
    network = build_network(small_fast_spec).eval()
    stored = replace(checkpoint, spec=small_fast_spec, state_dict=network.state_dict())
    write_atomic(stored.to_file(), tmp_path / "best.ckpt")
    loaded, description = load_network(tmp_path / "best.ckpt")
    assert description.spec == small_fast_spec
    images = torch.randint(0, 256, (1, 3, 64, 96), dtype=torch.uint8)
    with torch.no_grad():
        torch.testing.assert_close(loaded.maps(images), network.maps(images), rtol=0, atol=0)


def test_a_training_checkpoint_is_read_by_its_two_keys(checkpoint, tmp_path):
    """Entries of Lightning and weights outside the network are ignored."""
    content = checkpoint.to_file()
    content["state_dict"]["loss.weight"] = torch.zeros(3)
    content.update(epoch=3, optimizer_states=[{"state": {0: {"step": torch.tensor(4.0)}}}])
    write_atomic(content, tmp_path / "last.ckpt")
    assert read(tmp_path / "last.ckpt").state_dict.keys() == checkpoint.state_dict.keys()


def test_numpy_scalars_become_plain_values_and_other_values_are_refused(checkpoint, tmp_path):
    checkpoint.recovery = {"a": np.float64(0.5), "b": np.float32(0.25), "c": np.int64(3)}
    checkpoint.data = {"K": np.eye(3), "sizes": (1, 2), "none": None, "flag": np.bool_(True)}
    write_atomic(checkpoint.to_file(), tmp_path / "a.ckpt")
    loaded = read(tmp_path / "a.ckpt")
    assert loaded.recovery == {"a": 0.5, "b": 0.25, "c": 3}
    assert loaded.data == {"K": np.eye(3).tolist(), "sizes": [1, 2], "none": None, "flag": True}
    checkpoint.data = {"path": Path("here")}
    with pytest.raises(TypeError, match="holds plain values"):
        checkpoint.to_payload()


def test_pretrained_weights_path_is_neither_written_nor_read(make_spec, part, tmp_path):
    spec = make_spec("VGG19", "Identity", backbone_width=0.125, head_width=0.125)
    network = build_network(spec)
    spec["backbone"]["weights_path"] = str(tmp_path / "not_there.pth")
    checkpoint = Checkpoint(spec, network.state_dict(), [part], (64, 64), 8, 1.0)
    content = checkpoint.to_file()
    assert "weights_path" not in content["dopepp"]["spec"]["backbone"]
    # A reader must not open weights that a file names nevertheless.
    content["dopepp"]["spec"]["backbone"]["weights_path"] = "/etc/passwd"
    write_atomic(content, tmp_path / "a.ckpt")
    loaded, _ = load_network(tmp_path / "a.ckpt")
    assert loaded.backbone.out_channels == 16


@pytest.mark.parametrize(
    "content", [b"", b"hello", b"PK\x03\x04", bytes(range(256)) * 40, 0.5, 0.99]
)
def test_files_that_are_damaged_or_no_torch_files_are_refused(saved, content):
    whole = saved.read_bytes()
    cut = whole[: int(len(whole) * content)] if isinstance(content, float) else content
    saved.write_bytes(cut)
    with pytest.raises(UserError, match="truncated or not a torch file"):
        read(saved)
    saved.unlink()
    with pytest.raises(UserError, match=r"which is not a file; allowed: a checkpoint \(\.ckpt\)"):
        read(saved)


def test_a_file_over_the_limit_is_refused(saved, monkeypatch):
    monkeypatch.setattr(storage, "MAX_BYTES", 1000)
    with pytest.raises(UserError, match="at most 1000 bytes"):
        read(saved)


def set_payload(key, value):
    return lambda content: content["dopepp"].update({key: value})


def first_weight(content):
    return next(name for name in content["state_dict"] if name.endswith("weight"))


def set_weight(value):
    return lambda content: content["state_dict"].update({first_weight(content): value})


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        (lambda c: c.pop("dopepp"), "without 'dopepp' entry"),
        (lambda c: c.update(dopepp=[1]), "a description of type list"),
        (set_payload("format_version", 3), "format_version 3, .*allowed: 2; fix: use"),
        (set_payload("format_version", 1), "format_version 1"),
        (lambda c: c["dopepp"].pop("spec"), "no spec"),
        (set_payload("spec", "DSC"), "spec='DSC'"),
        (set_payload("spec", {}), "a model spec with"),
        (set_payload("input_size", [128]), r"input_size=\[128\]"),
        (set_payload("input_size", [0, 128]), r"input_size=\[0, 128\]"),
        (set_payload("stride", 4), "stride 4 and 1 parts"),
        (set_payload("stride", 8.5), "stride=8.5"),
        (set_payload("sigma", 0.0), "sigma=0.0"),
        (set_payload("sigma", float("nan")), "sigma=nan"),
        (set_payload("sigma", torch.tensor(1.0)), "sigma with a Tensor"),
        (set_payload("parts", []), "0 parts.*allowed: stride 8 and 1 parts"),
        (set_payload("parts", None), "parts=None"),
        (set_payload("parts", [{"name": "x"}]), "checkpoint .*best.ckpt"),
        (set_payload("recovery", {"threshold": "high"}), "recovery.threshold='high'"),
        (set_payload("data", "paper"), "data='paper'"),
        (set_payload("data_fingerprint", 3), "data_fingerprint=3"),
        (lambda c: c.pop("state_dict"), "state_dict as NoneType"),
        (lambda c: c.update(state_dict={}), "weights that do not fit"),
        (lambda c: c["state_dict"].pop(first_weight(c)), "do not fit .*beginning with backbone"),
        (lambda c: c["state_dict"].update({"network.x": torch.ones(1)}), "beginning with x"),
        (set_weight(torch.ones(8, 3, 3, 3).to_sparse()), "_rebuild_sparse_tensor"),
        (set_weight(torch.ones(8, 3, 3, 3, device="meta")), "_rebuild_meta_tensor_no_storage"),
        (set_weight(torch.ones(8, 3, 3, 3, dtype=torch.complex64)), "weights that do not fit"),
    ],
)
def test_an_inconsistent_file_is_refused_in_one_line(saved, edit, message):
    content = torch.load(saved, weights_only=True)
    edit(content)
    torch.save(content, saved)
    with pytest.raises(UserError, match=message) as caught:
        load_network(saved)
    assert "\n" not in str(caught.value)
    assert "best.ckpt" in str(caught.value)


@pytest.mark.parametrize("failing", ["replace", "fsync", "save"])
def test_a_failed_write_keeps_only_the_old_file(checkpoint, saved, monkeypatch, failing):
    before = saved.read_bytes()

    def fail(*_):
        raise OSError("no space left on device")

    monkeypatch.setattr(storage.torch if failing == "save" else storage.os, failing, fail)
    checkpoint.sigma = 2.0
    with pytest.raises(OSError, match="no space left"):
        write_atomic(checkpoint.to_file(), saved)
    monkeypatch.undo()
    assert saved.read_bytes() == before
    assert list(saved.parent.iterdir()) == [saved]
    assert read(saved).sigma == 1.0


@pytest.fixture
def released(checkpoint, tmp_path):
    write_content(checkpoint.to_file(), tmp_path / "bracket.safetensors")
    return tmp_path / "bracket.safetensors"


def test_a_released_file_is_the_network_in_half_precision_without_local_paths(released, checkpoint):
    with safe_open(released, "pt") as file:  # with the library
        dtypes = {file.get_tensor(name).dtype for name in file.keys()}  # noqa: SIM118
    assert dtypes <= {torch.float16, torch.int64}
    network, loaded = load_network(released)
    assert loaded.input_size == checkpoint.input_size
    assert loaded.parts[0].points.tolist() == checkpoint.parts[0].points.tolist()
    weights, expected = dict(network.state_dict()), dict(checkpoint.state_dict)
    torch.testing.assert_close(weights, expected, rtol=2**-11, atol=2**-24)
    assert b"someone" not in released.read_bytes()
    assert loaded.data["parts"] == ["pivconnector", "bracket.stl"]
    assert (loaded.data["root"], loaded.data["cache_dir"]) == (None, None)
    assert loaded.data["virtual"] == {"backgrounds": None, "preset": "wide"}


def test_weights_beyond_half_precision_are_refused(checkpoint, tmp_path):
    name = next(iter(checkpoint.state_dict))
    checkpoint.state_dict[name] = torch.full_like(checkpoint.state_dict[name], 1e6)
    with pytest.raises(UserError, match=f"{name} with values up to 1e\\+06"):
        write_content(checkpoint.to_file(), tmp_path / "bracket.safetensors")
    assert not any(tmp_path.iterdir())


def test_a_name_refers_to_a_file_of_the_package(released, tmp_path, monkeypatch):
    monkeypatch.setattr(module, "released_paths", lambda: {"bracket": released})
    assert read(Path("pretrained/bracket")).input_size == (128, 96)
    missing = "pretrained/other, no such file; allowed: an existing file, or one of"
    with pytest.raises(UserError, match=missing):
        read(Path("pretrained/other"))
    monkeypatch.chdir(tmp_path)  # a file of the user has priority
    (tmp_path / "pretrained").mkdir()
    (tmp_path / "pretrained" / "bracket").write_bytes(b"mine")
    with pytest.raises(UserError, match="pretrained/bracket"):
        read(Path("pretrained/bracket"))


@pytest.mark.parametrize("text", ["", "{", "[" * 100_000, json.dumps({"spec": 1})])
def test_a_released_file_without_a_description(text, tmp_path):
    path = tmp_path / "other.safetensors"
    storage.write_safetensors(path, {"network.a": torch.zeros(2)}, {"dopepp": text})
    with pytest.raises(UserError, match=r"other\.safetensors"):
        read(path)


@pytest.mark.parametrize("name", sorted(released_paths()))
def test_a_released_checkpoint_loads_and_is_small_and_portable(name):
    path = released_paths()[name]
    assert path.stat().st_size <= 8_000_000
    assert f"pretrained/{name}" in path.with_suffix(".md").read_text()
    network, checkpoint = load_network(Path("pretrained", name))
    assert all(value.isfinite().all() for value in network.state_dict().values())
    # No text is a path: absolute, in a home folder, or of Windows.
    assert not re.search(r'"(/|~|\\\\|\w:\\\\)', json.dumps(checkpoint.to_payload()))
    assert any(name.startswith(part.name) for part in checkpoint.parts)
