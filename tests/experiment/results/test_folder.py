"""What a run writes down of what it is made with, and what it keeps of that."""

import subprocess

import pytest

import dopepp
from dopepp.experiment.results.folder import (
    VERSIONS_FILE,
    environment,
    read_json,
    write_environment,
)


@pytest.fixture
def working_tree(tmp_path, monkeypatch):
    """A repository whose package stands for this one, and git in it."""
    tree = tmp_path / "tree"
    (tree / "dopepp").mkdir(parents=True)
    (tree / "dopepp" / "__init__.py").write_text("one = 1\n")
    monkeypatch.setattr(dopepp, "__file__", str(tree / "dopepp" / "__init__.py"))

    def git(*arguments: str) -> None:
        who = ["-c", "user.name=A", "-c", "user.email=a@example.org"]
        subprocess.run(["git", "-C", str(tree), *who, *arguments], check=True, capture_output=True)

    git("init", "-q")
    return tree, git


def test_the_state_of_the_working_tree(working_tree, tmp_path):
    tree, git = working_tree
    # Installed below somebody's own repository, the package is no part of it.
    write_environment(tmp_path / "installed", 7, "abc")
    assert read_json(tmp_path / "installed" / VERSIONS_FILE)["git"] is None
    git("add", ".")
    git("commit", "-qm", "Begin")
    (tree / "new.py").write_text("")
    state = environment(7, "abc")["git"]
    assert (state["dirty"], state["untracked"], len(state["commit"])) == (True, ["new.py"], 40)
    (tree / "new.py").unlink()
    assert not environment(7, "abc")["git"]["dirty"]


def test_a_resumed_run_keeps_its_earlier_environments(tmp_path):
    for seed, changes in ((1, []), (2, ["seed: 1 → 2"]), (3, ["seed: 2 → 3", "a: b → c"])):
        write_environment(tmp_path, seed, f"data{seed}", changes)
    written = read_json(tmp_path / VERSIONS_FILE)
    assert (written["seed"], written["data_fingerprint"]) == (3, "data3")
    assert written["changes"] == ["seed: 2 → 3", "a: b → c"]
    assert [(record["seed"], record["changes"]) for record in written["earlier"]] == [
        (1, []), (2, ["seed: 1 → 2"]),
    ]  # fmt: skip
    assert all("earlier" not in item for item in written["earlier"])
