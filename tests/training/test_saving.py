from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import pytest
import torch

from dopepp.training.saving import AtomicCheckpointIO


def test_round_trip(tmp_path: Path) -> None:
    path = tmp_path / "deep" / "last.ckpt"
    AtomicCheckpointIO().save_checkpoint({"a": torch.arange(3), "b": [1, "x"]}, path)
    loaded = AtomicCheckpointIO().load_checkpoint(path)
    assert torch.equal(loaded["a"], torch.arange(3))
    assert loaded["b"] == [1, "x"]


class Unwritable:
    def __reduce__(self) -> str:
        raise RuntimeError("cannot be saved")


@pytest.mark.parametrize("when", ["while writing", "at the rename"])
def test_a_failing_write_keeps_the_old_file(
    when: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "last.ckpt"
    io = AtomicCheckpointIO()
    io.save_checkpoint({"epoch": 1}, path)
    content: dict[str, Any] = {"epoch": 2}
    if when == "while writing":
        content["bad"] = Unwritable()
    else:

        def refuse(*_: object) -> None:
            raise RuntimeError("cannot be renamed")

        monkeypatch.setattr(os, "replace", refuse)
    with pytest.raises(RuntimeError, match="cannot be"):
        io.save_checkpoint(content, path)
    assert io.load_checkpoint(path) == {"epoch": 1}
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("weights_only", [None, False, True])
def test_loading_runs_no_code_whoever_asks(weights_only: bool | None, tmp_path: Path) -> None:
    path, trace = tmp_path / "hostile.ckpt", tmp_path / "trace"

    class Hostile:
        def __reduce__(self) -> tuple[Any, tuple[str]]:
            return os.mkdir, (str(trace),)

    torch.save({"state_dict": Hostile()}, path)
    with pytest.raises(Exception, match=r"[Ww]eights"):
        AtomicCheckpointIO().load_checkpoint(path, weights_only=weights_only)
    assert not trace.exists()
