"""The wheel contains every file that the program reads, and works without the repository."""

import os
import shutil
import subprocess
import sys
import sysconfig
import tomllib
from collections.abc import Callable
from pathlib import Path
from subprocess import CompletedProcess

import pytest
from setuptools import Distribution

import dopepp

ROOT = Path(__file__).parents[1]
COMPILED = shutil.ignore_patterns("__pycache__")


def test_it_contains_every_file_that_the_program_reads(monkeypatch):
    monkeypatch.chdir(ROOT)
    monkeypatch.setattr("setuptools.setup", lambda **options: setup_options.update(options))
    setup_options = {}
    exec((ROOT / "setup.py").read_text(), {})
    build = Distribution({**setup_options, "script_name": "setup.py"}).get_command_obj("build_py")
    build.ensure_finalized()
    built = {str(Path(item).relative_to(build.build_lib)) for item in build.get_outputs(False)}
    sources = {
        path.relative_to(ROOT)
        for folder in ("dopepp", "hydra_plugins", "conf")
        for path in (ROOT / folder).rglob("*")
        if path.is_file() and "__pycache__" not in path.parts
    }
    expected = {str(Path("dopepp", file) if file.parts[0] == "conf" else file) for file in sources}
    assert built == expected
    assert {"dopepp/conf/train.yaml", "dopepp/conf/model/backbone/dsc.yaml"} <= built


def test_the_version_is_defined_once():
    options = tomllib.loads((ROOT / "pyproject.toml").read_text())
    assert options["project"]["dynamic"] == ["version"]
    assert options["tool"]["setuptools"]["dynamic"]["version"] == {"attr": "dopepp.__version__"}


Run = Callable[..., "CompletedProcess[str]"]


@pytest.fixture(scope="module")
def installed(tmp_path_factory):
    """Build the wheel, and install it with this environment's libraries; run it in any folder."""
    base = tmp_path_factory.mktemp("wheel")
    own = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    for name in ("dopepp", "hydra_plugins", "conf"):  # a build leaves its own files in the sources
        shutil.copytree(ROOT / name, base / "sources" / name, ignore=COMPILED)
    for name in ("setup.py", "pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, base / "sources")

    def pip(*arguments):
        command = [sys.executable, "-m", "pip", "--disable-pip-version-check", *arguments]
        subprocess.run(command, check=True, capture_output=True, env=own)

    pip("wheel", f"{base}/sources", "--no-deps", "--no-build-isolation", "-w", str(base))
    (path,) = base.glob("dopepp-*.whl")
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", base / "venv"], check=True)
    python = base / "venv" / "bin" / "python"
    pip("--python", str(python), "install", "--no-deps", "--no-index", str(path))
    (site,) = (base / "venv" / "lib").glob("python*/site-packages")
    # .pth files of this path are not read, so an editable dopepp is not imported.
    (site / "libraries.pth").write_text(sysconfig.get_path("purelib") + "\n")

    def run(*arguments, folder):
        command = [str(base / "venv" / "bin" / "dopepp"), *arguments]
        return subprocess.run(
            command, cwd=folder, env=own | {"WANDB_MODE": "offline"},
            capture_output=True, text=True, timeout=600,
        )  # fmt: skip

    return run


@pytest.mark.slow
def test_a_wheel_trains_and_measures_in_an_empty_folder(installed, tiny_options, tmp_path):
    def run(*arguments, code=0):
        done = installed(*arguments, folder=tmp_path)
        assert done.returncode == code, done.stdout + done.stderr
        return done.stdout + done.stderr

    assert run("--version") == f"dopepp {dopepp.__version__}\n"
    assert "experiment: " in run("train", "--help")
    assert "name: dopepp_fast" in run("train", "--cfg", "job", "model=dopepp_fast")
    assert "nearest seed" in run("train", "sed=1", code=2)
    assert "got mesh none.stl" in run("train", "data=virtual", "data.parts=[none.stl]", code=2)
    assert not list(tmp_path.iterdir()) or not list((tmp_path / "outputs").iterdir())
    shown = run("train", *tiny_options)
    assert "deprecat" not in shown.lower()
    (best,) = tmp_path.glob("outputs/*/*/checkpoints/best.ckpt")
    page = (best.parents[1] / "README.md").read_text()
    assert "```bash\ndopepp train data=virtual" in page
    assert "\ndopepp evaluate ckpt_path=outputs/" in page
    run("evaluate", f"ckpt_path={best.relative_to(tmp_path)}", "data.num_test=1")
    run("train", f"resume={best.parents[1].relative_to(tmp_path)}", "trainer.max_epochs=2")
    run("train", "-m", *tiny_options, "hydra/launcher=joblib", "model/attention=none,se")
    assert len(list(tmp_path.glob("outputs/compare/*/[01]/metrics.json"))) == 2
