"""Comparisons: reading run folders, seeds of one method together, the table, its words."""

from collections.abc import Sequence
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
import yaml
from omegaconf import OmegaConf

from dopepp.core.errors import UserError
from dopepp.experiment.results.compare import (
    compare_paths,
    compare_reports,
    compare_runs,
    logged,
    write_comparison,
)
from dopepp.experiment.results.cost import COST_FILE
from dopepp.experiment.results.differences import differences, figures, full, headline
from dopepp.experiment.results.entries import (
    Entry,
    find_runs,
    group,
    ordered,
    read_run,
    with_refined,
)
from dopepp.experiment.results.evaluators import Cost
from dopepp.experiment.results.folder import (
    CONFIG_FILE,
    FAILURE_FILE,
    METRICS_FILE,
    write_config,
    write_json,
)
from dopepp.experiment.results.report import Report
from dopepp.experiment.results.tables import DELTA, read_csv
from dopepp.experiment.sweep.multirun import CompareJobs
from dopepp.metrics.pose import MEAN
from dopepp.metrics.row import PoseErrors, PoseRow, mean_row, summarise

DIAMETER = 0.1


def report(
    name: str, add: Sequence[float], *, test_set: str = "images", num_objects: int = 1
) -> Report:
    """Make a result whose every object has these errors; 1 mm are 10°."""
    errors, rows = np.array(add, np.float64), {}
    angles = errors * 10_000
    for number in range(num_objects):
        part = f"part{number}"
        e, a = torch.from_numpy(errors), torch.from_numpy(angles)
        rows[part] = summarise(part, name, DIAMETER, PoseErrors(e, e, e, None, a, a, e), 1)
        rows[part].miss_rate = float(np.isinf(errors).mean())
    parts = list(rows)
    rows[MEAN] = mean_row(list(rows.values()), name)
    constant = PoseRow("part0", "best constant pose", 4, 0.2)
    return Report(
        name, rows, {"best constant pose": {"part0": constant, MEAN: constant}},
        dict.fromkeys(parts, errors), Cost(1234567, 1.5, 7.25), len(errors),
        rotation_deg=dict.fromkeys(parts, angles), diameters=dict.fromkeys(parts, DIAMETER),
        test_set=test_set,
    )  # fmt: skip


GOOD, BAD = [0.005] * 30 + [np.inf] * 2, [0.004] * 10 + [0.02] * 20 + [np.inf] * 2


def entry(name: str, *reports: Report, seeds: Sequence[int | None] | None = None) -> Entry:
    return Entry(name, list(reports), list(seeds or range(len(reports))))


def write_run(
    folder: Path, overrides: Sequence[str] = (), result: Report | str | None = None,
    seed: int = 0, **config: Any,
) -> Path:  # fmt: skip
    (folder / ".hydra").mkdir(parents=True)
    (folder / ".hydra" / "overrides.yaml").write_text(yaml.safe_dump(list(overrides)))
    if isinstance(result, Report):
        write_json(folder / METRICS_FILE, result.to_record())
        model = {"name": result.name, "width": 0.25}
        write_config(folder, {"model": model, "seed": seed, **config})
    elif result is not None:
        write_json(folder / FAILURE_FILE, {"reason": result})
    return folder


# The table


def test_dope_stands_first_and_others_have_a_difference_to_it(tmp_path):
    results = [entry("dopepp", report("dopepp", GOOD)), entry("dope", report("dope", BAD))]
    text = write_comparison(ordered(results), tmp_path)
    rows = read_csv(tmp_path / "compare.csv")
    assert [row["method"] for row in rows] == ["dope", "dopepp", "best constant pose"]
    assert rows[0]["Δ ADD-0.1d %"] == ""
    assert rows[1]["Δ ADD-0.1d %"] == "+62.5"  # 30 of 32 against 10
    assert rows[1]["Δ ADD-0.1d % verdict"] == "beyond noise"
    assert float(rows[1]["Δ ADD-0.1d % low"]) < 62.5 < float(rows[1]["Δ ADD-0.1d % high"])
    assert rows[1]["Δ ADD<10cm %"] == "+0.0"
    assert rows[1]["Δ ADD<10cm % verdict"] == "within noise"
    assert rows[1]["Δ rotation °"] == "-150.0"
    cost = [rows[0][name] for name in ("parameters", "GMACs", "ms/frame")]
    assert cost == ["1,234,567", "1.500", "7.2"]
    assert "Δ is against dope" in text
    assert "the noise of training" in text
    assert "Within noise, dopepp: ADD<5cm %, ADD<10cm %" in text
    header = text.splitlines()[0]
    assert "seeds" not in header
    assert {line.count("|") for line in text.splitlines()[:5]} == {header.count("|")}
    with (tmp_path / "compare_auc.csv").open() as stream:
        assert stream.readline().strip() == "threshold_m,dope,dopepp"


@pytest.mark.parametrize(("symmetries", "shown"), [(1, False), (2, True)])
def test_symmetric_objects_are_shown_by_what_knows_of_symmetries(symmetries, shown, tmp_path):
    one = report("dopepp", GOOD)
    for row in one.rows.values():
        row.num_symmetries, row.add_or_s_01d, row.median_rotation_s_deg = symmetries, 0.75, 3.0
    header, _, cells, *_ = (
        [cell.strip() for cell in line.split("|")]
        for line in write_comparison([entry("dopepp", one)], tmp_path).splitlines()
        if "|" in line
    )
    found = dict(zip(header, cells, strict=True))
    assert found.get("ADD(-S)-0.1d %") == ("75.0" if shown else None)
    assert found.get("rotation-S °") == ("3.0" if shown else None)


def test_differences_are_those_of_the_rows():
    rng = np.random.default_rng(0)
    one, other = (report(name, rng.gamma(1, 0.02, 60)) for name in "ab")
    found = differences(entry("a", one), entry("b", other), "part0")
    for field, difference in found.items():
        expected = getattr(one.rows["part0"], field) - getattr(other.rows["part0"], field)
        assert difference.value == pytest.approx(expected, abs=1e-12)


def test_seeds_become_mean_and_deviation():
    mine = entry("dopepp", report("dopepp", GOOD), report("dopepp", BAD), seeds=[2, 1])
    row = full(figures([mine]))[0]
    assert (row["seeds"], row["ADD-0.1d %"]) == ("1, 2", "62.5")
    assert row["± ADD-0.1d %"] == f"{100 * np.std([30 / 32, 10 / 32], ddof=1):.1f}"
    assert headline(figures([mine]))[0]["ADD-0.1d %"] == "62.5 ± 44.2"


def test_seeds_are_paired_by_number_not_by_order():
    """Row by row one seed is better than the baseline's and the other as much worse."""
    shift = np.linspace(0, 0.001, 32)
    a, b = 0.02 + shift, 0.03 + shift
    base = entry("dope", report("x", a), report("x", b), seeds=[1, 2])
    same = entry("y", report("y", b - 0.0005), report("y", a - 0.0005), seeds=[2, 1])
    difference = differences(same, base, "part0")["auc_10cm"]
    assert (difference.value, difference.within_noise) == (pytest.approx(0.005), False)
    other = entry("y", report("y", b - 0.0005), report("y", a - 0.0005), seeds=[2, 3])
    loose = differences(other, base, "part0")["auc_10cm"]
    assert loose.within_noise


def test_other_seeds_than_the_baselines_are_named(tmp_path):
    base = entry("dope", report("dope", BAD), report("dope", BAD), seeds=[1, 2])
    mine = entry("dopepp", report("dopepp", GOOD), seeds=[1])
    text = write_comparison([base, mine], tmp_path)
    assert "not paired over them: dopepp" in text
    assert "Of dopepp there is one training" in text
    both = entry("dopepp", report("dopepp", GOOD), report("dopepp", GOOD), seeds=[1, 2])
    text = write_comparison([base, both], tmp_path)
    assert "and over the seeds of the trainings" in text
    assert "Not of the same seeds" not in text


def test_an_interval_of_shares_ends_at_one():
    low, high = report("x", [0.2] * 40), report("x", [0.001] * 40)
    base = entry("dope", low, low)
    difference = differences(entry("y", low, high), base, "part0")["add_01d"]
    assert (difference.low, difference.high) == (-1, 1)


@pytest.mark.parametrize("known", ["images", ""])
def test_other_images_are_not_set_off(known, tmp_path):
    base = entry("dope", report("dope", BAD, test_set=known))
    text = write_comparison([base, entry("x", report("x", GOOD, test_set="others"))], tmp_path)
    assert read_csv(tmp_path / "compare.csv")[1]["Δ ADD-0.1d %"] == ""
    what = "not measured on the same images as dope: x" if known else "does not say which images"
    assert what in text


def test_a_mean_over_other_objects_is_not_set_off():
    base = entry("dope", report("dope", BAD, num_objects=2))
    mine = report("x", GOOD, num_objects=3)
    table = figures([base, entry("x", mine)])
    changes = [one for one in table if one.method == "x" and one.measure.startswith(DELTA)]
    assert {one.object for one in changes} == {"part0", "part1", "part2", MEAN}
    assert {one.object for one in changes if one.value != ""} == {"part0", "part1"}
    assert {one.object for one in table if one.method == "dope"} == {"part0", "part1", MEAN}


def test_an_object_without_instances_has_no_difference():
    empty = report("dope", BAD)
    empty.errors["part0"] = np.zeros(0)
    assert differences(entry("x", empty), entry("dope", empty), "part0") == {}


def test_all_missed_is_no_angle():
    base, mine = report("dope", BAD), report("x", [np.inf] * 32)
    row = full(figures([entry("dope", base), entry("x", mine)]))[1]
    assert (row["rotation °"], row["Δ rotation °"]) == ("n/a", "n/a")
    assert row["Δ ADD-0.1d % verdict"] == "beyond noise"
    seeds = entry("x", mine, report("x", GOOD))
    assert full(figures([seeds]))[0]["rotation °"] == "n/a"  # one seed's alone would flatter


# Network and refined


def refined(name: str, before: Sequence[float], after: Sequence[float], **options: Any) -> Report:
    return replace(
        report(name, before, **options), refined=report(f"{name} + region", after, **options)
    )


def test_refined_poses_stand_behind_their_network(tmp_path):
    write_run(tmp_path / "0", ["model=dopepp"], refined("dopepp", BAD, [0.001] * 32))
    write_run(tmp_path / "1", ["model=dope"], refined("dope", BAD, GOOD))
    methods = compare_runs(find_runs([tmp_path]), tmp_path / "out", num_pictures=0)
    names = ["dope", "dope + region", "dopepp", "dopepp + region"]
    assert [one.name for one in methods] == names
    rows = read_csv(tmp_path / "out" / "compare.csv")
    assert [row["method"] for row in rows] == [*names, "best constant pose"]
    assert [row["ADD-0.1d %"] for row in rows[:4]] == ["31.2", "93.8", "31.2", "100.0"]
    # Refined ones are set off against dope's refined, and those against its network.
    assert [row["Δ ADD-0.1d %"] for row in rows[:4]] == ["", "+62.5", "+0.0", "+6.2"]
    text = (tmp_path / "out" / "compare.md").read_text()
    assert "Δ of refined poses is against the first refined row" in text
    assert "Of dope" not in text
    assert text.count(str(tmp_path)) == 2  # where results come from: a line per run
    with (tmp_path / "out" / "compare_auc.csv").open() as stream:
        assert stream.readline().strip() == ",".join(["threshold_m", *names])


def test_one_network_and_the_same_refined_are_set_off(tmp_path):
    write_run(tmp_path / "0", [], refined("dopepp", BAD, GOOD))
    compare_runs(find_runs([tmp_path / "0"]), tmp_path / "out", num_pictures=0)
    _, row, _ = read_csv(tmp_path / "out" / "compare.csv")
    assert (row["method"], row["Δ ADD-0.1d %"]) == ("dopepp + region", "+62.5")
    text = (tmp_path / "out" / "compare.md").read_text()
    assert "Δ is against dopepp, with" in text
    assert "Δ of refined" not in text


def test_without_a_refined_baseline_the_network_is_the_baseline():
    entries = with_refined([
        entry("dope", report("dope", BAD)), entry("x", refined("x", BAD, GOOD)),
    ])  # fmt: skip
    rows = {row["method"]: row for row in full(figures(entries))}
    assert rows["x + region"]["Δ ADD-0.1d %"] == "+62.5"


def test_refined_in_one_seed_of_two_is_no_row():
    both = entry("x", refined("x", BAD, GOOD), report("x", BAD))
    assert [one.name for one in with_refined([both])] == ["x"]


def of_part(one: Report, part: str, after: Report | None = None) -> Report:
    """Return a result on one part as one on a part of this name."""
    rows = {part: replace(one.rows["part0"], object=part), MEAN: one.rows[MEAN]}
    return replace(one, rows=rows, references={}, errors={part: one.errors["part0"]}, refined=after)


def test_refined_poses_of_a_network_a_part_have_a_mean():
    bad, good, best = (report("x", add) for add in (BAD, GOOD, [0.001] * 32))
    bolt, nut = of_part(bad, "bolt", of_part(good, "bolt")), of_part(bad, "nut")
    joined = Report.joined([replace(nut, refined=of_part(best, "nut")), bolt])
    assert joined.mean.add_01d == pytest.approx(10 / 32)
    assert joined.refined is not None
    assert list(joined.refined.rows) == ["bolt", "nut", MEAN]
    assert joined.refined.mean.add_01d == pytest.approx((1 + 30 / 32) / 2)
    assert Report.joined([bolt, nut]).refined is None


@pytest.mark.parametrize("others", [[], [entry("dope", report("dope", BAD))]])
def test_a_failed_job_is_a_row(others, tmp_path, capsys):
    reason = "got data.input_size=[30, 30] | x; allowed: [width, height] [/nothing]; fix: [bold]"
    text = write_comparison([*others, Entry("dopepp", failure=reason)], tmp_path)
    rows = read_csv(tmp_path / "compare.csv")
    assert rows[len(others)]["method"] == "dopepp"
    assert rows[len(others)]["object"] == f"failed: {reason}"
    assert r"[30, 30] \| x" in text
    assert (tmp_path / "compare_auc.png").exists() == bool(others)
    # In the terminal it is folded, not read as markup.
    shown = "".join(capsys.readouterr().out.split())
    assert "[width," in shown
    assert "[/noth" in shown


# Run folders


@pytest.mark.parametrize(("asked", "count"), [(None, 1), (0.5, 2)])
def test_a_scale_that_was_chosen_for_the_object_is_no_other_recipe(asked, count, tmp_path):
    for part, scale in (("bolt", 0.5), ("nut", 0.9)):
        config = {"data": {"objects": [part]}, "virtual": {"camera_scale": scale}}
        overrides, result = [f"data.objects=[{part}]"], of_part(report("x", GOOD), part)
        folder = write_run(tmp_path / part, overrides, result, **config)
        given = {"virtual": {"camera_scale": asked}}
        (folder / ".hydra" / "config.yaml").write_text(yaml.safe_dump(given))
    entries = group(find_runs([tmp_path / "bolt", tmp_path / "nut"]))
    assert len(entries) == count
    assert len(entries[0].objects) == (3 if count == 1 else 1)


def test_runs_that_differ_in_the_seed_are_one_method(tmp_path):
    for number, (model, seed) in enumerate(product(("dope", "dopepp"), (1, 2))):
        overrides, place = [f"model={model}", f"seed={seed}"], {"output_dir": f"somewhere{seed}"}
        write_run(tmp_path / str(number), overrides, report(model, GOOD), seed, **place)
    write_run(tmp_path / "4", ["model=dope", "seed=3"], "out of memory")
    entries = group(find_runs([tmp_path]))
    assert [one.name for one in entries] == ["dope", "dopepp", "dope seed=3"]
    assert [one.seeds for one in entries] == [[1, 2], [1, 2], []]
    assert entries[2].failure == "out of memory"


def test_whatever_else_differs_keeps_runs_apart(tmp_path):
    write_run(tmp_path / "0", ["seed=1"], report("dopepp", GOOD), 1)
    write_run(tmp_path / "1", ["seed=2", "lr=3"], report("dopepp", GOOD), 2, lr=3)
    write_run(tmp_path / "2", ["seed=3"], report("dopepp", GOOD, test_set="others"), 3)
    write_run(tmp_path / "3", ["seed=1"], report("dopepp", GOOD), 1)  # the same once more
    names = [one.name.replace(tmp_path.name, "x") for one in group(find_runs([tmp_path]))]
    unlike = ["dopepp seed=1 x/0", "dopepp seed=2 lr=3", "dopepp seed=3", "dopepp seed=1 x/3"]
    assert names == unlike


def test_jobs_are_named_by_what_differs(tmp_path):
    common = ["data=virtual", "seed=1", "output_dir=x", "hydra.verbose=true"]
    write_run(tmp_path / "0", [*common, "model=dope", "+optimizer=adam"])
    write_run(tmp_path / "1", [*common, "model=dopepp", "optimizer=sgd"])
    write_run(tmp_path / "10", [*common, "model=dopepp", "x=" + 60 * "y"])
    names = [one.name for one in group(find_runs([tmp_path]))]
    assert names == ["dope optimizer=adam", "dopepp optimizer=sgd", f"dopepp {tmp_path.name}/10"]


def test_no_two_methods_have_one_name(tmp_path):
    folders = [write_run(tmp_path / place / "run", ["model=dope"], "gone") for place in "ab"]
    names = [one.name for one in group(find_runs(folders))]
    assert names == [f"dope run {folder}" for folder in folders]
    assert len(headline(figures(group(find_runs(folders))))) == 2


def test_an_evaluation_is_what_its_checkpoint_was_trained_as(tmp_path):
    for seed in (1, 2):
        overrides = ["lr=2", f"seed={seed}"]
        run = write_run(tmp_path / f"run{seed}", overrides, report("dopepp", BAD), seed, lr=2)
        folder = tmp_path / f"evaluation{seed}"
        write_run(folder, [f"ckpt_path={run}", "data.num_test=9"])
        write_json(folder / METRICS_FILE, report("dopepp", GOOD).to_record())
        checkpoint = run / "checkpoints" / "best.ckpt"
        shares = [0.4] if seed == 1 else None  # measured beside the result
        config = {"ckpt_path": str(checkpoint), "data": {"num_test": 9}, "shading": shares}
        write_config(folder, config)
    evaluations = [tmp_path / "evaluation1", tmp_path / "evaluation2"]
    first = read_run(evaluations[0])
    assert (first.seed, first.model) == (1, "dopepp")
    assert first.checkpoint == tmp_path / "run1" / "checkpoints" / "best.ckpt"
    (one,) = group(find_runs(evaluations))
    assert one.seeds == [1, 2]
    # Beside the trainings themselves it is something else: measured with other options.
    assert len(group(find_runs([*evaluations, tmp_path / "run1"]))) == 2


@pytest.mark.parametrize(
    ("content", "reason"),
    [("{", "unreadable"), ("{}", "not of this version"), ('{"name": 1, "objects": []}', "version")],
)
def test_a_damaged_result_is_a_row_with_the_reason(content, reason, tmp_path):
    run = write_run(tmp_path / "0")
    (run / METRICS_FILE).write_text(content)
    (run / CONFIG_FILE).write_text("a: [")
    (one,) = group(find_runs([tmp_path]))
    assert reason in one.failure
    assert "\n" not in one.failure


def test_a_job_that_measures_costs_has_nothing_else(tmp_path):
    stored = {"parameters": 1234, "gmacs": 2.5, "ms_per_frame": 12.0, "name": "dopepp"}
    write_json(write_run(tmp_path / "0") / COST_FILE, stored)
    (one,) = group(find_runs([tmp_path]))
    assert one.failure == ""
    for table in (headline(figures([one])), full(figures([one]))):
        (row,) = table
        assert (row["object"], row["parameters"], row["ms/frame"]) == ("cost only", "1,234", "12.0")
    write_comparison([entry("dope", report("dope", BAD)), one], tmp_path)
    assert read_csv(tmp_path / "compare.csv")[1]["GMACs"] == "2.500"
    write_json(tmp_path / "0" / COST_FILE, {})
    assert "cost.json is not of this version" in read_run(tmp_path / "0").failure


def test_an_unfinished_run_says_how_to_go_on(tmp_path):
    run = write_run(tmp_path / "0")
    assert read_run(run).failure == "unfinished: it left no metrics.json"
    (run / "checkpoints").mkdir()
    (run / "checkpoints" / "last.ckpt").write_bytes(b"")
    assert read_run(run).failure.endswith(f"go on with resume={run}")


def test_a_folder_given_twice_counts_once_and_one_without_runs_is_a_mistake(tmp_path):
    for path in (tmp_path, tmp_path / "missing"):
        with pytest.raises(UserError, match="holds no run"):
            find_runs([path])
    write_run(tmp_path / "0", [], report("dopepp", GOOD))
    assert len(find_runs([tmp_path, tmp_path / "0", tmp_path / "." / "0"])) == 1


def test_a_log_is_read_as_far_as_it_goes(tmp_path):
    path = tmp_path / "metrics.csv"
    assert logged(path, "train/loss") == {}
    path.write_text("step,train/loss\n0,1.5\n1,\n2,nan\nx,1\n3,0.5\n4")
    assert logged(path, "train/loss") == {0: 1.5, 3: 0.5}
    assert logged(path, "val/loss") == {}


# The whole


def test_curves_of_unfinished_runs_are_drawn_and_checkpoints_that_are_none_told(tmp_path):
    write_run(tmp_path / "0", ["model=dope"], report("dope", BAD))
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
    assert "model.width=0.25" in text
    assert cv2.imread(str(out / "compare.png")).shape[2] == 3


def test_a_comparison_is_never_overwritten(tmp_path, monkeypatch):
    run = write_run(tmp_path / "run", [], report("dopepp", GOOD))
    monkeypatch.chdir(tmp_path)
    first, second = compare_paths([run]), compare_paths([run])
    assert first.parent == second.parent == Path("outputs", "compare")
    assert first != second
    with pytest.raises(UserError, match=r"holds compare\.csv"):
        compare_paths([run], out=first)
    with pytest.raises(UserError, match="baseline 'x'; allowed: dopepp"):
        compare_runs([read_run(run)], tmp_path / "new", baseline="x")
    # One that is allowed stands before DOPE.
    compare_reports([report("dopepp", GOOD), report("dope", BAD)], tmp_path, "dopepp")
    assert [row["method"] for row in read_csv(tmp_path / "compare.csv")][:2] == ["dopepp", "dope"]


def end_sweep(folder: Path) -> None:
    CompareJobs().on_multirun_end(OmegaConf.create({"hydra": {"sweep": {"dir": str(folder)}}}))


def test_the_sweep_ends_with_a_table_and_fails_after_it(tmp_path):
    end_sweep(tmp_path)  # of no jobs: nothing to say
    write_run(tmp_path / "0", ["model=dopepp"], report("dopepp", GOOD))
    write_run(tmp_path / "1", ["model=dope"], report("dope", BAD))
    end_sweep(tmp_path)
    assert [row["method"] for row in read_csv(tmp_path / "compare.csv")][:2] == ["dope", "dopepp"]
    assert "model.width=0.25" in (tmp_path / "compare.md").read_text()

    write_run(tmp_path / "2", ["model=dopepp"], "out of memory")
    write_run(tmp_path / "10", ["model=dopepp"])
    with pytest.raises(SystemExit) as end:
        end_sweep(tmp_path)
    assert end.value.code == 1
    cells = [row["object"] for row in read_csv(tmp_path / "compare.csv")]
    assert cells[2] == "failed: out of memory"
    assert cells[3].startswith("failed: unfinished")
