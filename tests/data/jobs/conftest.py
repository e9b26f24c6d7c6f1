from __future__ import annotations

from collections.abc import Callable
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
