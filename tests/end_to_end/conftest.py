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


@pytest.fixture
def frame_root(ycb_root, tmp_path):
    """A YCB-Video folder with one real frame that can be damaged, and links to the rest."""
    root = tmp_path / "ycb"
    (root / "data" / "0050").mkdir(parents=True)
    for name in ("models", "image_sets"):
        (root / name).symlink_to(ycb_root / name)
    for path in (ycb_root / "data" / "0050").glob("000003-*"):
        (root / "data" / "0050" / path.name).write_bytes(path.read_bytes())
    return root
