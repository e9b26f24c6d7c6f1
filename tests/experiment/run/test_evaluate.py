from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from dopepp.experiment.results.folder import METRICS_FILE, read_json
from dopepp.experiment.results.recording import made_worse
from dopepp.experiment.results.report import Cost, Report
from dopepp.experiment.run.evaluate import run_evaluation
from dopepp.models.checkpoint import read, write_atomic


def test_refined_poses_are_measured_beside_the_networks(composed, tmp_path):
    options = ("ckpt_path=pretrained/pivconnector", "refine=region", "+data.num_test=8")
    network, refined = run_evaluation(composed(*options, config="evaluate"), tmp_path)
    assert (network.name, refined.name) == ("dopepp_fast", "dopepp_fast + region")
    before, after = network.errors["pivconnector"], refined.errors["pivconnector"]
    result = np.isfinite(before)
    assert result.sum() >= 5
    assert np.median(after[result]) < np.median(before[result]) / 3
    written = read_json(tmp_path / METRICS_FILE)
    assert (written["name"], written["refined"]) == ("dopepp_fast", refined.to_record())
    assert written["made_worse"] == made_worse(network, refined)
    assert (tmp_path / "compare.csv").is_file()


def test_worse_is_by_more_than_a_millimetre():
    def report(*errors):
        return Report("x", {}, {}, {"a": np.array(errors), "b": np.array([0.01])}, Cost(), 1)

    network = report(0.002, 0.002, 0.002, np.inf)
    refined = report(0.0029, 0.0031, 0.0001, np.inf)
    assert made_worse(network, refined) == pytest.approx(1 / 5)


def test_silent_images_are_counted_by_reason(composed, tmp_path, capsys):
    released = read(Path("pretrained/pivconnector"))
    strict = replace(released, recovery={**released.recovery, "min_score": 1.0})
    write_atomic(strict.to_file(), tmp_path / "strict.ckpt")
    options = (f"ckpt_path={tmp_path / 'strict.ckpt'}", "+data.num_test=3")
    run_evaluation(composed(*options, config="evaluate"), tmp_path / "run")
    (line,) = [row for row in capsys.readouterr().out.splitlines() if "images silent:" in row]
    assert line.startswith("dopepp_fast: 3 of 3 images silent: ")
    assert "below the threshold (best score" in line
