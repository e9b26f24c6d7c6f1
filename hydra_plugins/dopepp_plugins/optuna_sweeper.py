"""``search=optuna``: a sweeper whose jobs are the trials of a study."""

from __future__ import annotations

from typing import Any

from hydra.plugins.launcher import Launcher
from hydra.plugins.sweeper import Sweeper
from hydra.types import HydraContext, TaskFunction
from omegaconf import DictConfig


class OptunaSweeper(Sweeper):
    """Hands a search to :func:`dopepp.experiment.sweep.optuna_search.search`.

    ``params`` are what an experiment wants to sweep over; a search takes its ``space`` alone.
    """

    config: DictConfig
    launcher: Launcher

    def __init__(self, params: DictConfig | None = None) -> None:
        self.params = params

    def setup(
        self, *, hydra_context: HydraContext, task_function: TaskFunction, config: DictConfig
    ) -> None:
        """Take what Hydra hands to every sweeper, and prepare the chosen launcher."""
        from hydra.core.plugins import Plugins

        self.loader, self.config = hydra_context.config_loader, config
        self.launcher = Plugins.instance().instantiate_launcher(
            hydra_context=hydra_context, task_function=task_function, config=config
        )

    def sweep(self, arguments: list[str]) -> Any:
        """Search until the study has its trials."""
        from dopepp.core.errors import require

        require("optuna", "search=optuna", "search")
        from dopepp.experiment.sweep.optuna_search import search

        return search(self.config, self.loader, self.launcher, arguments, list(self.params or ()))
