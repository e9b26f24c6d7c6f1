"""Reports of a training run to a hyperparameter study, and pruning of poor trials.

The study is a database to which all trials write, also from other machines. A study's objective is
the value that selects the best checkpoint.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Final

from lightning.pytorch import Callback, LightningModule, Trainer

from dopepp.core.errors import UserError
from dopepp.core.validation import Range, check

if TYPE_CHECKING:
    from optuna import Study
    from optuna.storages import BaseStorage

_WAIT_S: Final = 60  # Timeout of locks on an SQLite file
MOST: Final = 10**6  # Maximum number of trials or epochs


class PrunedError(Exception):
    """A trial of a study was stopped because other trials are better; not a failure."""


class TrialReport(Callback):
    """Reports the objective of a trial to its study after each validation and stops poor trials.

    Optuna's median rule stops a trial whose best value is worse than the median of the other
    trials' values at the same epoch. ``storage`` is an SQLite file or a database URL, ``monitor``
    the logged objective. No trial is stopped before ``after_trials`` have finished, or before its
    own epoch ``after_epochs``. ``pruned`` is the reason for stopping, or empty.
    """

    _study: Study

    def __init__(
        self,
        storage: str,
        study: str,
        number: int,
        monitor: str,
        prune: bool,
        after_trials: int,
        after_epochs: int,
    ) -> None:
        self.monitor, self.number, self.prune, self.pruned = monitor, number, prune, ""
        self._location, self._name = storage, study
        self._after_trials = check("search.prune_after_trials", after_trials, int, Range(1, MOST))
        self._after_epochs = check("search.prune_after_epochs", after_epochs, int, Range(0, MOST))

    def setup(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:
        """Load the study and find the trial's id in its database."""
        import optuna

        optuna.logging.set_verbosity(optuna.logging.WARNING)
        pruner = optuna.pruners.MedianPruner(self._after_trials, self._after_epochs)
        self._storage = open_storage(self._location)
        self._study = optuna.load_study(study_name=self._name, storage=self._storage, pruner=pruner)
        study_id = self._storage.get_study_id_from_name(self._name)
        self._trial_id = self._storage.get_trial_id_from_study_id_trial_number(
            study_id, self.number
        )

    def on_validation_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Report a finite ``monitor`` value of the epoch, and stop the training of a poor trial."""
        value = trainer.callback_metrics.get(self.monitor)
        if value is None or not math.isfinite(value):
            return
        if trainer.is_global_zero:
            self.pruned = self._report(trainer, float(value))
        # Another trial may report between the decisions of two processes.
        self.pruned = trainer.strategy.broadcast(self.pruned)
        trainer.should_stop = trainer.should_stop or bool(self.pruned)

    def _report(self, trainer: Trainer, value: float) -> str:
        """Report a value of the epoch; return why the trial stops, or an empty text."""
        epoch = trainer.current_epoch
        self._storage.set_trial_intermediate_value(self._trial_id, epoch, value)
        last = trainer.max_epochs is not None and epoch + 1 >= trainer.max_epochs
        trial = self._storage.get_trial(self._trial_id)
        if not self.prune or last or not self._study.pruner.prune(self._study, trial):
            return ""
        return (
            f"after epoch {epoch}, whose {self.monitor} of {value:.4g} is worse "
            "than the other trials' median"
        )


def raise_if_pruned(trainer: Trainer) -> None:
    """Raise a :class:`PrunedError` if a :class:`TrialReport` has stopped the training."""
    for callback in trainer.callbacks:  # type: ignore[attr-defined]
        if isinstance(callback, TrialReport) and callback.pruned:
            raise PrunedError(callback.pruned)


def open_storage(location: str) -> BaseStorage:
    """Open or create the database of a study: an SQLite file or a database URL."""
    from optuna.exceptions import StorageInternalError
    from optuna.storages import RDBStorage
    from sqlalchemy.exc import SQLAlchemyError

    try:
        if "://" in location:
            return RDBStorage(location)
        path = Path(location)
        path.parent.mkdir(parents=True, exist_ok=True)
        # The path is made absolute, because jobs may run in other folders.
        url = f"sqlite:///{path.absolute()}"
        return RDBStorage(url, engine_kwargs={"connect_args": {"timeout": _WAIT_S}})
    except (OSError, ImportError, RuntimeError, SQLAlchemyError, StorageInternalError) as error:
        problem = f"search.storage={location}, which cannot be opened: {error}"
        allowed = "an existing or new file of an Optuna study, or a database URL"
        raise UserError(problem, allowed, "set search.storage to such a file or URL") from error
