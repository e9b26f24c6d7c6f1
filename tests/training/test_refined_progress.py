"""The measurement of refined poses during a training, with an estimator of true poses."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from dopepp.core.files import read_csv
from dopepp.data.rendered import RenderedSource
from dopepp.drawing.pictures import read_rgb
from dopepp.geometry.camera import crop_camera
from dopepp.inference.estimator import PoseEstimator
from dopepp.metrics.functional import wilson_interval
from dopepp.metrics.pose import PoseMetrics
from dopepp.recovery.detection import Detection
from dopepp.training import refined_progress
from dopepp.training.refined_progress import NUM_CONFIRMING, NUM_IMAGES, RefinedProgress
from dopepp.virtual.factory import Factory
from dopepp.virtual.presets import PRESETS


class TruePoses:
    """Returns the true pose of every image, 5 cm off for the image numbers that are ``wrong``."""

    def __init__(self, images, wrong):
        self.images, self.wrong, self.count = images, wrong, 0

    def predict(self, image, K, cropped):
        (instance,) = self.images.sample(self.count).instances
        T = instance.T_cam_obj.copy()
        T[0, 3] += 0.05 * self.wrong(self.count)
        self.count += 1
        peaks = np.full((9, 2), np.nan)
        return [Detection(instance.label, 0.9, 0.9, T, peaks, peaks, 0.0, None)]


class Repeated(list):
    """A source that repeats one render."""

    name = "repeated"

    def sample(self, index, epoch=0):
        return self[index]


@pytest.fixture(scope="session")
def images(part):
    factory = Factory([part], PRESETS["quickstart"], seed=0)
    return Repeated([RenderedSource(factory, 1, "val").sample(0)] * 120)


@pytest.fixture
def measure(monkeypatch, make_trainer, make_system, make_noise, images, tmp_path):
    """Fit with a measurement after every validation; return the callback, trainer and estimator."""

    def measure(wrong, epochs=1, **options):
        known = TruePoses(images, wrong)
        monkeypatch.setattr(RefinedProgress, "_estimator", lambda self, system: known)
        progress = RefinedProgress(images, "region", **options)
        trainer = make_trainer(tmp_path, [progress], max_epochs=epochs)
        trainer.fit(make_system(), make_noise())
        return progress, trainer, known

    return measure


def test_share_precision_and_interval_are_reported_and_drawn(measure, tmp_path, capsys):
    progress, trainer, known = measure(lambda number: number % 4 == 0)
    ((minutes, share, low, high),) = progress.curve
    assert known.count == NUM_IMAGES
    assert share == pytest.approx(0.75)
    assert (low, high) == pytest.approx(wilson_interval(30, 40))
    assert 0 < minutes < 5
    shown = capsys.readouterr().out
    assert "75 % of 40 parts refined and reported within 0.1 d" in shown
    assert "precision 75 %" in shown
    assert "stop_at" not in shown
    (row,) = [row for row in read_csv(tmp_path / "metrics.csv") if row.get("val/refined")]
    values = [float(row[name]) for name in ("val/refined", "val/refined_precision")]
    assert values == pytest.approx([0.75, 0.75])
    assert read_rgb(tmp_path / "refined.png").std() > 10
    assert not trainer.should_stop


def test_a_reached_goal_is_confirmed_on_more_images(measure, capsys):
    _, trainer, known = measure(lambda number: number >= NUM_IMAGES, epochs=3, stop_at=0.9)
    assert known.count == NUM_CONFIRMING  # the other validations were too early for a measurement
    assert trainer.current_epoch == 3
    assert "40 % of 100 parts" in capsys.readouterr().out


def test_the_goal_ends_the_training(measure, capsys):
    _, trainer, _ = measure(lambda number: number == 0, epochs=5, stop_at=0.95)
    assert trainer.current_epoch == 1
    assert "99 % of 100 parts" in (shown := capsys.readouterr().out)
    assert "stop_at=0.95 is reached" in shown


def test_the_time_between_measurements_has_a_minimum(measure, monkeypatch):
    monkeypatch.setattr(refined_progress, "MAX_SHARE", 1e9)
    progress, _, known = measure(lambda number: False, epochs=3, every_s=0.0)
    assert (len(progress.curve), known.count) == (3, 3 * NUM_IMAGES)
    minutes = [point[0] for point in progress.curve]
    assert minutes == sorted(minutes)
    progress, _, _ = measure(lambda number: False, epochs=3, every_s=1e6)
    assert len(progress.curve) == 1
    monkeypatch.setattr(refined_progress, "MAX_SHARE", 1e-9)  # a measurement takes too long
    progress, _, _ = measure(lambda number: False, epochs=3, every_s=0.0)
    assert len(progress.curve) == 1


def test_a_resumed_training_continues_the_curve(images):
    before = RefinedProgress(images, "region")
    before.on_train_start(None, None)
    before.curve = [(1.0, 0.2, 0.1, 0.3)]
    after = RefinedProgress(images, "region")
    after.load_state_dict({**before.state_dict(), "minutes": 7.0})
    after.on_train_start(None, None)
    assert after.curve == before.curve
    assert after.state_dict()["minutes"] == pytest.approx(7.0, abs=0.1)


def test_the_estimator_has_the_networks_present_weights(make_system, images):
    system = make_system()
    estimator = RefinedProgress(images, "region")._estimator(system)
    assert isinstance(estimator, PoseEstimator)
    assert (estimator.refine, estimator.min_score) == ("region", 0.5)
    image = images.sample(0).image
    pixels = torch.from_numpy(np.ascontiguousarray(image.transpose(2, 0, 1)))
    with torch.no_grad():
        expected = [maps[0] for maps in system.network.eval().maps(pixels[None])]
    torch.testing.assert_close(list(estimator.maps(image)), expected, atol=1e-4, rtol=1e-7)


def test_images_may_be_crops(make_system, images):
    sample, system = images.sample(0), make_system()
    off_centre = replace(sample, K=crop_camera(sample.K, 0.3 * sample.image.shape[1], 0))
    progress = RefinedProgress(Repeated([off_centre]), "region")
    measured = progress._measure(progress._estimator(system), PoseMetrics(system.parts), 0, 1)
    assert measured[1] == 1


def test_all_instances_have_equal_weights(part, images):
    other = replace(part, name="other")
    (instance,) = images.sample(0).instances
    both = [instance, replace(instance, label="other")]
    samples = Repeated(
        [replace(images.sample(0), instances=both if k == 0 else both[:1]) for k in range(10)]
    )
    estimator = SimpleNamespace(
        predict=TruePoses(Repeated([images.sample(0)] * 10), lambda n: False).predict
    )
    progress = RefinedProgress(samples, "region")
    share, count, _ = progress._measure(estimator, PoseMetrics([part, other]), 0, 10)
    assert (share, count) == (pytest.approx(10 / 11), 11)


@pytest.mark.slow
@pytest.mark.ddp
def test_two_processes_stop_together(command, tmp_path):
    """The processes have two and one validation batches."""
    done = command(
        "train.py", "experiment=quickstart", "trainer=ddp", "trainer.accelerator=cpu", "stop_at=0",
        "data.samples_per_epoch=16", "data.batch_size=2", "data.num_val=5", "data.num_test=2",
        "data.num_workers=0", "tune=false", f"hydra.run.dir={tmp_path / 'run'}",
        timeout=240, code=0,
    )  # fmt: skip
    assert done.out.count("stop_at=0 is reached") == 1
    epochs = {row["epoch"] for row in read_csv(tmp_path / "run" / "metrics.csv")}
    assert epochs - {""} == {"0"}
