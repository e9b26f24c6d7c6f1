"""What a run writes down of what it is made with, and what it keeps of that."""

import hashlib
import subprocess

import pytest

import dopepp
from dopepp.experiment.results.folder import (
    VERSIONS_FILE,
    environment,
    read_json,
    write_environment,
)
from dopepp.virtual.factory import code_hash


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
    write_environment(tmp_path / "clean", 7, "abc")
    state = read_json(tmp_path / "clean" / VERSIONS_FILE)["git"]
    assert (state["dirty"], state["untracked"], len(state["commit"])) == (False, [], 40)

    (tree / "dopepp" / "__init__.py").write_text("one = 2\n")
    (tree / "new.py").write_text("")
    write_environment(tmp_path / "dirty", 7, "abc")
    state = read_json(tmp_path / "dirty" / VERSIONS_FILE)["git"]
    assert (state["dirty"], state["untracked"]) == (True, ["new.py"])
    diff = tmp_path / "dirty" / state["diff"]
    assert hashlib.sha256(diff.read_bytes()).hexdigest() == state["diff_sha256"]
    # It gives back what was run.
    git("checkout", "-q", ".")
    git("apply", str(diff))
    assert (tree / "dopepp" / "__init__.py").read_text() == "one = 2\n"


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


def test_packages_hardware_and_code():
    facts = environment(7, "abc")
    assert facts["rendering_code"] == code_hash()
    assert {"torch", "lightning", "numpy", "hydra-core"} <= set(facts["packages"])
    assert all(facts["packages"].values())
    assert facts["hardware"]["cores"] >= facts["hardware"]["threads"] >= 1
    assert facts["hardware"]["processor"]
    assert facts["hardware"]["memory_bytes"] > 2**28
