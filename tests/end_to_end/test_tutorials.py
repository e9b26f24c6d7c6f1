"""The tutorials run as typed, in an empty folder, one block of commands after the other."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
TUTORIALS = (
    "quickstart", "my_camera", "stl_in_a_minute", "compare_two_networks", "simulated_grasp",
)  # fmt: skip


def commands(page: str) -> list[str]:
    """Return the bash blocks of a tutorial, without installations and the reader's own photo."""
    text = (ROOT / "docs" / "tutorials" / f"{page}.md").read_text(encoding="utf-8")
    blocks = re.findall(r"^```bash\n(.*?)^```", text, re.MULTILINE | re.DOTALL)
    runnable = [re.sub(r"^pip install [^&\n]*(&& )?", "", block, flags=re.M) for block in blocks]
    return [block for block in runnable if block.strip() and "photo.png" not in block]


@pytest.mark.slow
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("page", TUTORIALS)
def test_a_tutorial_runs_as_typed(page, tmp_path):
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    environment = {**os.environ, "PATH": path, "PYTHONPATH": str(ROOT)}
    for name in ("train.py", "evaluate.py"):
        (tmp_path / name).symlink_to(ROOT / name)
    for block in commands(page):
        done = subprocess.run(
            ["bash", "-ec", block], cwd=tmp_path, env=environment, capture_output=True, text=True
        )
        assert done.returncode == 0, f"{block}\n{done.stdout[-2000:]}\n{done.stderr[-2000:]}"


def test_every_tutorial_has_commands():
    for page in TUTORIALS:
        assert commands(page), page
