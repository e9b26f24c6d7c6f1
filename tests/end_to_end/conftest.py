"""A tiny training, its finished run, and the places where runs leave their files."""

import shutil
from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def tiny(tiny_options):
    return (*tiny_options, "trainer.log_every_n_steps=1")


@pytest.fixture(scope="session")
def find_run():
    def find(output_dir: Path) -> Path:
        (versions,) = output_dir.glob("**/versions.json")
        return versions.parent

    return find


@pytest.fixture(scope="session")
def trained(call, find_run, tiny, tmp_path_factory):
    """The folder and the output of one tiny training."""
    output_dir = tmp_path_factory.mktemp("outputs")
    done = call("train.py", *tiny, f"output_dir={output_dir}", code=0)
    return find_run(output_dir), done


@pytest.fixture
def run(trained, tmp_path):
    """A finished run of one epoch of two steps, moved into this test's own folder."""
    folder = trained[0]
    copy = tmp_path / "outputs" / folder.parent.name / folder.name
    shutil.copytree(folder, copy)
    return copy
