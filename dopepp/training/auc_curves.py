"""The validation's accuracy-threshold curves (paper Fig. 4), as a picture and as numbers."""

from __future__ import annotations

from pathlib import Path

from lightning.pytorch import Callback, LightningModule, Trainer

from dopepp.drawing.curves import save_accuracy_curves
from dopepp.drawing.png import figure_image
from dopepp.training.pictures import dispensable, log_picture
from dopepp.training.pose_metrics import PoseMetricsCallback


class AUCCurves(Callback):
    """Writes ``val_auc.png`` and ``val_auc.csv`` after every validation and logs the picture.

    Must stand after :class:`PoseMetricsCallback`, whose errors it draws.
    """

    def on_validation_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Draw one curve per object; every process takes part in gathering the errors."""
        metrics = next(
            callback.metrics
            for callback in trainer.callbacks  # type: ignore[attr-defined]
            if isinstance(callback, PoseMetricsCallback)
        )
        curves = {name: metrics.errors(name) for name in metrics.parts}
        if trainer.sanity_checking or not trainer.is_global_zero:
            return
        title = f"validation, epoch {trainer.current_epoch}"
        folder = Path(trainer.default_root_dir)
        with dispensable(f"{folder}/val_auc"):
            figure = save_accuracy_curves(folder / "val_auc", curves, title=title)
            log_picture(trainer, "val/auc", figure_image(figure))
