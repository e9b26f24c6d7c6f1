"""What a run is taken up from without a trace: the place between two batches, the random states.

Lightning counts a batch as begun when it hands it out, an epoch as open until its metrics are
logged, and derives from such differences at which hook a checkpoint was taken. Taken inside a
batch or a validation, and at the end of an epoch, those counters lead to replayed or skipped
batches. So the counters of a checkpoint are set to a moment between two batches, at the beginning
of a validation or between two epochs; only these are resumed from.
"""

from __future__ import annotations

import random
from typing import Any, Final

import numpy as np
import torch

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


def capture() -> dict[str, Any]:
    """Return the states of Python's, NumPy's and torch's generators, as tensors and numbers."""
    version, numbers, gauss = random.getstate()
    _, keys, position, has_gauss, cached = np.random.get_state(legacy=True)  # noqa: NPY002
    return {
        "python": [version, list(numbers), gauss],
        "numpy": [torch.tensor(np.asarray(keys, np.int64)), int(position), int(has_gauss)],
        "numpy_gauss": float(cached),
        "torch": torch.get_rng_state(),
        "cuda": torch.cuda.get_rng_state_all() if torch.cuda.is_available() else [],
    }


def restore(state: dict[str, Any]) -> None:
    """Set the generators to captured states; those of GPUs only where there are as many."""
    version, numbers, gauss = state["python"]
    random.setstate((version, tuple(numbers), gauss))
    keys, position, has_gauss = state["numpy"]
    generator = ("MT19937", keys.numpy().astype(np.uint32), position, has_gauss)
    np.random.set_state((*generator, state["numpy_gauss"]))  # noqa: NPY002
    torch.set_rng_state(state["torch"].cpu())
    if torch.cuda.is_available() and len(state["cuda"]) == torch.cuda.device_count():
        torch.cuda.set_rng_state_all([one.cpu() for one in state["cuda"]])
