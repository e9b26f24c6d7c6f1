"""Time of a command until its first output and until its end, relative to importing PyTorch.

python benchmarks/startup.py
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import NamedTuple

ROOT, REPEAT = Path(__file__).parents[1], 3
DOPEPP = [
    sys.executable,
    "-c",
    "import sys; sys.argv[0] = 'dopepp'; from dopepp.cli import app; app()",
]
PREDICT = [*DOPEPP, "predict", "pretrained/pivconnector"]
K = ["--K", "128", "128", "63.5", "63.5"]


class Start(NamedTuple):
    """Wall time until the first line and until the end, and CPU time, seconds."""

    first: float
    end: float
    cpu: float


def start(command: list[str], folder: Path, until_first: bool) -> Start:
    """Run a command, and with ``until_first`` kill it after its first line."""
    begun = time.perf_counter()
    streams = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT}
    process = subprocess.Popen(command, cwd=folder, **streams)
    assert process.stdout is not None
    process.stdout.readline()
    first = time.perf_counter() - begun
    if until_first:
        process.kill()
    process.stdout.read()
    usage = os.wait4(process.pid, 0)[2]
    return Start(first, time.perf_counter() - begun, usage.ru_utime + usage.ru_stime)


def imports(code: str, folder: Path) -> dict[str, float]:
    """Return the seconds of the six packages with the longest imports, by name."""
    command = [sys.executable, "-X", "importtime", "-c", code]
    lines = subprocess.run(command, cwd=folder, capture_output=True, text=True).stderr.splitlines()
    seconds: dict[str, float] = {}
    for line in lines:
        fields = line.removeprefix("import time:").split("|")
        if len(fields) == 3 and fields[0].strip().isdigit():
            package = fields[2].strip().partition(".")[0]
            seconds[package] = seconds.get(package, 0.0) + int(fields[0]) / 1e6
    return dict(sorted(seconds.items(), key=lambda item: -item[1])[:6])


def main() -> None:
    """Print a row per command, then the packages with the longest imports of a prediction."""
    folder = Path(tempfile.mkdtemp())
    os.environ["PYTHONPATH"] = str(ROOT)
    render = ["render", "pivconnector", "--preset", "quickstart", "-n", "1", "--out", "data"]
    subprocess.run([*DOPEPP, *render], cwd=folder, check=True, capture_output=True)
    (image,) = map(str, (folder / "data").glob("**/rgb/*.*"))
    commands = {
        "import torch": ([sys.executable, "-c", "import torch; print(1)"], False),
        "dopepp --version": ([*DOPEPP, "--version"], False),
        "dopepp train sed=1 (a typo)": ([*DOPEPP, "train", "sed=1"], False),
        "dopepp train": ([*DOPEPP, "train", "experiment=quickstart"], True),
        "dopepp predict": ([*PREDICT, image, *K], False),
        "dopepp predict --refine region": ([*PREDICT, image, *K, "--refine", "region"], False),
    }
    torch_s = 0.0
    print(f"{'':34}first line s    end s    CPU s   CPU / import torch")
    for name, (command, until_first) in commands.items():
        runs = [start(command, folder, until_first) for _ in range(REPEAT)]
        first, end, cpu = (min(values) for values in zip(*runs, strict=True))
        torch_s = torch_s or cpu
        print(f"{name:34}{first:12.2f}{end:9.2f}{cpu:9.2f}{cpu / torch_s:12.2f}")
    print("imports of dopepp.inference.estimator, seconds without nested imports:")
    for package, seconds in imports("import dopepp.inference.estimator", folder).items():
        print(f"  {package:20}{seconds:.2f}")


if __name__ == "__main__":
    main()
