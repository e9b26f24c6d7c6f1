"""``benchmarks/gpu.py`` keeps measured rows, and measures missing and failed rows again."""

import json
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

MACHINE = "a GPU, 16 cores"


@pytest.fixture
def gpu(monkeypatch):
    monkeypatch.syspath_prepend(str(Path(__file__).parents[1] / "benchmarks"))
    module = pytest.importorskip("gpu")
    monkeypatch.setattr(module, "gc", SimpleNamespace(collect=list))
    monkeypatch.setattr(torch._dynamo, "reset", list)
    return module


def rows_of(gpu, calls, broken=()):
    def measure(name):
        calls.append(name)
        if name in broken:
            raise broken[name]
        return {"ms": 1.2345, "images/s": 1234.5}

    names = ("dope", "dopepp", "dopepp_fast")
    return [
        gpu.Row("inference", {"network": name}, lambda name=name: measure(name)) for name in names
    ]


def test_an_interrupted_command_resumes(gpu, tmp_path):
    calls = []
    with pytest.raises(KeyboardInterrupt):
        gpu.measure(rows_of(gpu, calls, {"dopepp": KeyboardInterrupt()}), tmp_path, MACHINE, 1)
    assert list(json.loads((tmp_path / "rows.json").read_text())["rows"]) == ["inference dope"]
    calls.clear()
    assert gpu.measure(rows_of(gpu, calls), tmp_path, MACHINE, 1) == 0
    assert calls == ["dopepp", "dopepp_fast"]
    lines = (tmp_path / "rows.md").read_text().splitlines()
    assert lines[0] == MACHINE
    assert "| network | ms | images/s |" in lines
    assert lines[-3:] == [f"| {item} | 1.23 | 1234 |" for item in ("dope", "dopepp", "dopepp_fast")]


def test_a_failed_row_has_a_reason_and_is_measured_again(gpu, tmp_path):
    calls = []
    no_room = RuntimeError("CUDA out of memory.\nTried to allocate")
    rows = rows_of(gpu, calls, {"dopepp": no_room})
    assert gpu.measure(rows, tmp_path, MACHINE, 1) == 0
    assert (
        "| dopepp |  |  | RuntimeError: CUDA out of memory. |" in (tmp_path / "rows.md").read_text()
    )
    calls.clear()
    gpu.measure(rows_of(gpu, calls), tmp_path, MACHINE, 1)
    assert calls == ["dopepp"]
    assert "out of memory" not in (tmp_path / "rows.md").read_text()


def test_no_row_begins_when_the_time_is_over(gpu, tmp_path):
    calls = []
    assert gpu.measure(rows_of(gpu, calls), tmp_path, MACHINE, -1) == 3
    assert calls == []


def test_rows_of_two_machines_are_not_mixed(gpu, tmp_path):
    gpu.measure(rows_of(gpu, []), tmp_path, MACHINE, 1)
    with pytest.raises(SystemExit, match=r"another --out"):
        gpu.measure(rows_of(gpu, []), tmp_path, "another GPU", 1)


def test_every_network_has_all_its_rows(gpu):
    rows = [*gpu.Measurements("cpu", gpu.QUICK).rows()]
    assert len({row.name for row in rows}) == len(rows)
    for model in gpu.MODELS:
        tables = {row.table for row in rows if row.setting.get("network") == model}
        assert tables == {"inference", "training", "training on renders"}
