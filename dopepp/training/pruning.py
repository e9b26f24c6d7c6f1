"""A training as one trial of a study: what it reports after each validation, and when it stops.

The study is a database that all its trials write to, in this process or on another machine; its
objective is the value that the best checkpoint is chosen by.
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

_WAIT_S: Final = 60  # How long a trial waits for others to finish writing to an SQLite file
MOST: Final = 10**6  # Above any number of trials or epochs that means something


class PrunedError(Exception):
    """A trial was stopped because it was worse than the others; no failure."""


class TrialReport(Callback):
    """Reports the objective after each validation and stops a trial that is not worth finishing.

    Optuna's median rule: a trial is stopped when its best value so far is worse than the median of
    the other trials' values at the same epoch, once ``after_trials`` are finished, and not in its
    first ``after_epochs``. The storage is an SQLite file or a database URL, ``monitor`` the logged
    value that is the objective. ``pruned`` is why training was stopped, empty where it was not.
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
        self._place, self._name = storage, study
        self._after_trials = check("search.prune_after_trials", after_trials, int, Range(1, MOST))
        self._after_epochs = check("search.prune_after_epochs", after_epochs, int, Range(0, MOST))

    def setup(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:
        """Find the trial in its study."""
        import optuna

        optuna.logging.set_verbosity(optuna.logging.WARNING)
        pruner = optuna.pruners.MedianPruner(self._after_trials, self._after_epochs)
        self._storage = open_storage(self._place)
        self._study = optuna.load_study(study_name=self._name, storage=self._storage, pruner=pruner)
        study_id = self._storage.get_study_id_from_name(self._name)
        find = self._storage.get_trial_id_from_study_id_trial_number
        self._trial_id = find(study_id, self.number)

    def on_validation_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Report this epoch's value; one that goes on after an interruption repeats itself."""
        value = trainer.callback_metrics.get(self.monitor)
        if value is None or not math.isfinite(value):
            return
        epoch = trainer.current_epoch
        self._storage.set_trial_intermediate_value(self._trial_id, epoch, float(value))
        last = trainer.max_epochs is not None and epoch + 1 >= trainer.max_epochs
        trial = self._storage.get_trial(self._trial_id)
        if self.prune and not last and self._study.pruner.prune(self._study, trial):
            self.pruned = (
                f"after epoch {epoch}, whose {self.monitor} of {float(value):.4g} is worse "
                "than the other trials' median"
            )
            trainer.should_stop = True


def raise_if_pruned(trainer: Trainer) -> None:
    """Raise :class:`PrunedError`, which says why, if training was stopped early."""
    for callback in trainer.callbacks:  # type: ignore[attr-defined]
        if isinstance(callback, TrialReport) and callback.pruned:
            raise PrunedError(callback.pruned)


def open_storage(place: str) -> BaseStorage:
    """Open or create the database of a study; a :class:`UserError` where that fails."""
    from optuna.exceptions import StorageInternalError
    from optuna.storages import RDBStorage
    from sqlalchemy.exc import SQLAlchemyError

    try:
        if "://" in place:
            return RDBStorage(place)
        path = Path(place)
        path.parent.mkdir(parents=True, exist_ok=True)
        # Absolute, because a job may run in another folder.
        url = f"sqlite:///{path.absolute()}"
        return RDBStorage(url, engine_kwargs={"connect_args": {"timeout": _WAIT_S}})
    except (OSError, ImportError, RuntimeError, SQLAlchemyError, StorageInternalError) as error:
        got = f"search.storage={place}, which cannot be opened: {error}"
        allowed = "a file of an Optuna study or a place for one, or a database URL"
        raise UserError(got, allowed, "choose another search.storage") from error
