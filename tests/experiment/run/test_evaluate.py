from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from dopepp.core.errors import UserError
from dopepp.experiment.assembly.build_sources import held_out_source
from dopepp.experiment.config.data_config import evaluation_data, stored_config
from dopepp.experiment.config.run_config import FalsePositiveTarget
from dopepp.experiment.results.folder import METRICS_FILE, read_json
from dopepp.experiment.results.recording import made_worse
from dopepp.experiment.run.evaluate import tune_and_record
from dopepp.metrics.pose import PoseMetrics
from dopepp.models.checkpoint import read
from dopepp.models.storage import write_atomic
from dopepp.parts.catalogue import pivconnector

NETWORK = "ckpt_path=pretrained/pivconnector"


def test_refined_poses_are_measured_in_addition(evaluate, tmp_path):
    network, refined = evaluate(NETWORK, "refine=region", "+data.num_test=8")
    assert (network.name, refined.name) == ("dopepp_fast", "dopepp_fast + region")
    before, after = network.errors["pivconnector"], refined.errors["pivconnector"]
    result = np.isfinite(before)
    assert result.sum() >= 5
    # The distance may stay off by the scale error that all outlines share.
    assert np.median(after[result]) < 0.6 * np.median(before[result])
    run = tmp_path / "run"
    written = read_json(run / METRICS_FILE)
    assert (written["name"], written["refined"]) == ("dopepp_fast", refined.to_record())
    assert written["made_worse"]["add"] == np.mean((after > before + 0.001)[np.isfinite(after)])
    page, share = (run / "README.md").read_text(), 100 * written["made_worse"]["translation"]
    assert "| pivconnector | dopepp_fast | dopepp_fast + region |" in page
    assert f"{share:.1f} % in translation" in page
    curve = written["refined"]["coverage_curve"]["pivconnector"]
    assert curve["observed"][curve["nominal"].index(0.9)] == refined.mean.coverage
    assert (run / "coverage.png").is_file()


def test_a_small_scale_error_improves_the_distance(evaluate):
    def median_error(scale):
        options = (NETWORK, "refine=region", "+data.num_test=4", "num_pictures=0")
        _, refined = evaluate(*options, f"scale_error={scale}", folder=str(scale))
        return np.nanmedian(refined.errors["pivconnector"])

    assert median_error(0.0001) < 0.8 * median_error(0.05)


def test_made_worse_counts_increases_over_a_millimetre():
    part = pivconnector()

    def measured(*offsets):
        """Return the metrics of poses that are off along z; NaN misses the instance."""
        metrics = PoseMetrics([part])
        for offset in offsets:
            T, estimate = np.eye(4), np.eye(4)
            T[2, 3], estimate[2, 3] = 0.3, 0.3 + offset
            pose = SimpleNamespace(object=part.name, score=1, T_cam_obj=estimate, covariance=None)
            truth = SimpleNamespace(label=part.name, T_cam_obj=T, visible_fraction=1, wanted=None)
            metrics.update([] if np.isnan(offset) else [pose], [truth])
        return metrics

    network = measured(0.002, 0.002, 0.002, np.nan, 0.002)
    refined = measured(0.0029, 0.0031, 0.0001, np.nan, np.nan)
    assert made_worse(network, refined) == pytest.approx({"add": 1 / 3, "translation": 1 / 3})


def test_silent_images_are_counted_by_reason(evaluate, tmp_path, capsys):
    released = read(Path("pretrained/pivconnector"))
    strict = replace(released, recovery={**released.recovery, "min_score": 1.0})
    write_atomic(strict.to_file(), tmp_path / "strict.ckpt")
    evaluate(f"ckpt_path={tmp_path / 'strict.ckpt'}", "+data.num_test=3")
    shown = capsys.readouterr().out.splitlines()
    (line,) = [row for row in shown if "images without detections:" in row]
    assert line.startswith("dopepp_fast: 3 of 3 images without detections: ")
    assert "below the threshold (best score" in line


def test_templates_are_measured_with_a_network(evaluate, tmp_path, near_truth):
    stored = stored_config(read(Path("pretrained/pivconnector")).data)
    data = replace(evaluation_data({}, {}, stored, "the release"), num_test=1)
    sample = held_out_source(data, [pivconnector()], "test").sample(0)
    near_truth.truth = [sample.instances[0].T_cam_obj]
    templates, network = evaluate(NETWORK, "templates=[0.08,0.2]", "+data.num_test=1")
    assert (templates.name, network.name) == ("templates", "dopepp_fast")
    assert templates.errors["pivconnector"] == pytest.approx([0], abs=0.002)
    assert templates.cost.parameters is None
    assert templates.cost.ms_per_frame > 0
    assert read_json(tmp_path / "run" / METRICS_FILE)["name"] == "dopepp_fast"
    assert "templates" in (tmp_path / "run" / "compare.md").read_text()


def test_templates_are_measured_without_a_checkpoint(evaluate, near_truth, capsys):
    (report,) = evaluate(
        "templates=[0.08,0.2]", "data=virtual", "virtual=default", "virtual.preset=quickstart",
        "data.parts=[pivconnector]", "data.num_test=1",
    )  # fmt: skip
    assert (report.name, report.mean.miss_rate) == ("templates", 1)
    assert "images without detections" not in capsys.readouterr().out


def test_detections_on_images_without_the_part_are_counted(evaluate, tmp_path, capsys):
    folder, run = tmp_path / "desk", tmp_path / "run"
    folder.mkdir()
    noise = np.random.default_rng(0).integers(0, 256, (96, 128, 3), np.uint8)
    assert cv2.imwrite(str(folder / "noise.png"), noise)
    (report,) = evaluate(NETWORK, "+data.num_test=1", f"negatives={folder}")
    counts = read_json(run / METRICS_FILE)["without_part"]
    assert counts == report.details["without_part"]
    assert (counts["num_images"], counts["per_image"]) == (1, 0)
    assert "Images without the part" in capsys.readouterr().out
    assert "## Images without the part\n\n| method |" in (run / "README.md").read_text()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ("ckpt_path=x negatives_camera=y", "negatives_camera=y without negatives"),
        ("results=x negatives=y", "negatives=y without ckpt_path"),
        ("results=x scale_factors=2", "shading or scale with results=x, which has no"),
        ("ckpt_path=x scale_error=0.01", "scale_error=0.01 without refine"),
        ("ckpt_path=x refine=region scale_error=0.2", "scale_error=0.2"),
        ("ckpt_path=x tune=true negatives=y", "tune=true with shading, scale, by, neg"),
        ("", "got nothing to evaluate; allowed: one or more of ckpt_path=…"),
        ("results=x.csv", r"x\.csv, which contains no data config; .*data=…"),
        ("results=x.csv data=virtual", r"x\.csv, which contains no options of the renders"),
        ("results=x.csv refine=region", "got refine=region without ckpt_path; .*leave out refine"),
    ],
)
def test_impossible_combinations_of_options(options, message, evaluate, tmp_path):
    with pytest.raises(UserError, match=message):
        evaluate(*options.split())
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(("rate", "lines"), [(0.005, []), (1.0, ["every candidate is reported"])])
def test_a_false_positive_rate_of_one_is_warned_about(monkeypatch, tmp_path, caplog, rate, lines):
    def stop(*_):
        raise InterruptedError

    monkeypatch.setattr("dopepp.experiment.run.evaluate.tune", stop)
    target = FalsePositiveTarget(10, rate)
    with pytest.raises(InterruptedError):
        tune_and_record(SimpleNamespace(), tmp_path, [], SimpleNamespace(), tmp_path, target)
    assert len(caplog.messages) == len(lines)
    assert all(line in message for line, message in zip(lines, caplog.messages, strict=True))
