from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from dopepp.data.jobs.job import Job, make_job


@pytest.fixture(scope="session")
def small_job() -> Callable[..., Job]:
    """Make a job of small images, changed as asked."""

    def make(layout: str = "bop", **options: Any) -> Job:
        defaults = {"preset": "quickstart", "size": "32x24", "layout": layout}
        return make_job(["servoholder"], **defaults | options)

    return make


@pytest.fixture(scope="session")
def contents() -> Callable[[Path], dict[str, bytes]]:
    """Read every file of a folder, and every folder as an empty one."""

    def read(root: Path) -> dict[str, bytes]:
        return {
            str(path.relative_to(root)): path.read_bytes() if path.is_file() else b""
            for path in root.rglob("*")
        }

    return read
