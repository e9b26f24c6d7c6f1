"""Names of the files in a run folder, and the files that make a run repeatable."""

from __future__ import annotations

import json
import os
import platform
import subprocess
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from functools import cache
from importlib.metadata import distributions
from pathlib import Path
from typing import Any, Final

import torch
import yaml

import dopepp
from dopepp.core.errors import UserError
from dopepp.core.files import write_file
from dopepp.core.json import read_json as read_strict_json
from dopepp.core.pool import cpu_fact
from dopepp.experiment import program
from dopepp.training.run_checkpoints import BEST, FOLDER, LAST
from dopepp.virtual.factory import code_hash

CONFIG_FILE: Final = "config.yaml"
VERSIONS_FILE: Final = "versions.json"
METRICS_FILE: Final = "metrics.json"
FAILURE_FILE: Final = "failed.json"
PRUNED_FILE: Final = "pruned.json"
COST_FILE: Final = "cost.json"
OBJECTIVE: Final = "objective"
"""Key of ``metrics.json``: validation value by which the best checkpoint was selected."""
OVERRIDES_FILE: Final = Path(".hydra", "resume.json")
# Files of a run folder that are written before the work begins.
OF_THE_START: Final = frozenset({".hydra", CONFIG_FILE, VERSIONS_FILE, "README.md"})
BEST_CHECKPOINT: Final = Path(FOLDER, BEST)
LAST_CHECKPOINT: Final = Path(FOLDER, LAST)

_MAX_UNTRACKED: Final = 100


def write_config(run_dir: Path, config: Mapping[str, Any]) -> None:
    """Write the resolved config as ``config.yaml``."""
    text = yaml.safe_dump(dict(config), sort_keys=False, allow_unicode=True)
    write_file(run_dir / CONFIG_FILE, text.encode())


def write_json(path: Path, record: Mapping[str, Any]) -> None:
    """Write a record as JSON atomically; non-finite numbers are an error."""
    write_file(path, (json.dumps(record, indent=2, allow_nan=False) + "\n").encode())


def read_json(path: Path) -> dict[str, Any]:
    """Read a JSON object of a run folder."""
    allowed, fix = "a JSON object written by a run", "run the training or the evaluation again"
    try:
        record = read_strict_json(path)
    except UserError as error:
        raise UserError(f"{error.got}, which cannot be read", allowed, fix) from error
    if not isinstance(record, dict):
        raise UserError(f"{path}, which contains a {type(record).__name__}", allowed, fix)
    return record


def read_end(run: Path) -> tuple[str, dict[str, Any]]:
    """Return the name and the content of the file that a run wrote at its end; empty without it."""
    for name in (FAILURE_FILE, PRUNED_FILE, METRICS_FILE, COST_FILE):
        if (run / name).is_file():
            return name, read_json(run / name)
    return "", {}


def write_environment(
    run_dir: Path, seed: int, data_fingerprint: str, changes: Sequence[str] = ()
) -> None:
    """Write the :func:`environment` of a run to ``versions.json``, and keep earlier entries.

    ``changes`` are those of the config since the run began or was last resumed.
    """
    path = run_dir / VERSIONS_FILE
    earlier: list[object] = []
    if path.is_file():
        latest = read_json(path)
        earlier = [*latest.pop("earlier", []), latest]
    present = environment(seed, data_fingerprint)
    write_json(path, {**present, "changes": list(changes), "earlier": earlier})


def environment(seed: int, data_fingerprint: str) -> dict[str, Any]:
    """Return time, command, versions, git state, hardware, seed and data hash as JSON values."""
    gpus = map(torch.cuda.get_device_properties, range(torch.cuda.device_count()))
    is_posix = hasattr(os, "sysconf")
    memory_bytes = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") if is_posix else None
    return {
        "dopepp": dopepp.__version__,
        "time": datetime.now(UTC).isoformat(timespec="seconds"),
        "python": platform.python_version(),
        "platform": platform.platform(),
        "packages": _packages(),
        "git": _git_state(),
        "hardware": {
            "processor": cpu_fact("model name") or platform.processor() or platform.machine(),
            "cores": os.cpu_count(),
            "threads": torch.get_num_threads(),
            "memory_bytes": memory_bytes,
            "gpus": [{"name": gpu.name, "memory_bytes": gpu.total_memory} for gpu in gpus],
            "cuda": torch.version.cuda,
        },
        "command": program.command(),
        "seed": seed,
        "data_fingerprint": data_fingerprint,
        "rendering_code": code_hash(),
    }


@cache
def _packages() -> dict[str, str]:
    headers = (package.metadata for package in distributions())  # parsed at every access
    versions = [(header["Name"], header["Version"]) for header in headers if "Name" in header]
    return dict(sorted(versions, key=lambda version: version[0].lower()))


def _git(*arguments: str) -> bytes | None:
    """Run git in the folder of the package; return its output, or None if git fails."""
    command = ["git", "-C", str(Path(dopepp.__file__).parent), *arguments]
    try:
        return subprocess.run(command, check=True, capture_output=True, timeout=10).stdout
    except (OSError, subprocess.SubprocessError):
        return None


def _git_state() -> dict[str, Any] | None:
    """Return commit, dirty flag and untracked files of the repository; None outside git."""
    # A package that is installed inside another repository is outside git.
    is_part = _git("ls-files", "--error-unmatch", "__init__.py") is not None
    commit, status = _git("rev-parse", "HEAD"), _git("status", "--porcelain")
    if not is_part or commit is None or status is None:
        return None
    lines = status.decode(errors="replace").splitlines()
    untracked = [line[3:] for line in lines if line.startswith("??")]
    return {
        "commit": commit.decode().strip(),
        "dirty": bool(lines),
        "untracked": untracked[:_MAX_UNTRACKED],
    }
