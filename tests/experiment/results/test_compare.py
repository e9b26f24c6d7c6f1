"""Comparisons: run folders, seeds and parts of a method, differences and written files.

Tables and sentences are compared to the character in ``test_golden.py``.
"""

from dataclasses import replace
from itertools import product
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

from dopepp.core.errors import UserError
from dopepp.core.files import read_csv
from dopepp.experiment.results.compare import (
    compare_paths,
    compare_reports,
    compare_runs,
    image_tiles,
    read_log_column,
)
from dopepp.experiment.results.compared_runs import Entry, find_runs, group, read_run, with_refined
from dopepp.experiment.results.differences import (
    compact_table,
    comparison_values,
    differences,
    full_table,
)
from dopepp.experiment.results.folder import (
    CONFIG_FILE,
    COST_FILE,
    METRICS_FILE,
    write_config,
    write_json,
)
from dopepp.experiment.results.report import Report
from dopepp.metrics.pose import MEAN
from tests.experiment.conftest import report_of, write_run

GOOD, BAD = [0.005] * 30 + [np.inf] * 2, [0.004] * 10 + [0.02] * 20 + [np.inf] * 2
BEST = [0.001] * 32


@pytest.fixture
def entry():
    """Return a method of trainings with the given errors."""

    def make(name, *errors, seeds=None, **options):
        reports = [report_of(name, error, **options) for error in errors]
        return Entry(name, reports, list(seeds or range(len(reports))))

    return make


# Differences


def test_differences_equal_differences_of_the_rows(entry):
    rng = np.random.default_rng(0)
    first, other = (entry(name, rng.gamma(1, 0.02, 60)) for name in "ab")
    for field, difference in differences(first, other, "part").items():
        mine, theirs = (getattr(of.reports[0].rows["part"], field) for of in (first, other))
        assert difference.value == pytest.approx(mine - theirs, abs=1e-12)


def test_seeds_are_paired_by_number(entry):
    """Paired by order, a seed would be better than the baseline and the other equally worse."""
    shift = np.linspace(0, 0.001, 32)
    a, b = 0.02 + shift, 0.03 + shift
    base = entry("dope", a, b, seeds=[1, 2])
    for seeds, within_noise in (([2, 1], False), ([2, 3], True)):
        method = entry("y", b - 0.0005, a - 0.0005, seeds=seeds)
        difference = differences(method, base, "part")["auc_10cm"]
        assert difference.value == pytest.approx(0.005)
        assert difference.within_noise == within_noise


def test_an_interval_of_shares_ends_at_one(entry):
    low, high = [0.2] * 40, [0.001] * 40
    difference = differences(entry("y", low, high), entry("dope", low, low), "part")["add_01d"]
    assert (difference.low, difference.high) == (-1, 1)


def test_other_objects_and_objects_without_instances_have_no_difference(entry):
    base = entry("dope", {"bolt": BAD, "nut": BAD})
    method = entry("x", {"bolt": GOOD, "nut": GOOD, "cap": GOOD})
    values = comparison_values([base, method])
    changes = [value for value in values if value.method == "x" and value.num_differing >= 0]
    assert {value.object for value in changes} == {"bolt", "nut"}
    objects = {value.object for value in values if value.method == "dope"}
    assert objects == {"bolt", "nut", MEAN}
    empty = entry("dope", BAD)
    empty.reports[0].errors["part"] = np.zeros(0)
    assert all(np.isnan(value.value) for value in differences(empty, empty, "part").values())


def test_a_measure_missing_for_one_seed_is_not_available(entry):
    (row, *_) = full_table(comparison_values([entry("x", [np.inf] * 32, GOOD)]))
    assert (row["rotation °"], row["± rotation °"]) == ("n/a", "n/a")


# Network and refined


def test_refined_poses_follow_their_network(entry):
    def changes(*methods):
        rows = full_table(comparison_values(with_refined(list(methods))))
        return [(row["method"], row["Δ ADD-0.1d %"]) for row in rows if row["method"] in names]

    dope = Entry("dope", [report_of("dope", BAD, refined=GOOD)], [0])
    dopepp = Entry("dopepp", [report_of("dopepp", BAD, refined=BEST)], [0])
    names = ("dope", "dope + region", "dopepp", "dopepp + region")
    # Refined poses are compared with dope's refined poses, and these with dope's network.
    assert changes(dope, dopepp) == list(zip(names, ("", "+62.5", "+0.0", "+6.2"), strict=True))
    # Without a refined baseline the network is the baseline.
    assert dict(changes(entry("dope", BAD), dopepp))["dopepp + region"] == "+68.8"
    # A method that was refined in one seed of two has no refined row.
    both = Entry("x", [report_of("x", BAD, refined=GOOD), report_of("x", BAD)], [0, 1])
    assert [item.name for item in with_refined([both])] == ["x"]


def test_networks_of_single_parts_are_joined_with_a_mean():
    bolt = report_of("x", {"bolt": BAD}, refined=GOOD)
    nut = report_of("x", {"nut": BAD}, refined=BEST)
    joined = Report.joined([nut, bolt])
    assert joined.mean.add_01d == pytest.approx(10 / 32)
    assert joined.refined is not None
    assert list(joined.refined.rows) == ["bolt", "nut", MEAN]
    assert joined.refined.mean.add_01d == pytest.approx((1 + 30 / 32) / 2)
    assert Report.joined([bolt, replace(nut, refined=None)]).refined is None


# Run folders


@pytest.mark.parametrize("option", ["camera_scale", "working_distance"])
@pytest.mark.parametrize(("given_value", "count", "objects"), [(None, 1, 3), (0.5, 2, 1)])
def test_an_automatic_value_keeps_the_recipe(option, given_value, count, objects, tmp_path):
    for part, value in (("bolt", 0.5), ("nut", 0.9)):
        config = {"data": {"objects": [part]}, "virtual": {option: value}}
        result = report_of("x", {part: GOOD})
        folder = write_run(tmp_path / part, [f"data.objects=[{part}]"], result, **config)
        given = {"virtual": {option: given_value}}
        (folder / ".hydra" / "config.yaml").write_text(yaml.safe_dump(given))
    entries = group(find_runs([tmp_path / "bolt", tmp_path / "nut"]))
    assert (len(entries), len(entries[0].objects)) == (count, objects)


def test_runs_that_differ_in_the_seed_are_one_method(tmp_path):
    for number, (model, seed) in enumerate(product(("dope", "dopepp"), (1, 2))):
        overrides, place = [f"model={model}", f"seed={seed}"], {"output_dir": f"somewhere{seed}"}
        write_run(tmp_path / str(number), overrides, report_of(model, GOOD), **place)
    write_run(tmp_path / "4", ["model=dope", "seed=3"], "out of memory")
    entries = group(find_runs([tmp_path]))
    assert [entry.name for entry in entries] == ["dope", "dopepp", "dope seed=3"]
    assert [entry.seeds for entry in entries] == [[1, 2], [1, 2], []]
    assert entries[2].failure == "out of memory"


def test_runs_with_other_differences_are_separate_methods(tmp_path):
    write_run(tmp_path / "0", ["seed=1"], report_of("dopepp", GOOD))
    write_run(tmp_path / "1", ["seed=2", "lr=3"], report_of("dopepp", GOOD), lr=3)
    write_run(tmp_path / "2", ["seed=3"], report_of("dopepp", GOOD, test_set="others"))
    write_run(tmp_path / "3", ["seed=1"], report_of("dopepp", GOOD))  # the same once more
    names = [entry.name.replace(tmp_path.name, "x") for entry in group(find_runs([tmp_path]))]
    unlike = ["dopepp seed=1 x/0", "dopepp seed=2 lr=3", "dopepp seed=3", "dopepp seed=1 x/3"]
    assert names == unlike


def test_methods_have_unique_names_of_differing_overrides(tmp_path):
    common = ["data=virtual", "seed=1", "output_dir=x", "hydra.verbose=true"]
    write_run(tmp_path / "0", [*common, "model=dope", "+optimizer=adam"])
    write_run(tmp_path / "1", [*common, "model=dopepp", "optimizer=sgd"])
    write_run(tmp_path / "10", [*common, "model=dopepp", "x=" + 60 * "y"])
    names = [entry.name for entry in group(find_runs([tmp_path]))]
    assert names == ["dope optimizer=adam", "dopepp optimizer=sgd", f"dopepp {tmp_path.name}/10"]
    folders = [write_run(tmp_path / place / "run", ["model=dope"], "gone") for place in "ab"]
    entries = group(find_runs(folders))
    assert [entry.name for entry in entries] == [f"dope run {folder}" for folder in folders]
    assert len(compact_table(comparison_values(entries))) == 2


def test_evaluations_are_grouped_by_the_training_of_a_checkpoint(tmp_path):
    for seed in (1, 2):
        overrides = ["lr=2", f"seed={seed}"]
        run = write_run(tmp_path / f"run{seed}", overrides, report_of("dopepp", BAD), lr=2)
        folder = tmp_path / f"evaluation{seed}"
        write_run(folder, [f"ckpt_path={run}", "data.num_test=9"])
        write_json(folder / METRICS_FILE, report_of("dopepp", GOOD).to_record())
        checkpoint = run / "checkpoints" / "best.ckpt"
        shares = [0.4] if seed == 1 else None  # measured beside the result
        config = {"ckpt_path": str(checkpoint), "data": {"num_test": 9}, "shading": shares}
        write_config(folder, config)
    evaluations = [tmp_path / "evaluation1", tmp_path / "evaluation2"]
    first = read_run(evaluations[0])
    assert (first.seed, first.model) == (1, "dopepp")
    assert first.checkpoint == tmp_path / "run1" / "checkpoints" / "best.ckpt"
    (entry,) = group(find_runs(evaluations))
    assert entry.seeds == [1, 2]
    # The trainings were measured with other options, so they are a separate method.
    assert len(group(find_runs([*evaluations, tmp_path / "run1"]))) == 2


@pytest.mark.parametrize(
    ("file", "content", "reason"),
    [
        (METRICS_FILE, "{", "cannot be read"),
        (METRICS_FILE, "{}", "metrics.json is of another version"),
        (METRICS_FILE, '{"name": 1, "objects": []}', "of another version"),
        (COST_FILE, "{}", "cost.json is of another version"),
        ("checkpoints/last.ckpt", "", "no metrics.json; continue with resume="),
    ],
)
def test_damaged_or_unfinished_runs_state_the_reason(file, content, reason, tmp_path):
    run = write_run(tmp_path / "0")
    assert read_run(run).failure == "unfinished: no metrics.json"
    (run / file).parent.mkdir(exist_ok=True)
    (run / file).write_text(content)
    (run / CONFIG_FILE).write_text("a: [")
    (entry,) = group(find_runs([tmp_path]))
    assert reason in entry.failure
    assert "\n" not in entry.failure


def test_folders_count_once_and_folders_without_runs_are_rejected(tmp_path):
    for path in (tmp_path, tmp_path / "missing"):
        with pytest.raises(UserError, match="holds no run"):
            find_runs([path])
    write_run(tmp_path / "0", [], report_of("dopepp", GOOD))
    assert len(find_runs([tmp_path, tmp_path / "0", tmp_path / "." / "0"])) == 1


def test_an_earlier_comparison_among_the_folders_is_ignored(tmp_path):
    comparison = tmp_path / "earlier"
    comparison.mkdir()
    (comparison / "compare.csv").touch()
    with pytest.raises(UserError, match="earlier, which holds no run"):
        find_runs([comparison])
    run = write_run(tmp_path / "0", [], report_of("dopepp", GOOD))
    assert [found.folder for found in find_runs([comparison, run])] == [run]


def test_truncated_logs_are_read(tmp_path):
    path = tmp_path / "metrics.csv"
    assert read_log_column(path, "train/loss") == {}
    path.write_text("step,train/loss\n0,1.5\n1,\n2,nan\nx,1\n3,0.5\n4")
    columns = [read_log_column(path, name) for name in ("train/loss", "val/loss")]
    assert columns == [{0: 1.5, 3: 0.5}, {}]


# The whole


def test_unfinished_runs_have_curves_and_bad_checkpoints_are_named(tmp_path):
    write_run(tmp_path / "0", ["model=dope"], report_of("dope", BAD))
    unfinished = write_run(tmp_path / "1", ["model=dopepp"])
    for folder in (tmp_path / "0", unfinished):
        rows = "\n".join(f"{step},{5 / (step + 1)}" for step in range(120))
        (folder / "metrics.csv").write_text(f"step,train/loss\n{rows}\n")
    (unfinished / "checkpoints").mkdir()
    (unfinished / "checkpoints" / "best.ckpt").write_bytes(b"junk")
    out = compare_paths([tmp_path / "0", unfinished], tmp_path / "out")
    assert {path.name for path in out.iterdir()} == {
        "compare.csv", "compare.md", "compare.png", "compare_loss.png",
        "compare_auc.csv", "compare_auc.png",
    }  # fmt: skip
    text = (out / "compare.md").read_text()
    assert "dope: no file" in text
    assert "best.ckpt" in text
    assert cv2.imread(str(out / "compare.png")).shape[2] == 3


def test_an_evaluated_release_is_found_for_the_images(tmp_path):
    run = write_run(tmp_path, [], report_of("dopepp_fast", BAD))
    write_config(run, {"ckpt_path": "pretrained/pivconnector"})
    entry = Entry("dopepp_fast", runs=[read_run(run)])
    tiles, reason = image_tiles([entry], 1)
    assert reason == ""
    assert len(tiles) == 1


def test_an_evaluation_without_a_checkpoint_has_no_images(tmp_path):
    run = write_run(tmp_path, [], report_of("other", BAD))
    write_config(run, {"ckpt_path": None, "results": "other_lmo-test.csv"})
    tiles, reason = image_tiles([Entry("other", runs=[read_run(run)])], 1)
    assert tiles == []
    assert "other: measured without a checkpoint" in reason


def test_a_comparison_is_never_overwritten(tmp_path, monkeypatch):
    run = write_run(tmp_path / "run", [], report_of("dopepp", GOOD))
    monkeypatch.chdir(tmp_path)
    first, second = compare_paths([run]), compare_paths([run])
    assert first.parent == second.parent == Path("outputs", "compare")
    assert first != second
    with pytest.raises(UserError, match=r"holds compare\.csv"):
        compare_paths([run], out=first)
    with pytest.raises(UserError, match="baseline 'x'; allowed: dopepp"):
        compare_runs([read_run(run)], tmp_path / "new", baseline="x")
    # A given baseline comes before DOPE.
    reports = [report_of("dopepp", GOOD), report_of("dope", BAD)]
    compare_reports(reports, tmp_path)
    assert [row["method"] for row in read_csv(tmp_path / "compare.csv")][:2] == ["dopepp", "dope"]
    with (tmp_path / "compare_auc.csv").open() as stream:
        assert stream.readline().strip() == "threshold_m,dopepp,dope"
