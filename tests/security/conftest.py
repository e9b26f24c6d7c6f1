"""What every attack has in common: a tripwire, a bound on memory, a good file to spoil."""

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
from dopepp.models.checkpoint import Checkpoint, write_atomic
from dopepp.models.network import build_network
from dopepp.parts.part import Mesh, make_part

MOST_MB = 400
"""What reading a small hostile file may take; most of it is the first import of a library."""

_SPARE_BYTES = 6 * 2**30
"""A safety belt for the machine the tests run on, where a bomb goes off after all."""


class Call:
    """Unpickling it calls a function: what a hostile pickle is made of."""

    def __init__(self, function: Callable[..., Any], *arguments: object) -> None:
        self.function, self.arguments = function, arguments

    def __reduce__(self) -> tuple[Callable[..., Any], tuple[object, ...]]:
        return self.function, self.arguments


def status_bytes(field: str) -> int:
    """Return a line of this process's status that is in kB."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return 1024 * next(int(line.split()[1]) for line in lines if line.startswith(f"{field}:"))


@contextlib.contextmanager
def within(most_mb: int = MOST_MB) -> Iterator[None]:
    """Fail where the block takes more memory at its peak, and never take the machine's."""
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
def one_line(match: str) -> Iterator[None]:
    """Expect one line for the user, within bounded memory."""
    with within(), pytest.raises(UserError, match=match) as caught:
        yield
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 3000
    # A bomb that went off and was caught afterwards.
    assert "memory" not in caught.value.got.lower()
    assert "allocat" not in caught.value.got.lower()


@pytest.fixture(name="Call", scope="session")
def call_class():
    return Call


@pytest.fixture(scope="session")
def bounded():
    """See :func:`within`."""
    return within


@pytest.fixture(scope="session")
def refused():
    """See :func:`one_line`."""
    return one_line


@pytest.fixture
def canary(tmp_path):
    """A command that leaves a trace; at the end of the test there must be none."""
    trace = tmp_path / "canary"
    yield f"touch {trace}"
    assert not trace.exists()
    assert "DOPEPP_CANARY" not in os.environ


@pytest.fixture(scope="session")
def content(tiny_spec):
    """What is in a good checkpoint's file; to be copied before it is changed."""
    spec = tiny_spec | {"attention": {"_target_": "dopepp.models.attention.CBAM", "reduction": 4}}
    vertices = np.array([[0.0, 0, 0], [0.1, 0, 0], [0, 0.05, 0], [0, 0, 0.02]])
    faces = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]], np.int32)
    part = make_part("bracket", Mesh(vertices, faces), vertices)
    weights = build_network(spec).state_dict()
    return Checkpoint(
        spec, weights, [part], (64, 64), 8, 1.0, {"centroid_threshold": 0.05}
    ).to_file()


@pytest.fixture
def good(content, tmp_path):
    """A good checkpoint."""
    write_atomic(content, tmp_path / "good.ckpt")
    return tmp_path / "good.ckpt"


@pytest.fixture
def saved(content, tmp_path):
    """Write a good checkpoint that a function has changed."""

    def save(edit):
        spoilt = copy.deepcopy(content)
        edit(spoilt)
        torch.save(spoilt, tmp_path / "bad.ckpt")
        return tmp_path / "bad.ckpt"

    return save


@pytest.fixture(scope="session")
def rejected():
    """Expect that a checkpoint is not loaded, and one line for the user."""

    def load(path, match):
        with one_line(match):
            PoseEstimator.load(path)

    return load
