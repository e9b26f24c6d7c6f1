import logging
from types import SimpleNamespace
from typing import Any

import pytest

from dopepp.experiment import program
from dopepp.experiment.results import readme
from dopepp.experiment.results.folder import VERSIONS_FILE, write_json

CONFIG: Any = SimpleNamespace(
    model=SimpleNamespace(name="dopepp"),
    data=SimpleNamespace(name="hybrid"),
    trainer=SimpleNamespace(max_epochs=3),
    keep_checkpoints=True,
)


@pytest.fixture
def run(tmp_path):
    """A run's folder, with a blank in its name, that was resumed once."""
    folder = tmp_path / "a run"
    first = {"command": ["train.py", "data.parts=[a,b]"]}
    again = {"command": ["train.py", "resume=RUN"], "earlier": [first]}
    write_json(folder / VERSIONS_FILE, again)
    return folder


def test_every_state_is_told_with_what_to_do(run, monkeypatch):
    monkeypatch.setattr("sys.argv", ["/somewhere/train.py", "seed=1"])
    page = readme.RunReadme(CONFIG, run)
    page.end(readme.FAILED, "too early")
    assert not (run / readme.README_FILE).exists()  # it was never begun
    page.begin()
    text = (run / readme.README_FILE).read_text()
    assert text.startswith("# dopepp on hybrid: running\n\nSince ")
    assert "python train.py 'data.parts=[a,b]'\npython train.py resume=RUN\n" in text
    assert f"python train.py resume='{run}'  # go on" in text
    for state in (readme.INTERRUPTED, readme.FAILED, readme.PRUNED):
        page.end(state, "for a reason")
        text = (run / readme.README_FILE).read_text()
        assert text.startswith(f"# dopepp on hybrid: {state}\n\nfor a reason\n")
        assert "# go on" in text
    (run / "overlay.png").touch()
    page.end(readme.FINISHED)
    text = (run / readme.README_FILE).read_text()
    assert "# go on" not in text
    assert "trainer.max_epochs=6" in text
    assert "](overlay.png)" in text
    assert "](auc.png)" not in text
    monkeypatch.setattr("sys.argv", ["/somewhere/bin/dopepp", "train", "seed=1"])
    page.end(readme.FINISHED)
    assert "\ndopepp train resume=" in (run / readme.README_FILE).read_text()


def test_paths_are_typed_as_from_here(run, monkeypatch):
    assert program.shown(run) == str(run)
    monkeypatch.chdir(run.parent)
    assert program.shown(run / "x") == "a run/x"


def test_a_readme_that_cannot_be_written_ends_no_run(run, caplog):
    (run / readme.README_FILE).mkdir()
    with caplog.at_level(logging.WARNING):
        readme.RunReadme(CONFIG, run).begin()
    assert f"cannot write {run / readme.README_FILE}" in caplog.text


def test_a_sweep_lists_its_jobs(tmp_path):
    command = ["train.py", "-m", "seed=1,2"]
    readme.write_sweep_readme(tmp_path, command, {})
    assert (tmp_path / readme.README_FILE).read_text().startswith("# Multirun: running;")
    readme.write_sweep_readme(tmp_path, command, {"0": "finished", "1": "failed: a | b"})
    text = (tmp_path / readme.README_FILE).read_text()
    assert "python train.py -m seed=1,2" in text
    assert "| job | state |" in text
    assert "| [1](1/) | failed: a \\| b |" in text
