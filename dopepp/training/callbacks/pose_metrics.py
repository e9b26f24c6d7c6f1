"""Validation in poses, and the end of a training whose validation no longer improves.

Poses are recovered from the maps and go into the accumulator that every evaluation uses. To log
another metric, a field of :class:`~dopepp.metrics.row.PoseRow` and its name in :data:`LOGGED`.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Any, Final

from lightning.pytorch import Callback, LightningModule, Trainer
from lightning.pytorch.callbacks import EarlyStopping

from dopepp.data.batch import Batch
from dopepp.data.sample import Instance
from dopepp.metrics.pose import MEAN, PoseMetrics
from dopepp.metrics.row import PoseRow
from dopepp.parts.part import Part
from dopepp.training.system import PoseSystem, ValidationOutput

LOGGED: Final = (
    "add_01d", "add_s_01d", "pass_5cm", "pass_10cm", "auc_10cm", "auc_s_10cm", "ar_mssd",
    "ar_mspd", "median_rotation_deg", "median_rotation_s_deg", "miss_rate",
)  # fmt: skip
_OF_MATCHES: Final = ("median_rotation_deg", "median_rotation_s_deg")
"""These do not exist where nothing was found."""


class PoseMetricsCallback(Callback):
    """Logs the pose metrics of every validation as ``val/<metric>``, averaged over objects.

    ``val/selection`` is what the best checkpoint is chosen by: the mean over objects of the exact
    AUC up to 0.1 m, of ADD, or of ADD-S for an object with symmetries ("ADD(-S)").

    The metrics stay readable on :attr:`metrics` for callbacks further down the list.
    """

    metrics: PoseMetrics

    def setup(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:
        """Prepare an accumulator for the system's parts."""
        assert isinstance(pl_module, PoseSystem)
        self.metrics = PoseMetrics(pl_module.parts)

    def on_validation_epoch_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Start counting anew, on the device that gathers across processes."""
        self.metrics.to(pl_module.device).reset()

    def on_validation_batch_end(  # type: ignore[override]
        self, trainer: Trainer, system: PoseSystem, outputs: ValidationOutput, batch: Batch, *_: Any
    ) -> None:
        """Recover the batch's poses and compare them with its instances."""
        detections = system.recover(outputs, batch)
        truths = batch_instances(batch, system.parts)
        width = batch.images.shape[-1]
        cameras = batch.K.double().cpu().numpy()
        for found, instances, K in zip(detections, truths, cameras, strict=True):
            self.metrics.update(found, instances, K, width)

    def on_validation_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Log the mean over objects; what does not exist (nothing matched) is left out."""
        rows = self.metrics.compute()
        values = {name: getattr(rows[MEAN], name) for name in LOGGED}
        values["selection"] = _selection([row for name, row in rows.items() if name != MEAN])
        for name, value in values.items():
            # A selection needs a number even where no object was in the validation images.
            if value is None and name not in _OF_MATCHES:
                value = math.nan
            if value is not None:
                on_bar = name == "add_01d"
                pl_module.log(f"val/{name}", float(value), prog_bar=on_bar, rank_zero_only=False)


def _selection(rows: Sequence[PoseRow]) -> float | None:
    areas = [row.auc_s_10cm if row.num_symmetries > 1 else row.auc_10cm for row in rows]
    known = [area for area in areas if area is not None]
    return sum(known) / len(known) if known else None


def batch_instances(batch: Batch, parts: tuple[Part, ...]) -> Iterator[list[Instance]]:
    """Yield each image's ground truth in the form that samples have."""
    index = batch.object_index.cpu().numpy()
    poses, keypoints = batch.T_cam_obj.double().cpu().numpy(), batch.keypoints.cpu().numpy()
    visible = batch.visible_fraction.cpu().numpy()
    for row in range(len(batch)):
        yield [
            Instance(parts[c].name, poses[row, n], keypoints[row, n], float(visible[row, n]))
            for n, c in enumerate(index[row])
            if c >= 0
        ]


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
