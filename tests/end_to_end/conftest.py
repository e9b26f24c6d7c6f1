"""Runs of the two commands: as processes of their own, or (ten times faster) inside this one."""

import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any, NamedTuple

import pytest

from dopepp.experiment.train import PAPER_INPUT_SIZE

ROOT = Path(__file__).parents[2]


class Done(NamedTuple):
    """How a command ended, and what it printed."""

    code: int
    out: str
    err: str

    @property
    def last_line(self) -> str:
        """The last line on stderr, which says how it ended."""
        return self.err.rstrip("\n").rpartition("\n")[2]

    @property
    def line(self) -> str:
        """The one line that a user's mistake is told in."""
        assert self.code == 2, f"code {self.code}\n{self.out[-2000:]}\n{self.err[-4000:]}"
        assert "Traceback" not in self.err
        line = self.last_line
        assert line.startswith("got ")
        assert "; allowed: " in line
        assert "; fix: " in line
        return line


@pytest.fixture(scope="session")
def tiny(tiny_options):
    return (*tiny_options, "trainer.log_every_n_steps=1")


@pytest.fixture(scope="session")
def call(in_process):
    """Run ``train.py`` or ``evaluate.py`` in this process.

    What a full-size network costs is measured at ``paper_size``.
    """

    def run(script: str, *arguments: str, paper_size: tuple[int, int] = (64, 64)) -> Done:
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr("dopepp.experiment.train.PAPER_INPUT_SIZE", paper_size)
            return Done(*in_process(ROOT / script, *arguments))

    return run


@pytest.fixture(scope="session")
def start(tmp_path_factory):
    """Start a script of the project as a process, in a folder that is not the project's."""
    folder = tmp_path_factory.mktemp("cwd")
    offline = {"WANDB_MODE": "offline", "WANDB_DIR": str(folder), "WANDB_SILENT": "true"}
    # A service that a run inside this process has started would be used by its children, too.
    own = {name: value for name, value in os.environ.items() if name != "WANDB_SERVICE"}
    usual = {**own, **offline, "OMP_NUM_THREADS": "1", "PYTHONPATH": str(ROOT)}

    def begin(script: str, *arguments: str, **options: Any) -> Any:
        options["env"] = usual | options.get("env", {})
        streams = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
        command = [sys.executable, str(ROOT / script), *arguments]
        return subprocess.Popen(command, cwd=folder, text=True, **streams | options)

    return begin


@pytest.fixture(scope="session")
def command(start):
    """Run a script of the project as a process."""

    def run(script: str, *arguments: str, timeout: float = 240, **options: Any) -> Done:
        with start(script, *arguments, **options) as process:
            try:
                out, err = process.communicate(timeout=timeout)
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
def trained(call, find_run, tiny, tmp_path_factory):
    """The folder and the output of one tiny training."""
    output_dir = tmp_path_factory.mktemp("outputs")
    done = call("train.py", *tiny, f"output_dir={output_dir}", paper_size=PAPER_INPUT_SIZE)
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
