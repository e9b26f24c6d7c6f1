"""Where a run can be cut and taken up again without a trace: Lightning's loop state, made exact.

Lightning counts a batch as begun when it hands it out, an epoch as open until its metrics are
logged, and derives from such differences at which hook a checkpoint was taken. Taken inside a
batch or a validation, and at the end of an epoch, those counters lead to replayed or skipped
batches. The functions here set the counters of a checkpoint to a moment between two batches, at
the beginning of a validation or between two epochs; only these are resumed from.
"""

from __future__ import annotations

from typing import Any, Final

_EPOCHS: Final = "epoch_progress"
_BATCHES: Final = "epoch_loop.batch_progress"
_VALIDATION: Final = "epoch_loop.val_loop.batch_progress"


def before_batch(fit_loop: dict[str, Any]) -> None:
    """Take back the batch that was handed out and has not been trained on."""
    batches = fit_loop[_BATCHES]
    for counter in (batches["total"], batches["current"]):
        counter["ready"] -= 1
    batches["is_last_batch"] = False


def before_validation(fit_loop: dict[str, Any]) -> None:
    """Forget what has been validated: all of the epoch's batches are trained on, none is judged."""
    validation = fit_loop[_VALIDATION]
    # One batch begun and none done is how Lightning tells that a validation was cut off.
    validation["total"].update(ready=1, started=1, processed=0, completed=0)
    validation["current"].update(ready=0, started=0, processed=0, completed=0)
    validation["is_last_batch"] = False


def between_epochs(fit_loop: dict[str, Any]) -> None:
    """Close the epoch: the next one starts with its first batch."""
    epochs = fit_loop[_EPOCHS]
    for counter in (epochs["total"], epochs["current"]):
        counter["completed"] = counter["processed"]
