"""Safetensors files: wrong headers, and round trips."""

import json

import pytest
import safetensors.torch
import torch
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from dopepp.models.storage import MAX_HEADER_BYTES, read_safetensors, write_safetensors
from tests.security.conftest import refused

pytestmark = pytest.mark.timeout(60)

A = {"dtype": "F32", "shape": [2], "data_offsets": [0, 8]}


def packed(header: object, data: bytes = bytes(8), length: int | None = None) -> bytes:
    """Assemble a file according to the format's description."""
    text = header if isinstance(header, bytes) else json.dumps(header).encode()
    return (len(text) if length is None else length).to_bytes(8, "little") + text + data


FILES = {
    "nothing": b"",
    "half a length": b"\x10\x00\x00",
    "a header longer than the file": packed({"a": A}, length=10_000),
    "a header of exabytes": packed({"a": A}, length=2**63),
    "a negative length": b"\xff" * 8 + b"{}",
    "a header shorter than it is": packed({"a": A}, length=20),
    "no JSON": packed(b"{'a': 1}"),
    "no text": packed(b'{"\xff": 1}'),
    "nested brackets": packed(b"[" * 200_000 + b"]" * 200_000),
    "a list": packed([]),
    "a long name": packed({"a" * 1000: A}),
    "no name": packed({"": A}),
    "no dtype": packed({"a": {"shape": [2], "data_offsets": [0, 8]}}),
    "another field": packed({"a": {**A, "code": "import os"}}),
    "an entry that is text": packed({"a": "F32"}),
    "an unknown dtype": packed({"a": {**A, "dtype": "F32\x00"}}),
    "a dtype of Python's": packed({"a": {**A, "dtype": "object"}}),
    "a dtype that is a list": packed({"a": {**A, "dtype": ["F32"]}}),
    "another dtype": packed({"a": {**A, "dtype": "F64"}}),
    "a wrong shape": packed({"a": {**A, "shape": [3]}}),
    "a shape of terabytes": packed({"a": {**A, "shape": [2**20, 2**20]}}),
    "a shape that overflows": packed({"a": {**A, "shape": [2**32, 2**32, 2**32]}}),
    "a shape that overflows to its size": packed({"a": {**A, "shape": [2**62, 4, 2**30, 2]}}),
    "a negative shape": packed({"a": {**A, "shape": [-1, -2]}}),
    "a shape of a million": packed({"a": {**A, "shape": [1] * 1_000_000}}),
    "a shape of fractions": packed({"a": {**A, "shape": [2.0]}}),
    "a shape of truth": packed({"a": {**A, "shape": [True, 2]}}),
    "offsets the wrong way round": packed({"a": {**A, "data_offsets": [8, 0]}}),
    "negative offsets": packed({"a": {**A, "data_offsets": [-8, 0]}}),
    "offsets beyond the file": packed({"a": {**A, "data_offsets": [8, 16]}}),
    "three offsets": packed({"a": {**A, "data_offsets": [0, 8, 8]}}),
    "two tensors in one place": packed({"a": A, "b": A}),
    "overlapping tensors": packed({"a": A, "b": {**A, "data_offsets": [4, 12]}}, bytes(12)),
    "a gap": packed({"a": A, "b": {**A, "data_offsets": [12, 20]}}, bytes(20)),
    "bytes behind the last one": packed({"a": A}, bytes(9)),
    "bytes behind nothing": packed({}, b"#!/bin/sh"),
    "too few bytes": packed({"a": A}, bytes(7)),
    "metadata that are a list": packed({"__metadata__": ["x"], "a": A}),
    "metadata that are numbers": packed({"__metadata__": {"x": 1}, "a": A}),
    "metadata in metadata": packed({"__metadata__": {"x": {"y": "z"}}, "a": A}),
    "metadata of a long name": packed({"__metadata__": {"x" * 1000: "y"}, "a": A}),
    "a pickle": b"\x80\x02cposix\nsystem\nX\x04\x00\x00\x00true\x85R.",
}


@pytest.mark.parametrize("name", FILES)
def test_a_wrong_header(name, tmp_path):
    path = tmp_path / "a.safetensors"
    path.write_bytes(FILES[name])
    with refused(r"a\.safetensors: .*allowed: a complete safetensors file"):
        read_safetensors(path)


def test_a_header_of_megabytes_is_not_parsed(tmp_path):
    path = tmp_path / "a.safetensors"
    path.write_bytes(packed(b'{"a":"' + b" " * (MAX_HEADER_BYTES + 1) + b'"}', b""))
    with refused(f"a header of {MAX_HEADER_BYTES + 9} bytes, over {MAX_HEADER_BYTES}"):
        read_safetensors(path)


def test_a_huge_file_and_paths_without_a_file(tmp_path):
    path = tmp_path / "a.safetensors"
    for place in (path, tmp_path):
        with refused(r"No such file|Is a directory"):
            read_safetensors(place)
    with path.open("wb") as file:
        file.truncate(2**40)
    with refused("more than 1073.74 MB"):
        read_safetensors(path)


@given(
    array=hnp.arrays(
        st.sampled_from(["f4", "f8", "f2", "i8", "i4", "i2", "i1", "u1", "?"]),
        hnp.array_shapes(min_dims=0, max_dims=4, min_side=0, max_side=5),
    ),
    text=st.text(st.characters(exclude_categories=["Cs"])),
)
def test_written_files_are_read_by_dopepp_and_the_library(array, text, tmp_path_factory):
    path = tmp_path_factory.mktemp("any") / "a.safetensors"
    tensors = {"a": torch.from_numpy(array.copy()), "b.c": torch.ones(2, 3)}
    write_safetensors(path, tensors, {"text": text})
    loaded, metadata = read_safetensors(path)
    library = safetensors.torch.load_file(path)
    assert metadata == {"text": text}
    for name, tensor in tensors.items():
        for other in (loaded[name], library[name]):
            assert (other.dtype, other.shape) == (tensor.dtype, tensor.shape)
            assert other.numpy().tobytes() == tensor.numpy().tobytes()


def test_views_and_shared_tensors_are_written_by_value(tmp_path):
    base = torch.arange(12.0).view(3, 4)
    tensors = {"t": base.T, "again": base, "row": base[1], "repeated": torch.ones(1).expand(5)}
    write_safetensors(tmp_path / "a.safetensors", tensors, {})
    loaded, metadata = read_safetensors(tmp_path / "a.safetensors")
    assert metadata == {}
    assert all(torch.equal(loaded[name], tensor) for name, tensor in tensors.items())


def test_a_header_above_the_readers_limit_is_not_written(tmp_path):
    path = tmp_path / "a.safetensors"
    write_safetensors(path, {"a": torch.ones(2)}, {"x": "y"})
    before = path.read_bytes()
    with pytest.raises(ValueError, match="header of"):
        write_safetensors(path, {}, {"x": "y" * MAX_HEADER_BYTES})
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]
