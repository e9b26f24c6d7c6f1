"""READMEs of runs and rejected releases; ``test_golden.py`` compares the texts."""

import logging
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from dopepp.core.errors import UserError
from dopepp.experiment import program
from dopepp.experiment.results import pages
from dopepp.experiment.results.folder import METRICS_FILE, VERSIONS_FILE, write_json
from dopepp.experiment.results.pages import release
from dopepp.models.checkpoint import Checkpoint, read, write_atomic
from dopepp.models.network import build_network
from dopepp.parts import load_part

CONFIG: Any = SimpleNamespace(
    model=SimpleNamespace(name="dopepp"),
    data=SimpleNamespace(name="hybrid"),
    trainer=SimpleNamespace(max_epochs=3),
    keep_checkpoints=True,
)


@pytest.fixture
def run(tmp_path):
    """Return a run folder with a space in its name."""
    folder = tmp_path / "a run"
    write_json(folder / VERSIONS_FILE, {"command": ["train.py", "data.parts=[a,b]"]})
    return folder


def test_the_readme_is_not_written_before_the_run_begins(run, monkeypatch):
    monkeypatch.setattr("sys.argv", ["/somewhere/bin/dopepp", "train", "seed=1"])
    page, path = pages.RunReadme(CONFIG, run), run / pages.README_FILE
    page.end(pages.FAILED, "too early")
    assert not path.exists()
    page.begin()
    assert path.read_text().startswith("# dopepp on hybrid: running\n\nSince ")
    assert f"\ndopepp train resume='{run}'  # continue" in path.read_text()


def test_paths_are_relative_to_the_working_directory(run, monkeypatch):
    assert program.relative_path(run) == str(run)
    monkeypatch.chdir(run.parent)
    assert program.relative_path(run / "x") == "a run/x"


def test_a_failing_readme_does_not_end_the_run(run, caplog):
    (run / pages.README_FILE).mkdir()
    with caplog.at_level(logging.WARNING):
        pages.RunReadme(CONFIG, run).begin()
    assert f"cannot write {run / pages.README_FILE}" in caplog.text


def test_releases_and_rejected_releases(tmp_path, tiny_spec, report_of, monkeypatch):
    checkpoint = Checkpoint(
        tiny_spec, build_network(tiny_spec).state_dict(), [load_part("pivconnector")],
        (64, 64), 8, 1.0, data={"name": "dopepp", "config": {"cache_dir": "/x/y"}},
    )  # fmt: skip
    best, metrics = tmp_path / "best.ckpt", tmp_path / METRICS_FILE
    write_atomic(checkpoint.to_file(), best)
    write_json(metrics, report_of("dopepp", [0.01]).to_record())
    weights, _ = release(best, metrics, "bracket", tmp_path / "released")
    assert read(weights).data["config"]["cache_dir"] is None

    out = tmp_path / "out"
    with pytest.raises(UserError, match=r"name '\.\./x'; allowed: letters"):
        release(best, metrics, "../x", out)
    with pytest.raises(UserError, match=r"other\.json"):
        release(best, tmp_path / "other.json", "x", out)
    torch.save({"a": 1}, tmp_path / "other.ckpt")
    with pytest.raises(UserError, match=r"other\.ckpt"):
        release(tmp_path / "other.ckpt", metrics, "x", out)
    monkeypatch.setattr(pages, "MAX_BYTES", 100)
    with pytest.raises(UserError, match=r"of weights in half precision; allowed: at most 100"):
        release(best, metrics, "x", out)
    assert not out.exists()
