"""Runs of the two commands: as processes of their own, or (ten times faster) inside this one."""

from __future__ import annotations

import contextlib
import io
import os
import runpy
import shutil
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import pytest

from dopepp.experiment.train import PAPER_INPUT_SIZE

ROOT = Path(__file__).parents[2]
TINY = (
    "data=virtual",
    "data.parts=[pivconnector]",
    "virtual.preset=quickstart",
    "data.input_size=[64,64]",
    "data.samples_per_epoch=8",
    "data.batch_size=4",
    "data.num_val=2",
    "data.num_test=3",
    "data.num_workers=0",
    "model.width=0.0625",
    "trainer.max_epochs=1",
    "trainer.log_every_n_steps=1",
)


@dataclass
class Done:
    """How a command ended, and what it printed."""

    code: int
    out: str
    err: str

    @property
    def line(self) -> str:
        """The one line that a user's mistake is told in."""
        assert self.code == 2, f"code {self.code}\n{self.out[-2000:]}\n{self.err[-4000:]}"
        assert "Traceback" not in self.err
        line = self.err.rstrip("\n").rpartition("\n")[2]
        assert line.startswith("got ")
        assert "; allowed: " in line
        assert "; fix: " in line
        return line


@pytest.fixture(scope="session")
def tiny():
    return TINY


def environment(folder: Path) -> dict[str, str]:
    offline = {"WANDB_MODE": "offline", "WANDB_DIR": str(folder), "WANDB_SILENT": "true"}
    # A service that a run inside this process has started would be used by its children, too.
    own = {name: value for name, value in os.environ.items() if name != "WANDB_SERVICE"}
    return {**own, **offline, "OMP_NUM_THREADS": "1", "PYTHONPATH": str(ROOT)}


def in_process(script: str, *arguments: str, paper_size: tuple[int, int] = (64, 64)) -> Done:
    """Run an entry point inside this process, as ``python script arguments``.

    What a full-size network costs is measured at ``paper_size``.
    """
    out, err = io.StringIO(), io.StringIO()
    code: object = 0
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", [str(ROOT / script), *arguments])
        patch.setenv("HYDRA_FULL_ERROR", "1")  # the entry point sets it: undone here
        patch.setattr("dopepp.experiment.train.PAPER_INPUT_SIZE", paper_size)
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            try:
                runpy.run_path(str(ROOT / script), run_name="__main__")
            except SystemExit as end:
                code = end.code
    return Done(
        int(code or 0) if isinstance(code, int | None) else 1, out.getvalue(), err.getvalue()
    )


@pytest.fixture(scope="session")
def call():
    """Run ``train.py`` or ``evaluate.py`` in this process."""
    return in_process


@pytest.fixture(scope="session")
def start(tmp_path_factory):
    """Start ``train.py`` or ``evaluate.py`` as a process, in a folder that is not the project's."""
    folder = tmp_path_factory.mktemp("cwd")

    def begin(script: str, *arguments: str) -> subprocess.Popen[str]:
        return subprocess.Popen(
            [sys.executable, str(ROOT / script), *arguments],
            cwd=folder,
            env=environment(folder),
            text=True,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
        )

    return begin


@pytest.fixture(scope="session")
def command(start):
    """Run ``train.py`` or ``evaluate.py`` as a process."""

    def run(script: str, *arguments: str) -> Done:
        with start(script, *arguments) as process:
            try:
                out, err = process.communicate(timeout=240)
            except subprocess.TimeoutExpired:
                process.kill()
                raise
        return Done(process.returncode, out, err)

    return run


@pytest.fixture(scope="session")
def find_run():
    def find(output_dir: Path) -> Path:
        (versions,) = output_dir.glob("**/versions.json")
        return versions.parent

    return find


@pytest.fixture(scope="session")
def trained(find_run, tmp_path_factory):
    """The folder and the output of one tiny training."""
    output_dir = tmp_path_factory.mktemp("outputs")
    done = in_process("train.py", *TINY, f"output_dir={output_dir}", paper_size=PAPER_INPUT_SIZE)
    assert done.code == 0, done.err[-4000:]
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
