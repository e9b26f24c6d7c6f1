"""``job=cost``: counts of an untrained network, and times from image to poses."""

import json

import numpy as np
import pandas as pd
import pytest
import torch

from dopepp.data.sample import DescribedSource
from dopepp.drawing.pictures import read_rgb
from dopepp.experiment.assembly.build_parts import build_parts
from dopepp.experiment.assembly.build_sources import held_out_source
from dopepp.experiment.assembly.build_system import build_untrained
from dopepp.experiment.config.run_config import RunConfig
from dopepp.experiment.results.cost import (
    WARM_UP,
    SimulatedMapsEstimator,
    likely_maps,
    measure_cost,
    time_frames,
)
from dopepp.geometry.camera import transform
from dopepp.maps.codec import MapGeometry

SMALL = ("scale=laptop", "data.input_size=[32,32]", "cost.num_frames=4", "cost.batch_size=2")


def test_counts_match_the_paper_and_times_are_written(parsed, tmp_path, capsys):
    config = parsed("experiment=table4_parameters", *SMALL, "model.width=1", "job=cost")
    cost = measure_cost(config, tmp_path)
    assert torch.is_grad_enabled()  # as before
    assert (cost.backbone_weights, cost.input_size) == (1_107_776, (32, 32))
    assert cost.picture_size == (128, 128)  # the quickstart's own
    frames = pd.read_csv(tmp_path / "frames.csv")
    assert len(frames) == 4
    assert (frames[["network_seconds", "recovery_seconds"]] > 0).all(axis=None)
    assert (frames.seconds >= frames.network_seconds + frames.recovery_seconds).all()
    record = json.loads((tmp_path / "cost.json").read_text())
    assert record["parameters"] == cost.parameters
    assert record["frames_per_s"] > 0
    medians = [
        1000 * frames[c].median() for c in ("seconds", "network_seconds", "recovery_seconds")
    ]
    stated = [record[field] for field in ("ms_per_frame", "network_ms", "recovery_ms")]
    assert stated == pytest.approx(medians, rel=1e-2)
    assert "maps to poses" in capsys.readouterr().out
    assert read_rgb(tmp_path / "frame_rate.png").std() > 0


def estimator_of(config: RunConfig) -> tuple[SimulatedMapsEstimator, MapGeometry, DescribedSource]:
    parts = build_parts(config.data)
    network, description = build_untrained(config, parts)
    geometry = MapGeometry(network.stride, config.maps.sigma, config.maps.field_radius)
    source = held_out_source(config.data, parts, "test")
    return SimulatedMapsEstimator(network, description), geometry, source


def test_likely_maps_yield_the_poses_of_the_image(parsed):
    """Recovery then needs as much time as with a trained network."""
    config = parsed("scale=laptop", "model.width=0.0625", "virtual.preset=wide")
    estimator, geometry, source = estimator_of(config)
    samples, passes = [source.sample(index) for index in range(8)], []
    estimator.network.register_forward_hook(lambda *_: passes.append(1))
    times = time_frames(estimator, samples, geometry, num_frames=2, seed=0)
    assert len(passes) == WARM_UP + 2
    assert (times.seconds > times.network_seconds).all()
    (part,) = estimator.parts

    def is_right(sample):
        estimator.answer = likely_maps(sample, estimator, geometry, torch.Generator())
        truth = transform(sample.instances[0].T_cam_obj, part.points)
        best = estimator.predict(sample.image, sample.K)[:1]
        errors = [transform(detection.T_cam_obj, part.points) - truth for detection in best]
        return any(np.linalg.norm(e, axis=1).mean() < 0.1 * part.diameter for e in errors)

    assert sum(map(is_right, samples)) >= 7


@pytest.mark.parametrize("size", ["[128,128]", "[96,64]"])
def test_likely_maps_have_the_shape_of_the_networks_maps(parsed, size):
    """Images are padded to the multiple that the network needs, not to the whole input size."""
    config = parsed(
        "scale=laptop", "model.width=0.0625", "virtual.preset=paper", f"data.input_size={size}",
        "data.parts=[servoholder,pivconnector]",
    )  # fmt: skip
    estimator, geometry, source = estimator_of(config)
    sample, own = source.sample(0), []
    estimator.answer = likely_maps(sample, estimator, geometry, torch.Generator())
    estimator.network.register_forward_hook(lambda *args: own.append(args[-1][-1]))
    estimator.predict(sample.image, sample.K)
    ((belief, field),) = own
    assert [item.shape for item in estimator.answer] == [belief[0].shape, field[0].shape]
