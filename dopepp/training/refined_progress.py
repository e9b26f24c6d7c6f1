"""Accuracy of refined poses while the network trains, and a goal that ends the training."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any, Final

import numpy as np
from lightning.pytorch import Callback, LightningModule, Trainer

from dopepp.core.files import write_png
from dopepp.data.sample import SampleSource
from dopepp.drawing.curves import RateCurve, figure_image, rates_figure
from dopepp.inference.network_estimator import NetworkEstimator
from dopepp.inference.refinement.refiner import Refine
from dopepp.metrics.functional import wilson_interval
from dopepp.metrics.pose import MEAN, PoseMetrics
from dopepp.models.checkpoint import parse_description
from dopepp.training.pose_validation import best_effort
from dopepp.training.system import PoseSystem

IMAGE: Final = "refined.png"  # curve in the run folder

NUM_IMAGES: Final = 40
NUM_CONFIRMING: Final = 100  # images on which a reached goal is confirmed
MIN_SCORE: Final = 0.5  # reported poses are more likely correct than incorrect
MAX_SHARE: Final = 0.1  # largest share of the time that measurements take


class RefinedProgress(Callback):
    """Measures the refined poses of the network on full-resolution camera images after validations.

    A measurement is logged as ``val/refined`` and ``val/refined_precision``, printed with its 95 %
    interval, and drawn in ``refined.png`` over the minutes of training. ``val/refined`` is the
    share of instances whose pose has a score of at least ``MIN_SCORE`` and an ADD(-S) below a tenth
    of the diameter.

    The training ends when ``val/refined`` reaches ``stop_at``. If there are more than 40 images,
    the next images, up to number 100, must confirm the share. ``every_s`` is the shortest time
    between two measurements, which take at most a tenth of the time.
    """

    def __init__(
        self,
        images: SampleSource,
        refine: Refine,
        stop_at: float | None = None,
        every_s: float = 120.0,
    ) -> None:
        self.images, self.refine, self.stop_at, self.every_s = images, refine, stop_at, every_s
        self.curve: list[tuple[float, float, float, float]] = []
        """Minutes of training, ``val/refined``, and the ends of its 95 % interval."""
        self._minutes_before, self._begin, self._due = 0.0, 0.0, 0.0

    def state_dict(self) -> dict[str, Any]:
        """Return the points of the curve and the minutes of training."""
        return {"curve": [list(point) for point in self.curve], "minutes": self._minutes()}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore the points of the curve and the minutes of training."""
        self.curve = [tuple(point) for point in state_dict["curve"]]
        self._minutes_before = float(state_dict["minutes"])

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Store the time at which training starts."""
        self._begin = self._due = time.monotonic()

    def on_validation_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Measure if ``every_s`` has passed; stop the training if ``stop_at`` is reached."""
        assert isinstance(pl_module, PoseSystem)
        reached, start = False, time.monotonic()
        if trainer.is_global_zero and not trainer.sanity_checking and start >= self._due:
            reached = self._measure_and_report(trainer, pl_module)
            end = time.monotonic()
            self._due = end + max(self.every_s, (end - start) / MAX_SHARE)
        trainer.should_stop = trainer.should_stop or trainer.strategy.broadcast(reached)

    def _measure_and_report(self, trainer: Trainer, system: PoseSystem) -> bool:
        """Measure refined poses, report the accuracy, and return whether ``stop_at`` is reached."""
        estimator = self._estimator(system)
        # Only rank 0 measures, so metrics are not gathered across processes.
        metrics = PoseMetrics(system.parts, sync_on_compute=False)
        share, count, precision = self._measure(estimator, metrics, 0, NUM_IMAGES)
        has_more = len(self.images) > NUM_IMAGES
        if self.stop_at is not None and share >= self.stop_at and has_more:
            share, count, precision = self._measure(estimator, metrics, NUM_IMAGES, NUM_CONFIRMING)
        low, high = wilson_interval(round(share * count), count)
        minutes = self._minutes()
        self.curve.append((minutes, share, low, high))
        values = {"val/refined": share, "val/refined_precision": precision}
        for logger in trainer.loggers:
            logger.log_metrics(values, trainer.global_step)
        line = (
            f"{minutes:.1f} min: {100 * share:.0f} % of {count} parts refined and reported "
            f"within 0.1 d (95 % interval {100 * low:.0f} – {100 * high:.0f} %), "
            f"precision {100 * precision:.0f} %"
        )
        reached = self.stop_at is not None and share >= self.stop_at
        system.print(f"{line}; stop_at={self.stop_at:g} is reached" if reached else line)
        with best_effort(IMAGE):
            self._draw(Path(trainer.default_root_dir))
        return reached

    def _estimator(self, system: PoseSystem) -> NetworkEstimator:
        checkpoint = parse_description(system.payload)
        network = system.network.for_inference()
        estimator = NetworkEstimator(network, checkpoint, system.device, self.refine, system.parts)
        return estimator.reporting(MIN_SCORE)

    def _measure(
        self, estimator: NetworkEstimator, metrics: PoseMetrics, first: int, end: int
    ) -> tuple[float, int, float]:
        """Add images ``first`` to ``end`` − 1; return recall, number of instances and precision."""
        for index in range(first, min(end, len(self.images))):
            sample = self.images.sample(index)
            poses = estimator.predict(sample.image, sample.K, cropped=True)
            metrics.update(poses, sample.instances, sample.K, sample.image.shape[1])
        rows = metrics.compute()
        mean = rows.pop(MEAN)
        # The mean over objects would weigh an object with few instances like the others.
        hits = sum((row.add_or_s_01d or 0.0) * row.num_instances for row in rows.values())
        count = mean.num_instances
        return hits / count if count else 0.0, count, mean.precision or 0.0

    def _minutes(self) -> float:
        """Return the minutes of training, including interrupted runs."""
        return self._minutes_before + (time.monotonic() - self._begin) / 60

    def _draw(self, folder: Path) -> None:
        x, rate, low, high = np.array(self.curve).T
        panels = {"refined and reported poses": {"ADD(-S)-0.1d": RateCurve(x, rate, low, high)}}
        figure = rates_figure(panels, "minutes of training", columns=1)
        figure.axes[0].set_xlim(0, None)
        write_png(folder / IMAGE, figure_image(figure))
