"""What a run leaves behind so that it can be understood and repeated."""

from __future__ import annotations

import json
import platform
import subprocess
import sys
from collections.abc import Mapping
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, Final

import torch
import yaml

import dopepp
from dopepp.drawing.png import write_whole
from dopepp.errors import UserError
from dopepp.training.checkpoints import BEST, FOLDER, LAST

CONFIG_FILE: Final = "config.yaml"
VERSIONS_FILE: Final = "versions.json"
METRICS_FILE: Final = "metrics.json"
FAILURE_FILE: Final = "failed.json"
OVERRIDES_FILE: Final = Path(".hydra", "resume.json")
BEST_CHECKPOINT: Final = Path(FOLDER, BEST)
LAST_CHECKPOINT: Final = Path(FOLDER, LAST)

_PACKAGES: Final = (
    "torch", "lightning", "torchmetrics", "hydra-core", "omegaconf", "numpy", "scipy", "numba",
    "opencv-python-headless", "trimesh", "manifold3d",
)  # fmt: skip


def write_config(run_dir: Path, config: Mapping[str, Any]) -> None:
    """Write the resolved config."""
    text = yaml.safe_dump(dict(config), sort_keys=False, allow_unicode=True)
    write_whole(run_dir / CONFIG_FILE, text.encode())


def write_json(path: Path, record: Mapping[str, Any]) -> None:
    """Write a record as JSON, whole; values JSON has no word for are an error."""
    write_whole(path, (json.dumps(record, indent=2, allow_nan=False) + "\n").encode())


def read_json(path: Path) -> dict[str, Any]:
    """Read a JSON record of a run folder.

    Raises:
        UserError: The file is missing or no JSON object.
    """
    try:
        record = json.loads(path.read_text())
    except (OSError, ValueError) as error:
        raise UserError(
            f"{path}, unreadable: {error}", "a file written by a run", "check the run folder"
        ) from error
    if not isinstance(record, dict):
        raise UserError(f"{path} with a {type(record).__name__}", "a JSON object", "check the file")
    return record


def environment(seed: int, data_fingerprint: str) -> dict[str, Any]:
    """Describe program, packages, working tree, hardware, seed and data."""
    return {
        "dopepp": dopepp.__version__,
        "python": platform.python_version(),
        "platform": platform.platform(),
        "packages": {name: _version(name) for name in _PACKAGES},
        "git": _git_state(),
        "hardware": {
            "processor": platform.processor() or platform.machine(),
            "threads": torch.get_num_threads(),
            "gpus": [torch.cuda.get_device_name(i) for i in range(torch.cuda.device_count())],
        },
        "command": [Path(sys.argv[0]).name, *sys.argv[1:]],
        "seed": seed,
        "data_fingerprint": data_fingerprint,
    }


def _version(package: str) -> str | None:
    try:
        return version(package)
    except PackageNotFoundError:
        return None


def _git_state() -> dict[str, Any] | None:
    """Return the commit the package was run from and whether files differ; None outside git."""
    folder = Path(dopepp.__file__).parent

    def git(*arguments: str) -> str:
        return subprocess.run(
            ["git", "-C", str(folder), *arguments],
            check=True, capture_output=True, text=True, timeout=10,
        ).stdout.strip()  # fmt: skip

    try:
        return {"commit": git("rev-parse", "HEAD"), "dirty": bool(git("status", "--porcelain"))}
    except (OSError, subprocess.SubprocessError):
        return None
