"""Released checkpoints: half precision, no local path, found by name."""

import json
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors import safe_open

from dopepp.core.errors import UserError
from dopepp.models import checkpoint as released
from dopepp.models.checkpoint import Checkpoint, load_network, read
from dopepp.models.network import build_network
from dopepp.parts import load_part


@pytest.fixture
def trained(small_spec):
    return Checkpoint(
        spec=small_spec,
        state_dict=build_network(small_spec).state_dict(),
        parts=[load_part("pivconnector")],
        input_size=(128, 128),
        stride=8,
        sigma=0.7,
        data={
            "name": "dopepp",
            "config": {
                "root": "/data/someone/ycb", "parts": ["pivconnector", "/home/someone/bracket.stl"],
                "virtual": {"backgrounds": "photos/2024", "preset": "wide"}, "cache_dir": "~/c",
            },
        },
    )  # fmt: skip


def test_it_is_the_network_in_half_precision(trained, tmp_path):
    path = tmp_path / "bracket.safetensors"
    released.write_content(trained.to_file(), path)
    with safe_open(path, "pt") as file:  # by the library itself
        dtypes = {file.get_tensor(name).dtype for name in file.keys()}  # noqa: SIM118
    assert dtypes <= {torch.float16, torch.int64}
    network, loaded = load_network(path)
    assert loaded.input_size == trained.input_size
    assert loaded.parts[0].points.tolist() == trained.parts[0].points.tolist()
    for name, value in network.state_dict().items():
        expected = trained.state_dict[name]
        assert value.dtype == expected.dtype
        torch.testing.assert_close(value, expected, rtol=2**-11, atol=2**-24)


def test_nothing_in_it_names_a_local_path(trained, tmp_path):
    path = tmp_path / "bracket.safetensors"
    released.write_content(trained.to_file(), path)
    assert b"someone" not in path.read_bytes()
    config = read(path).data["config"]
    assert config["parts"] == ["pivconnector", "bracket.stl"]
    assert (config["root"], config["cache_dir"]) == (None, None)
    assert config["virtual"] == {"backgrounds": None, "preset": "wide"}


def test_weights_beyond_half_precision_are_refused(trained, tmp_path):
    name = next(iter(trained.state_dict))
    trained.state_dict[name] = torch.full_like(trained.state_dict[name], 1e6)
    with pytest.raises(UserError, match=f"{name} with values up to 1e\\+06"):
        released.write_content(trained.to_file(), tmp_path / "bracket.safetensors")
    assert not any(tmp_path.iterdir())


def test_a_name_stands_for_a_file_of_the_package(trained, tmp_path, monkeypatch):
    path = tmp_path / "bracket.safetensors"
    released.write_content(trained.to_file(), path)
    monkeypatch.setattr(released, "released_paths", lambda: {"bracket": path})
    assert read(Path("pretrained/bracket")).input_size == (128, 128)
    with pytest.raises(UserError, match="pretrained/other; allowed: a file, or one of pret"):
        read(Path("pretrained/other"))
    monkeypatch.chdir(tmp_path)  # a file of the user's own goes first
    (tmp_path / "pretrained").mkdir()
    (tmp_path / "pretrained" / "bracket").write_bytes(b"mine")
    with pytest.raises(UserError, match="pretrained/bracket"):
        read(Path("pretrained/bracket"))


@pytest.mark.parametrize("text", ["", "{", "[" * 100_000, json.dumps({"spec": 1})])
def test_a_file_without_a_description(text, trained, tmp_path):
    path = tmp_path / "other.safetensors"
    released.write_safetensors(path, {"network.a": torch.zeros(2)}, {"dopepp": text})
    with pytest.raises(UserError, match=r"other\.safetensors"):
        read(path)


@pytest.mark.parametrize("name", sorted(released.released_paths()))
def test_what_is_released_loads_and_is_small_and_portable(name):
    path = released.released_paths()[name]
    assert path.stat().st_size <= 8_000_000
    assert f"pretrained/{name}" in path.with_suffix(".md").read_text()
    network, checkpoint = load_network(Path("pretrained", name))
    assert all(value.isfinite().all() for value in network.state_dict().values())
    payload = checkpoint.to_payload()
    assert not [
        text for text in texts(payload) if text.startswith(("/", "~", "\\")) or ":\\" in text
    ]
    assert any(name.startswith(part.name) for part in checkpoint.parts)


def texts(value: Any) -> list[str]:
    """Return every text in a payload."""
    if isinstance(value, dict):
        return [text for item in value.values() for text in texts(item)]
    if isinstance(value, list):
        return [text for item in value for text in texts(item)]
    return [value] if isinstance(value, str) else []
