"""Fixtures of attacks: a tripwire, a bound on memory, and a correct file to damage."""

import contextlib
import copy
import os
import resource
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from dopepp.core.errors import UserError
from dopepp.inference.estimator import PoseEstimator
from dopepp.models.checkpoint import Checkpoint
from dopepp.models.network import build_network
from dopepp.models.storage import write_atomic
from dopepp.parts.part import Mesh, make_part

MOST_MB = 400
"""Memory that reading a small hostile file may take, mostly for first imports of libraries."""

_SPARE_BYTES = 6 * 2**30
"""Additional address space, which limits the memory of an undetected bomb."""


class Call:
    """Calls a function when it is unpickled."""

    def __init__(self, function: Callable[..., Any], *arguments: object) -> None:
        self.function, self.arguments = function, arguments

    def __reduce__(self) -> tuple[Callable[..., Any], tuple[object, ...]]:
        return self.function, self.arguments


def status_bytes(field: str) -> int:
    """Return a field of this process's status, in bytes."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return 1024 * next(int(line.split()[1]) for line in lines if line.startswith(f"{field}:"))


@contextlib.contextmanager
def bounded(most_mb: int = MOST_MB) -> Iterator[None]:
    """Fail if the block's peak of memory is above a limit, which also protects the machine."""
    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (status_bytes("VmSize") + _SPARE_BYTES, hard))
    try:
        Path("/proc/self/clear_refs").write_text("5")  # the peak begins anew
        before = status_bytes("VmRSS")
        yield
        taken = (status_bytes("VmHWM") - before) / 1e6
    finally:
        resource.setrlimit(resource.RLIMIT_AS, (soft, hard))
    assert taken < most_mb, f"{taken:.0f} MB"


@contextlib.contextmanager
def refused(match: str) -> Iterator[None]:
    """Expect a UserError of one line within bounded memory."""
    with bounded(), pytest.raises(UserError, match=match) as caught:
        yield
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 3000
    # A message about memory would mean that a bomb was caught only after its allocation.
    assert "memory" not in caught.value.got.lower()
    assert "allocat" not in caught.value.got.lower()


def rejected(path: Path, match: str) -> None:
    """Expect that loading a checkpoint fails with one line for the user."""
    with refused(match):
        PoseEstimator.load(path)


@pytest.fixture
def canary(tmp_path):
    """A command that would leave a trace; the end of the test checks that there is none."""
    trace = tmp_path / "canary"
    yield f"touch {trace}"
    assert not trace.exists()
    assert "DOPEPP_CANARY" not in os.environ


@pytest.fixture(scope="session")
def content(tiny_spec):
    """The content of a correct checkpoint; tests change copies only."""
    spec = tiny_spec | {"attention": {"_target_": "dopepp.models.attention.CBAM", "reduction": 4}}
    vertices = np.array([[0.0, 0, 0], [0.1, 0, 0], [0, 0.05, 0], [0, 0, 0.02]])
    faces = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]], np.int32)
    part = make_part("bracket", Mesh(vertices, faces), vertices)
    weights = build_network(spec).state_dict()
    recovery = {"centroid_threshold": 0.05}
    return Checkpoint(spec, weights, [part], (64, 64), 8, 1.0, recovery).to_file()


@pytest.fixture
def good(content, tmp_path):
    """A correct checkpoint."""
    write_atomic(content, tmp_path / "good.ckpt")
    return tmp_path / "good.ckpt"


@pytest.fixture
def saved(content, tmp_path):
    """Write a correct checkpoint after a function has changed its content."""

    def save(edit):
        spoilt = copy.deepcopy(content)
        edit(spoilt)
        torch.save(spoilt, tmp_path / "bad.ckpt")
        return tmp_path / "bad.ckpt"

    return save
