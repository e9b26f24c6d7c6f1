"""Checkpoints with a hostile archive or with values of huge size."""

import struct
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from dopepp.geometry.camera import camera_matrix
from dopepp.inference.estimator import PoseEstimator
from tests.security.conftest import bounded, rejected

pytestmark = pytest.mark.timeout(60)


def members(path: Path) -> dict[str, bytes]:
    with zipfile.ZipFile(path) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def pack(path: Path, content: list[tuple[str, bytes]], method: int = zipfile.ZIP_STORED) -> Path:
    with zipfile.ZipFile(path, "w", method) as archive:
        for name, data in content:
            archive.writestr(name, data)
    return path


@pytest.mark.filterwarnings("ignore:Duplicate name")
@pytest.mark.parametrize("again", ["good/data.pkl", "GOOD/DATA.PKL", "good/data/0"])
def test_two_members_of_one_name(again, good, tmp_path):
    """Readers differ in which member of two equal names they read."""
    folder = next(iter(members(good))).split("/")[0]
    content = [(name.replace(folder, "good"), data) for name, data in members(good).items()]
    path = pack(tmp_path / "bad.ckpt", [*content, (again, b"\x80\x02N.")])
    rejected(path, "two members with equal names")


def test_two_pickles_in_two_folders(good, tmp_path):
    content = list(members(good).items())
    path = pack(tmp_path / "bad.ckpt", [("other/data.pkl", b"\x80\x02N."), *content])
    rejected(path, "2 members FOLDER/data.pkl")


def test_an_archive_after_other_bytes(good, tmp_path):
    """torch would read the first pickle, which was not checked."""
    path = tmp_path / "bad.ckpt"
    for first in (b"\x80\x02}.", b"#!/bin/sh\n", bytes(512)):
        path.write_bytes(first + good.read_bytes())
        rejected(path, "not a torch file")


@pytest.mark.parametrize("name", ["../data.pkl", "/etc/data.pkl", "a/../../data.pkl"])
def test_members_that_lead_out_of_the_archive(name, good, tmp_path):
    content = [*members(good).items(), (name, b"\x80\x02N.")]
    path = pack(tmp_path / "bad.ckpt", content)
    rejected(path, "bad.ckpt, which torch cannot load")
    assert not list(tmp_path.parent.glob("data.pkl"))


@pytest.mark.parametrize("method", [zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA])
def test_a_zip_bomb(method, tmp_path):
    path = pack(tmp_path / "bad.ckpt", [("a/data.pkl", bytes(50_000_000))], method)
    assert path.stat().st_size < 100_000
    rejected(path, "which unpacks to 50000000 bytes")


def test_a_wrong_declared_size(tmp_path):
    """The directory states 10 bytes or 10 terabytes for a member of 1,000 bytes."""
    path = pack(tmp_path / "bad.ckpt", [("a/data.pkl", bytes(1000))])
    content = bytearray(path.read_bytes())
    entry = content.rindex(b"PK\x01\x02")
    for size in (10, 2**32 - 2):
        content[entry + 24 : entry + 28] = struct.pack("<I", size)
        path.write_bytes(content)
        rejected(path, r"bad\.ckpt, which")


def test_overlapping_members(tmp_path):
    """A thousand entries of the directory share the bytes of one member."""
    path = pack(tmp_path / "one.ckpt", [("a/data/0", bytes(100_000))])
    content = path.read_bytes()
    first, end = content.index(b"PK\x01\x02"), content.index(b"PK\x05\x06")
    directory = content[first:end] * 1000
    tail = bytearray(content[end:])
    tail[8:12] = struct.pack("<HH", 1000, 1000)
    tail[12:16] = struct.pack("<I", len(directory))
    path.write_bytes(content[:first] + directory + tail)
    rejected(path, r"one\.ckpt, which")


def laughs(width: int = 10, depth: int = 12) -> list[Any]:
    """A list of one kilobyte whose text has a terabyte."""
    value: list[Any] = ["ha"]
    for _ in range(depth):
        value = [value] * width
    return value


def nested(depth: int = 200) -> list[Any]:
    value: list[Any] = []
    for _ in range(depth):
        value = [value]
    return value


def endless() -> list[Any]:
    value: list[Any] = []
    value.append(value)
    return value


VALUES = {
    "a billion laughs": laughs,
    "lists within lists": nested,
    "a list that holds itself": endless,
    "a number of a million digits": lambda: 10**1000,
    "a huge mapping key": lambda: {(1, 2): 3},
    "a tensor": lambda: torch.zeros(3),
}
FIELDS = {
    "width": lambda c, bad: c["dopepp"]["spec"]["backbone"].update(width=bad),
    "num_objects": lambda c, bad: c["dopepp"]["spec"].update(num_objects=bad),
    "input_size": lambda c, bad: c["dopepp"].update(input_size=[bad, 64]),
    "format_version": lambda c, bad: c["dopepp"].update(format_version=bad),
    "name": lambda c, bad: c["dopepp"]["parts"][0].update(name=bad),
    "points": lambda c, bad: c["dopepp"]["parts"][0].update(points=bad),
    "data": lambda c, bad: c["dopepp"]["data"].update(config=bad),
    "recovery": lambda c, bad: c["dopepp"].update(recovery={"a": bad}),
}


@pytest.mark.parametrize(
    ("field", "value"),
    [(field, "a billion laughs") for field in FIELDS] + [("data", value) for value in VALUES],
)
def test_values_of_huge_size(field, value, saved):
    bad = VALUES[value]()
    rejected(saved(lambda c: FIELDS[field](c, bad)), r"bad\.ckpt")


def test_a_payload_nested_very_deep(tmp_path):
    deep = b"]" * 100_000 + b"a" * 99_999
    pickled = b"\x80\x02}X\x06\x00\x00\x00dopepp}X\x04\x00\x00\x00data" + deep
    pickled += b"ssX\x0a\x00\x00\x00state_dict}s."
    torch.save({}, tmp_path / "empty.ckpt")
    content = [
        (name, pickled if name.endswith(".pkl") else data)
        for name, data in members(tmp_path / "empty.ckpt").items()
    ]
    rejected(pack(tmp_path / "bad.ckpt", content), r"data with more than 32 levels of nesting")


DSC = "dopepp.models.backbones.DSC"
TARGETS = (
    "os.system", "subprocess.Popen", "builtins.exec", "torch.load", "torch.hub.load",
    "torch.utils.collect_env.run", "sympy.sympify", "dopepp.models.backbones.os.system",
    "dopepp.models.backbones.torch.load", "dopepp.models.backbones.Backbone", f"{DSC}.__init__",
    "dopepp.models.backbones.__builtins__", "dopepp.models.heads.MultiScale",
    "dopepp.models.backbones.read_mapping", f" {DSC}", f"{DSC}\n", f"{DSC}\x00",
    "dopepp.models.backbones.DS\u0421",  # a Cyrillic С
    "dopepp\u2024models.backbones.DSC",  # a dot that is none
    "\uff44opepp.models.backbones.DSC",  # a wide d, which Python's own names fold
    "DSC", "", None, [DSC], {"_target_": "os.system"}, "x" * 1_000_000,
)  # fmt: skip


@pytest.mark.parametrize("target", TARGETS, ids=lambda target: repr(target)[:60])
def test_a_target_outside_of_the_list(target, saved, canary):
    node = {"_target_": target, "command": canary, "_args_": [canary], "width": 0.125}
    path = saved(lambda c: c["dopepp"]["spec"].update(backbone=node))
    rejected(path, r"backbone _target_ .*bad\.ckpt")


def spec(part: str, **arguments: object):
    return lambda c: c["dopepp"]["spec"][part].update(arguments)


def payload(**fields: object):
    return lambda c: c["dopepp"].update(fields)


def part(**fields: object):
    return lambda c: c["dopepp"]["parts"][0].update(fields)


TOO_MUCH = {
    "a million channels": (spec("backbone", width=1e6), "width=1000000"),
    "endless channels": (spec("backbone", width=float("inf")), "width=inf"),
    "no width": (spec("head", width=float("nan")), "width=nan"),
    "a billion stages": (spec("head", stages=10**9), "stages=1000000000"),
    "a billion objects": (lambda c: c["dopepp"]["spec"].update(num_objects=10**9), "num_objects"),
    "attention of nothing": (spec("attention", reduction=10**9), "reduction"),
    "the widest network in a small file": (
        lambda c: (spec("backbone", width=4.0)(c), spec("head", width=4.0, stages=12)(c)),
        "do not fit the network of the spec",
    ),
    "an argument that builds": (spec("head", stages={"_target_": "os.system"}), "_target_"),
    "an argument of the builder": (spec("head", in_channels=10**9), "argument 'in_channels'"),
    "private arguments": (spec("head", __class__="os.system"), "argument '__class__'"),
    "inputs of terapixels": (payload(input_size=[10**7, 10**7]), r"input_size=\[10000000"),
    "inputs of one pixel too many": (payload(input_size=[8193, 64]), r"input_size=\[8193"),
    "a billion peaks": (payload(recovery={"max_peaks": 10**9}), "max_peaks=1000000000"),
    "a threshold of nothing": (payload(recovery={"peak_threshold": float("nan")}),
                               "peak_threshold=nan"),
    "peaks as wide as the sky": (payload(sigma=1e300), "sigma"),
    "a million symmetries": (part(symmetries_discrete=[np.eye(4).tolist()] * 2000),
                             "symmetries_discrete"),
    "a million points": (part(points=[[0.0, 0.0, 0.0]] * 100_001), "points"),
}  # fmt: skip


def weight(make: Callable[[torch.Tensor], object]):
    def edit(content: dict[str, Any]) -> None:
        name = next(name for name in content["state_dict"] if name.endswith("weight"))
        content["state_dict"][name] = make(content["state_dict"][name])

    return edit


WEIGHTS = {
    "one number repeated to any size": lambda w: torch.zeros(()).expand(10**6, 10**6),
    "overlapping rows": lambda w: torch.zeros(w.numel()).as_strided(
        (w.numel() // 2, w.numel() // 2), (1, 1)
    ),
    "another shape": lambda w: w.flatten(),
    "no dimensions": lambda w: w.flatten()[0],
    "text": lambda w: "0.5",
    "a list": lambda w: w.tolist(),
    "whole numbers": lambda w: w.long(),
    "true and false": lambda w: w > 0,
}
TOO_MUCH |= {name: (weight(make), "weights that do not fit") for name, make in WEIGHTS.items()}


@pytest.mark.parametrize("name", TOO_MUCH)
def test_a_spec_a_table_or_weights_of_huge_size(name, saved, canary):
    edit, message = TOO_MUCH[name]
    rejected(saved(edit), message)


@pytest.mark.parametrize(
    "value",
    [float("nan"), *(pytest.param(v, marks=pytest.mark.slow) for v in (-float("inf"), 3e38))],
)
def test_weights_of_nan_give_no_detection(value, saved):
    def spoil(content):
        for tensor in content["state_dict"].values():
            if tensor.is_floating_point():
                tensor.fill_(value)

    path = saved(spoil)
    image = np.random.default_rng(0).integers(0, 256, (48, 64, 3), np.uint8)
    with bounded():
        detections = PoseEstimator.load(path).predict(image, camera_matrix(80, 80, 32, 24))
    assert all(np.isfinite(detection.T_cam_obj).all() for detection in detections)
