"""Sweeper for ``search=optuna``, whose jobs are the trials of a study."""

from __future__ import annotations

from typing import Any

from hydra.plugins.launcher import Launcher
from hydra.plugins.sweeper import Sweeper
from hydra.types import HydraContext, TaskFunction
from omegaconf import DictConfig


class OptunaSweeper(Sweeper):
    """Call :func:`dopepp.experiment.sweep.optuna_search.search`.

    Args:
        params: Options over which the experiment itself sweeps; a search does not support them.
    """

    config: DictConfig
    launcher: Launcher

    def __init__(self, params: DictConfig | None = None) -> None:
        self.params = params

    def setup(
        self, *, hydra_context: HydraContext, task_function: TaskFunction, config: DictConfig
    ) -> None:
        """Store the arguments that Hydra passes to every sweeper, and build the launcher."""
        from hydra.core.plugins import Plugins

        self.loader, self.config = hydra_context.config_loader, config
        self.launcher = Plugins.instance().instantiate_launcher(
            hydra_context=hydra_context, task_function=task_function, config=config
        )

    def sweep(self, arguments: list[str]) -> Any:
        """Search until the study has all its trials."""
        from dopepp.core.errors import require

        require("optuna", "search=optuna", "search")
        from dopepp.experiment.sweep.optuna_search import search

        return search(self.config, self.loader, self.launcher, arguments, list(self.params or ()))
