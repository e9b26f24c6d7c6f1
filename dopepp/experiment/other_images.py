"""Whether an evaluation measures on the images that the checkpoint's run was measured on."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from typing import Any, Final

from dopepp.experiment.chosen_data import trained_on
from dopepp.experiment.images import describe_images, differing_images
from dopepp.experiment.options import below, flat
from dopepp.experiment.sources import build_test_source
from dopepp.models.checkpoint import Checkpoint
from dopepp.parts.part import Part

_log = logging.getLogger(__name__)

_DECIDE_TEST: Final = (
    "format", "root", "objects", "parts", "unit", "frames", "image_sets", "virtual",
    "num_test", "eval_seed", "test.renderer", "targets", "classes",
)  # fmt: skip
"""Data options that name a test set; the others cannot mean another one."""


def warn_of_other_images(
    checkpoint: Checkpoint, data: Mapping[str, Any], parts: Sequence[Part], seed: int
) -> None:
    """Say it in one line where figures are not comparable with the checkpoint's own.

    Two things are: a test set that has changed although its configuration is the checkpoint's, and
    an object of another shape than the one trained on, whatever the test set. Another test set,
    chosen by its configuration, is as its user wants it.

    Args:
        checkpoint: What is measured.
        data: The data config of the evaluation.
        parts: The checkpoint's objects as these data have them.
        seed: Of renders.
    """
    pairs = zip(checkpoint.parts, parts, strict=True)
    others = [a.name for a, b in pairs if a.mesh_hash and b.mesh_hash not in ("", a.mesh_hash)]
    if others:
        _log.warning("the checkpoint was trained on another shape of %s", ", ".join(others))
    stored, config = checkpoint.data.get("images"), trained_on(checkpoint.data)
    if not isinstance(stored, dict) or config is None:
        return  # a checkpoint of an earlier version does not say
    if _test_set(config) != _test_set(data):
        return
    found = differing_images(stored["test"], describe_images(build_test_source(data, parts, seed)))
    if found:
        _log.warning(
            "the test images are not those of the checkpoint's own figures, "
            "though their configuration is the same: %s",
            "; ".join(found),
        )


def _test_set(data: Mapping[str, Any]) -> dict[str, object]:
    return {
        key: value for key, value in flat(data) if value is not None and below(key, _DECIDE_TEST)
    }
