"""Pictures to whichever logger can take them, and to files that a run can do without."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
from jaxtyping import UInt8
from lightning.pytorch import Trainer

from dopepp.training.loggers import GuardedLogger

_log = logging.getLogger(__name__)


def log_picture(trainer: Trainer, name: str, image: UInt8[np.ndarray, "height width 3"]) -> None:
    """Hand an RGB picture to TensorBoard and Weights & Biases where they are on."""
    for logger in trainer.loggers:
        if isinstance(logger, GuardedLogger):
            logger.log_picture(name, image, trainer.global_step)


@contextmanager
def dispensable(what: str) -> Iterator[None]:
    """Report it in a line where a file cannot be written, and go on."""
    try:
        yield
    except OSError as error:
        _log.warning("cannot write %s: %s", what, error.strerror or error)
