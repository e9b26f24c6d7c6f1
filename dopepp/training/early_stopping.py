"""The end of a training whose validation no longer improves."""

from __future__ import annotations

from typing import Any

from lightning.pytorch import LightningModule, Trainer
from lightning.pytorch.callbacks import EarlyStopping


class EarlyStop(EarlyStopping):
    """Lightning's callback, made fit for runs that go on.

    The patience is always the present one, not the saved one; and a run that has stopped does not
    train further, unless it now has more patience.
    """

    @property
    def impatient(self) -> bool:
        """Whether there were as many validations without an improvement as there may be."""
        return bool(self.wait_count >= self.patience)

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Go on counting."""
        super().load_state_dict({**state_dict, "patience": self.patience})

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """End at once what has ended before."""
        if self.impatient:
            trainer.should_stop = True
