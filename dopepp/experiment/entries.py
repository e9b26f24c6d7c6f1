"""The two entry points: ``train.py`` or ``dopepp train``, ``evaluate.py`` or ``dopepp evaluate``.

What takes long to import is imported once a job has its folder and has said so.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

from hydra import version

# hydra.main reads sys.argv itself, where `dopepp train` has a word more than Hydra knows.
from hydra._internal.utils import _run_hydra, get_args_parser
from omegaconf import DictConfig

from dopepp.core.files import CONF
from dopepp.experiment.command_line import EVALUATION_SHORT_NAMES, SHORT_NAMES, entry, run_job
from dopepp.experiment.sweep import remote


def train(config: DictConfig) -> float | None:
    """Run one job and return what a search maximises."""
    return run_job(config, _train)


def evaluate(config: DictConfig) -> None:
    """Run one evaluation."""
    run_job(config, _evaluate)


def _train(config: Mapping[str, Any], run_dir: Path) -> object:
    from dopepp.experiment.run.train import do_job

    remote.quiet_lightning()
    return do_job(config, run_dir)


def _evaluate(config: Mapping[str, Any], run_dir: Path) -> object:
    from dopepp.experiment.run.evaluate import evaluate as measure

    remote.quiet_lightning()
    return measure(config, run_dir)


_ENTRIES: Final = {
    "train": (train, ["virtual.scene"], SHORT_NAMES),
    "evaluate": (evaluate, ["data", "virtual"], EVALUATION_SHORT_NAMES),
}
"""By name: what Hydra calls, nodes that take keys which ``conf/`` does not name, short names."""


def start(name: str, num_words: int = 1) -> None:
    """Run ``train`` or ``evaluate`` as the command line says, and exit with its code.

    Its first ``num_words`` words are the program: ``train.py``, or ``dopepp train``.
    """
    task, open_nodes, short_names = _ENTRIES[name]

    def main() -> None:
        version.setbase("1.3")
        parser = get_args_parser()
        _run_hydra(
            args=parser.parse_args(sys.argv[num_words:]),
            args_parser=parser,
            task_function=task,
            config_path=str(CONF),
            config_name=name,
        )

    entry(main, open_nodes, short_names, num_words)
