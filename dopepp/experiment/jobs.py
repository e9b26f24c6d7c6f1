"""What ``train.py`` can do with a config: ``job=train``, ``job=cost`` or ``job=lr_finder``.

To add a job, write a function of config and run folder and give it a line in :data:`JOBS`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Final

from dopepp.core.errors import UserError
from dopepp.experiment.cost import measure_cost
from dopepp.experiment.lr_finder import find_learning_rate
from dopepp.experiment.reports.paper_table import PaperTable
from dopepp.experiment.train import train

JOBS: Final[Mapping[str, Callable[[dict[str, Any], Path], object]]] = {
    "train": train,
    "cost": measure_cost,
    "lr_finder": find_learning_rate,
}


def do_job(config: dict[str, Any], run_dir: Path) -> object:
    """Do what the config names under ``job``.

    Raises:
        UserError: There is no such job, or it refuses the config.
    """
    job = config["job"]
    if not isinstance(job, str) or job not in JOBS:
        raise UserError(f"job={job!r}", ", ".join(JOBS), "choose one of them")
    if config["table"] is not None:
        PaperTable.of(config["table"])  # a mistake in it shows before the work, not after
    return JOBS[job](config, run_dir)
