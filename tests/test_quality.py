"""Format, lint, types, import contracts and versions, reached from the one test command."""

import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).parents[1]
SCRIPTS = Path(sys.executable).parent


@pytest.mark.parametrize(
    "command",
    [["ruff", "format", "--check", "."], ["ruff", "check", "."], ["mypy"], ["lint-imports"]],
    ids=["format", "lint", "types", "contracts"],
)
def test_gate(command):
    tool = SCRIPTS / command[0]
    assert tool.exists(), f"{command[0]} is missing: pip install -e '.[dev]'"
    done = subprocess.run([tool, *command[1:]], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr


def test_the_constraints_satisfy_every_requirement():
    lines = (ROOT / "constraints.txt").read_text().splitlines()[1:]
    versions = dict(line.split("==") for line in lines)
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    extras = project["optional-dependencies"]
    mine, *others = map(Requirement, extras["dev"])
    needed = [*project["dependencies"], *(text for name in mine.extras for text in extras[name])]
    for requirement in [*map(Requirement, needed), *others]:
        assert versions[canonicalize_name(requirement.name)] in requirement.specifier
