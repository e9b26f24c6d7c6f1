"""Steps whose loss or gradient is not finite change nothing, and too many of them end the run.

Whether a step is taken must be known before it is taken, so the processor waits for the device once
per optimiser step: three numbers, as often as torch's own gradient scaler does it.
"""

from __future__ import annotations

import logging
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import torch
from jaxtyping import Bool
from lightning.pytorch import Callback, LightningModule, Trainer
from torch import Tensor
from torch.optim import Optimizer

from dopepp.core.checks import check_integer
from dopepp.core.errors import RunError
from dopepp.core.files import write_png
from dopepp.data.batch import Batch
from dopepp.drawing.overlay import GREEN, Wireframe, overlay
from dopepp.drawing.sheet import Tile, contact_sheet
from dopepp.models.storage import write_atomic

_log = logging.getLogger(__name__)

FOLDER: Final = "nonfinite"
"""Where in the run folder the batch that ended a run is left."""

_MAX_IN_A_ROW: Final = 10**6
_MAX_TILES: Final = 64
_CHECKED: Final = ("loss", "gradient", "batch norm's statistics")
"""What is looked at after every backward pass, in this order."""


@dataclass
class _Pass:
    """One forward and backward pass, and what of it is not finite (as ``_CHECKED``)."""

    batch: Batch
    loss: Tensor
    bad: Bool[Tensor, "checked"]


class FiniteSteps(Callback):
    """Leaves out every optimiser step whose loss or gradient is not finite on any process.

    Weights, the optimiser's state and batch norm's statistics then stay as they were; the step
    counts as one, so the schedule goes on as planned. With accumulation the whole step is left out.
    Gradients that only overflow because mixed precision scales them are its scaler's own business:
    they are neither counted nor reported. ``train/skipped_steps`` counts over the whole run. After
    ``max_in_a_row`` such steps one after the other the run ends, and leaves the last of their
    batches in the run folder's ``nonfinite/``.
    """

    def __init__(self, max_in_a_row: int = 10) -> None:
        self.max_in_a_row = check_integer("max_in_a_row", max_in_a_row, 1, _MAX_IN_A_ROW)
        self.skipped = self.in_a_row = 0
        self._passes: list[_Pass] = []
        self._buffers: list[Tensor] = []
        self._kept: list[Tensor] = []

    def state_dict(self) -> dict[str, Any]:
        """Return the count of the whole run."""
        return {"skipped": self.skipped}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Go on counting."""
        self.skipped = int(state_dict["skipped"])

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Find what a forward pass changes: batch norm's statistics."""
        self._passes = []
        self._buffers = list(pl_module.buffers())
        self._kept = [buffer.clone() for buffer in self._buffers]

    def on_train_batch_start(
        self, trainer: Trainer, pl_module: LightningModule, batch: Batch, batch_idx: int
    ) -> None:
        """Keep the statistics as they are before a step's first pass."""
        self._batch = batch
        if not self._passes and self._buffers:
            torch._foreach_copy_(self._kept, self._buffers)

    def on_before_backward(
        self, trainer: Trainer, pl_module: LightningModule, loss: Tensor
    ) -> None:
        """Remember the loss, which is multiplied by the scaler's factor where there is one."""
        self._loss = loss.detach()

    def on_after_backward(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Look at the pass without waiting for the device."""
        gradients = [p.grad for p in pl_module.parameters() if p.grad is not None]
        statistics = [buffer for buffer in self._buffers if buffer.is_floating_point()]
        tensors = gradients, statistics
        norms = [torch.nn.utils.get_total_norm(one).to(self._loss) for one in tensors]
        bad = ~torch.stack([self._loss, *norms]).isfinite()
        self._passes.append(_Pass(self._batch, self._loss, bad))

    def on_before_optimizer_step(
        self, trainer: Trainer, pl_module: LightningModule, optimizer: Optimizer
    ) -> None:
        """Leave the step out if any process had a pass that was not finite.

        One too many, or weights that are not finite, are a ``RunError``.
        """
        passes, self._passes = self._passes, []
        bad = torch.stack([one.bad for one in passes]).sum(dim=0)
        if trainer.world_size > 1:
            torch.distributed.all_reduce(bad)
        what = [name for name, count in zip(_CHECKED, bad.tolist(), strict=True) if count > 0]
        if not what:
            self.in_a_row = 0
            return
        scaler = getattr(trainer.precision_plugin, "scaler", None)
        if scaler is not None and what == ["gradient"] and scaler.get_scale() >= 1:
            return
        if self._buffers:
            torch._foreach_copy_(self._buffers, self._kept)
        # A scaler has already seen what is wrong with the gradient, and leaves the step out itself.
        if scaler is None or "gradient" not in what:
            optimizer.zero_grad(set_to_none=True)
        self.skipped += 1
        self.in_a_row += 1
        self._report(trainer, pl_module, passes, what)

    def on_train_batch_end(self, trainer: Trainer, pl_module: LightningModule, *_: Any) -> None:
        """Log the count."""
        pl_module.log("train/skipped_steps", float(self.skipped), rank_zero_only=False)

    def _report(
        self, trainer: Trainer, pl_module: LightningModule, passes: list[_Pass], what: list[str]
    ) -> None:
        """Say which step was left out, or end the run."""
        said = f"{' and '.join(what)} not finite in step {trainer.global_step}"
        broken = not all_finite(pl_module.parameters())
        if self.in_a_row < self.max_in_a_row and not broken:
            if trainer.is_global_zero:
                _log.warning(
                    "%s: the step is left out (%d in a row; at %d the run ends)",
                    said, self.in_a_row, self.max_in_a_row,
                )  # fmt: skip
            return
        where = self._dump(trainer, passes, what)
        reason = "the weights are not finite" if broken else f"{self.in_a_row} steps in a row"
        raise RunError(f"{said} ({reason}): the run ends; its batch is in {where}")

    def _dump(self, trainer: Trainer, passes: list[_Pass], what: list[str]) -> Path:
        """Write the first pass that was not finite, on every process that had one; return where.

        Gradients are summed over the processes, so where they alone are wrong, all have one.
        """
        folder = Path(trainer.default_root_dir) / FOLDER
        own = [one for one in passes if one.bad.any()]
        if "loss" in what:
            own = [one for one in own if one.bad[0]]
        if own:
            facts: dict[str, Any] = {"step": trainer.global_step, "epoch": trainer.current_epoch}
            facts |= {"not_finite": what, "loss": float(own[0].loss)}
            name = f"step_{trainer.global_step}_rank_{trainer.global_rank}"
            dump_batch(folder / name, own[0].batch, facts)
        return folder


def dump_batch(path: Path, batch: Batch, facts: Mapping[str, Any]) -> None:
    """Write ``path.pt`` and ``path.png``; a disk that takes neither is reported, not raised.

    The file is a mapping of the facts, plain values, and of the batch's fields, and loads under
    ``weights_only=True``.
    """
    try:
        write_atomic({**facts, **vars(batch.to("cpu"))}, path.with_name(f"{path.name}.pt"))
        write_png(path.with_name(f"{path.name}.png"), contact_sheet(_tiles(batch)))
    except OSError as error:
        _log.warning("the batch could not be written to %s: %s", path.parent, error)


def _tiles(batch: Batch) -> list[Tile]:
    shown = batch.rows(torch.arange(min(len(batch), _MAX_TILES))).to("cpu")
    images, truths = shown.images.permute(0, 2, 3, 1).numpy(), shown.keypoints.numpy()
    return [
        Tile(overlay(image, [Wireframe(points, GREEN, "true") for points in keypoints]), key)
        for image, keypoints, key in zip(images, truths, shown.keys, strict=True)
    ]


def all_finite(tensors: Iterable[Tensor]) -> bool:
    """Tell whether every number is finite; waits for the device once."""
    flags = [tensor.isfinite().all() for tensor in tensors if tensor.is_floating_point()]
    return not flags or bool(torch.stack(flags).all())


def check_state(checkpoint: Mapping[str, Any]) -> None:
    """Refuse, with a ``RunError``, to save weights or an optimiser's state that are not finite."""
    state = {name: checkpoint.get(name) for name in ("state_dict", "optimizer_states")}
    for name, value in state.items():
        if not all_finite(_tensors(value)):
            what = "the weights" if name == "state_dict" else "the optimiser's state"
            step = checkpoint.get("global_step")
            raise RunError(f"{what} not finite after step {step}: nothing was saved, the run ends")


def _tensors(value: object) -> Iterator[Tensor]:
    if isinstance(value, Tensor):
        yield value
    elif isinstance(value, Mapping):
        for item in value.values():
            yield from _tensors(item)
    elif isinstance(value, (list, tuple)):
        for item in value:
            yield from _tensors(item)
