"""Five kills at random moments; ``benchmarks/crash.py`` does fifty."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


@pytest.mark.timeout(600)
def test_a_run_killed_five_times_ends_as_one_left_in_peace(tmp_path):
    done = subprocess.run(
        [sys.executable, str(ROOT / "benchmarks" / "crash.py"), "--kills=5", "--epochs=4"],
        cwd=tmp_path,
        env={**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": str(ROOT)},
        text=True,
        capture_output=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout[-4000:] + done.stderr[-4000:]
    assert "5 kills: " in done.stdout
    assert ", 0 lost []" in done.stdout
    assert "differences from the undisturbed run: none" in done.stdout
