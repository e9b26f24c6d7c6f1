"""Every table, page and sentence of the results, compared with a stored text to the character.

``WRITE_GOLDEN=1 pytest tests/experiment/results/test_golden.py`` updates the texts.
"""

import logging
import os
from collections.abc import Sequence
from contextlib import suppress
from itertools import product
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
import yaml
from omegaconf import OmegaConf

from dopepp.core.errors import UserError
from dopepp.experiment import program
from dopepp.experiment.results import display, pages
from dopepp.experiment.results.breakdown import record_breakdown
from dopepp.experiment.results.compare import compare_paths, write_comparison
from dopepp.experiment.results.compared_runs import Entry
from dopepp.experiment.results.conditions import SCALE, SHADING, Level, record_condition
from dopepp.experiment.results.cost import NetworkCost
from dopepp.experiment.results.folder import COST_FILE, VERSIONS_FILE, write_json
from dopepp.experiment.results.frame import ADD_01D, ADD_5CM
from dopepp.experiment.results.pages import release
from dopepp.experiment.sweep.multirun import CompareJobs
from dopepp.metrics.pose import MEAN, PoseMetrics
from dopepp.metrics.row import COLUMNS, PoseRow, mean_row
from dopepp.models.checkpoint import Checkpoint, read
from dopepp.models.network import build_network
from dopepp.models.storage import write_atomic
from dopepp.parts import load_part
from tests.experiment.conftest import report_of, write_run

GOLDEN = Path(__file__).parent / "golden"
EXPERIMENTS = Path(__file__).parents[3] / "conf" / "experiment"

GOOD = [0.005] * 30 + [np.inf] * 2
BAD = [0.004] * 10 + [0.02] * 20 + [np.inf] * 2
BEST = [0.001] * 32
CONFIG: Any = SimpleNamespace(
    model=SimpleNamespace(name="dopepp"),
    data=SimpleNamespace(name="hybrid", is_rendered=lambda split: True),
    trainer=SimpleNamespace(max_epochs=3), keep_checkpoints=True,
)  # fmt: skip


def table_of(experiment: str) -> dict[str, Any]:
    return yaml.safe_load((EXPERIMENTS / f"{experiment}.yaml").read_text())["table"]


@pytest.fixture
def compare_golden(blank_figures, tmp_path, monkeypatch, capsys):
    """Compare the terminal's output and some files with a stored text."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sys.argv", ["/somewhere/train.py", "-m", "seed=1,2"])

    def compare(name: str, *files: str, terminal: bool = True) -> None:
        sections = {"terminal": capsys.readouterr().out} if terminal else {}
        sections |= {file: Path(file).read_text() for file in files}
        text = "".join(f"===== {title}\n{content}" for title, content in sections.items())
        path = GOLDEN / f"{name}.txt"
        if os.environ.get("WRITE_GOLDEN"):
            path.write_text(text)
        assert text == path.read_text()

    return compare


def end(folder: str, table: dict[str, Any] | None = None) -> None:
    """Run Hydra's hook at the end of a multirun."""
    config = OmegaConf.create({"hydra": {"sweep": {"dir": folder}}, "table": table})
    with suppress(SystemExit):
        CompareJobs().on_multirun_end(config)


# Comparisons


def test_a_sweep_of_seeds_refined_failed_and_costs(compare_golden):
    rng = np.random.default_rng(0)
    for number, (model, seed) in enumerate(product(("dopepp", "dope"), (1, 2))):
        errors = rng.gamma(1, 0.01 if model == "dope" else 0.004, 60)
        overrides = [f"model={model}", f"seed={seed}", "data=virtual"]
        result = report_of(model, {"bolt": errors, "nut": errors[::-1] * 1.01}, refined=errors / 2)
        write_run(Path("sweep", str(number)), overrides, result)
    write_run(Path("sweep", "4"), ["model=other", "seed=1"], "got x=[1] | y; allowed: [2]; fix: z")
    write_json(write_run(Path("sweep", "5"), ["model=p"]) / "pruned.json", {"reason": "bad"})
    cost = {"parameters": 1234, "gmacs": 2.5, "ms_per_frame": 12.0}
    write_json(write_run(Path("sweep", "6"), ["model=small"]) / COST_FILE, cost)
    write_run(Path("sweep", "7"), ["model=dopepp", "seed=3"])
    end("sweep")
    compare_golden("sweep", "sweep/compare.md", "sweep/compare.csv", "sweep/README.md")


def test_a_single_training_per_method(compare_golden):
    entries = [
        Entry("dope", [report_of("dope", BAD)], [None]),
        Entry("dopepp", [report_of("dopepp", GOOD)], [None]),
        Entry("close", [report_of("close", [*GOOD[:-1], 0.02])], [None]),
        Entry("missed", [report_of("missed", [np.inf] * 32)], [None]),
        Entry("elsewhere", [report_of("elsewhere", GOOD, test_set="others")], [None]),
    ]
    write_comparison(entries, Path())
    compare_golden("comparison", "compare.md", "compare.csv")


def test_symmetric_objects_and_unknown_images(compare_golden):
    entries = [
        Entry("dope", [report_of("dope", BAD, test_set="", num_symmetries=2)] * 2, [1, 2]),
        Entry("dopepp", [report_of("dopepp", GOOD, num_symmetries=2)], [1]),
    ]
    write_comparison(entries, Path())
    compare_golden("comparison_symmetric", "compare.md", "compare.csv")


def test_unequal_seeds(compare_golden):
    entries = [
        Entry("dope", [report_of("dope", BAD), report_of("dope", GOOD)], [1, 2]),
        Entry("dopepp", [report_of("dopepp", GOOD), report_of("dopepp", BEST)], [2, 3]),
        Entry("single", [report_of("single", GOOD, refined=BEST)], [1]),
    ]
    write_comparison(entries, Path())
    compare_golden("comparison_seeds", "compare.md", "compare.csv")


def test_nothing_but_failures(compare_golden):
    write_run(Path("runs", "0"), ["model=dope"], "no memory")
    write_run(Path("runs", "1"), ["model=dopepp"], "no disk")
    compare_paths([Path("runs")], Path("out"))
    compare_golden("failures", "out/compare.md", "out/compare.csv")


# The paper's tables


@pytest.mark.parametrize(
    "experiment",
    [
        "table1_real_hybrid",
        "table2_mask",
        "table5_attention",
        "table6_dope_vs_dopepp",
        "table7_ycbv",
    ],
)
def test_paper_tables_of_poses(experiment, compare_golden):
    table, rng = table_of(experiment), np.random.default_rng(1)
    parts = sorted({part for row in table["paper"].values() for part in row} - {MEAN}) or ["part"]
    for number, (label, seed) in enumerate(product(list(table["labels"])[:4], (1, 2))):
        errors = {part: rng.gamma(1, 0.01, 40) for part in parts[:3]}
        result = report_of("x", errors, refined=rng.gamma(1, 0.004, 40))
        folder, overrides = Path("sweep", str(number)), [label, f"seed={seed}"]
        write_run(folder, overrides, result, label=[label], recipe="paper")
    write_run(Path("sweep", str(number + 1)), ["model=other"], "no memory")
    end("sweep", table)
    files = ("sweep/table.md", "sweep/table.csv")
    compare_golden(experiment, *files, terminal=experiment.endswith("pp"))


def test_a_table_of_one_network_per_part(compare_golden):
    errors = {
        "none": {"bolt": [0.06, 0.06], "nut": [0.004] * 8 + [0.06] * 2},
        "random": {"bolt": [0.004, 0.06], "nut": [0.004] * 9 + [0.06]},
    }
    vgg = {"_target_": "dopepp.models.backbones.VGG19", "weights_path": None}
    for number, (seed, mask, part) in enumerate(product((1, 2), errors, ("bolt", "nut"))):
        overrides = [f"data/masking={mask}", f"data.parts=[{part}]", f"seed={seed}"]
        result = report_of("x", {part: errors[mask][part]}, test_set=part)
        model = {"name": "x", "backbone": vgg}
        config = {"model": model, "data": {"parts": [part]}, "mask": mask}
        write_run(Path("sweep", str(number)), overrides, result, **config)
    table = {
        "title": "Table 2",
        "labels": {"data/masking=none": "without", "data/masking=random": "with"},
        "paper": {
            "without": {"bolt": {"pass": 84.05}, "nut": {"pass": 86.35}, "mean": {"pass": 85.2}},
            "with": {"bolt": {"pass": 92.35}, "screw": {"pass": 91.75}, "mean": {"pass": 92.05}},
            "DRNet": {"nut": {"pass": 74.28, "auc_10cm": 48.25}},
        },
        "recomputed": {"PoseCNN": {"nut": {"pass": 97.5, "add_01d": 25.1}}},
        "notes": ["A remark."],
    }
    end("sweep", table)
    compare_golden("table_of_parts", "sweep/table.md", "sweep/table.csv", terminal=False)


def test_a_table_without_results(compare_golden):
    write_run(Path("sweep", "0"), ["model=dope"], "no memory")
    end("sweep", table_of("table6_dope_vs_dopepp"))
    compare_golden("table_empty", "sweep/table.md", "sweep/table.csv")


SHARES = (0.0, 0.2, 0.4, 0.6, 0.8)


def shading_csv(rates: dict[str, Sequence[float]], part: str = "part") -> str:
    lines = ["method,object,share,share_reached,num_instances,pass_5cm,add_01d,median_rotation_deg"]
    for method, values in rates.items():
        for share, value in zip(SHARES, values, strict=True):
            lines.append(f"{method},{part},{share},{share},10,{value},{value / 2},")
    return "\n".join(lines) + "\n"


def test_paper_table_of_shading(compare_golden):
    runs = product(("none", "random"), (1, 2, 3), ("servoholder", "pivconnector"))
    for number, (mask, seed, part) in enumerate(runs):
        overrides = [f"data/masking={mask}", f"data.parts=[{part}]", f"seed={seed}"]
        result = report_of("x", {part: BAD}, refined=GOOD, test_set=part)
        config = {"data": {"parts": [part]}, "mask": mask}
        folder = write_run(Path("sweep", str(number)), overrides, result, **config)
        rates = [{"random": 0.9, "none": 0.7}[mask] - 0.4 * share * seed for share in SHARES]
        rows = {"x": rates, "x + region": [1.0, 0.9, 0.8, 0.7, 0.6], "stray": [0.1] * 5}
        (folder / "shading.csv").write_text(shading_csv(rows, part))
    write_run(Path("sweep", str(number + 1)), ["model=other"], report_of("other", BAD))
    end("sweep", table_of("table3_shading"))
    compare_golden("table3_shading", "sweep/table.md", "sweep/table.csv")


COSTS = {
    "name": "x", "backbone_weights": 1107776, "parameters": 2345678, "gmacs": 12.3456,
    "input_size": [416, 416], "picture_size": [640, 480], "device": "x86_64", "threads": 2,
    "ms_per_frame": 33.25, "network_ms": 25.55, "recovery_ms": 5.25, "batch_size": 8,
    "frames_per_s": 40.44,
}  # fmt: skip


@pytest.mark.parametrize("experiment", ["table4_parameters", "table8_time"])
def test_paper_tables_of_cost(experiment, compare_golden):
    table = table_of(experiment)
    for number, label in enumerate(table["labels"]):
        folder = write_run(Path("sweep", str(number)), [label])
        write_json(folder / COST_FILE, {**COSTS, "parameters": 1000 ** (number + 1)})
        header = "frame,seconds,network_seconds,recovery_seconds\n"
        (folder / "frames.csv").write_text(header + "0,0.5,0.25,0.2\n1,0.25,0.2,0.04\n")
    write_run(Path("sweep", "7"), ["model=other"], report_of("other", BAD, refined=GOOD))
    end("sweep", table)
    compare_golden(experiment, "sweep/table.md", "sweep/table.csv")


# Conditions and bins


def level(value: float, rates: dict[str, float | None], note: str = "", **facts: Any) -> Level:
    rows = {}
    for number, (method, rate) in enumerate(rates.items()):
        objects = {}
        for part in ("bolt", "nut")[: 2 - number % 2]:
            row = PoseRow(part, method, 0 if rate is None else 12, num_symmetries=1 + number)
            if rate is not None:
                row.pass_5cm, row.add_01d, row.auc_10cm = rate, rate / 2, rate / 3
                row.miss_rate, row.median_rotation_deg = 1 - rate, 10 * rate
                row.median_rotation_s_deg = rate
            objects[part] = row
        objects[MEAN] = mean_row(list(objects.values()), method)
        rows[method] = objects
    return Level(value, rows, facts, note)


@pytest.mark.parametrize("condition", [SHADING, SCALE])
def test_conditions(condition, compare_golden):
    levels = [
        level(0.5, {"dope": 0.5, "dopepp": 0.75}, share_reached=0.5, num_outside_tolerance=0),
        level(1.0, {"dope": 0.25, "dopepp": 0.5}, "A note.", share_reached=np.nan),
        level(2.0, {"dope": None, "dopepp": 0.5}, "Another note.", share_reached=0.97),
    ]
    record_condition(Path(), condition, levels, [], (ADD_5CM, ADD_01D))
    compare_golden(condition.name, f"{condition.name}.md", f"{condition.name}.csv")


@pytest.mark.parametrize("num_methods", [1, 2])
def test_bins(num_methods, compare_golden):
    part = load_part("pivconnector")
    metrics = {name: PoseMetrics([part], name) for name in ("dope", "dopepp")[-num_methods:]}
    for number in range(20):
        T = np.eye(4)
        T[:3, 3] = [0, 0, 0.2 + 0.05 * number]
        truth = SimpleNamespace(label=part.name, T_cam_obj=T, visible_fraction=1.0, wanted=None)
        for name, first in metrics.items():
            estimate = T.copy()
            estimate[0, 3] += 0.003 * number
            pose = SimpleNamespace(object=part.name, score=0.5, T_cam_obj=estimate, covariance=None)
            result = [] if number % 7 == 3 and name == "dope" else [pose]
            first.update(result, [truth], np.diag([600.0, 600, 1]), 640)
    record_breakdown(Path(), metrics, "distance", 3, (ADD_5CM, ADD_01D))
    compare_golden(f"bins_{num_methods}", "by_distance.csv")


# Single runs


def full_row(name: str, method: str, num_symmetries: int) -> PoseRow:
    row = PoseRow(name, method, 12, num_symmetries=num_symmetries)
    for number, column in enumerate(COLUMNS[1:], 1):
        setattr(row, column.field, number / 30)
    row.false_per_frame, row.ar_mspd = 0.25, None
    return row


@pytest.fixture
def report():
    report = report_of("dopepp", {"bolt": BAD, "nut": GOOD, "absent": []})
    for name, num_symmetries in (("bolt", 1), ("nut", 4), (MEAN, 4)):
        report.rows[name] = full_row(name, "dopepp", num_symmetries)
    report.rows["absent"] = PoseRow("absent", "dopepp", 0, false_per_frame=1.5)
    report.references["best constant pose"]["absent"] = PoseRow("absent", "best constant pose", 0)
    return report


@pytest.mark.parametrize("all_measures", [False, True])
def test_a_report_in_the_terminal(report, all_measures, compare_golden):
    display.show_report(report, all_measures)
    compare_golden(f"report_{'all' if all_measures else 'usual'}")


@pytest.mark.parametrize("keep", [True, False])
def test_readme_of_a_run(keep, report, compare_golden):
    config: Any = SimpleNamespace(**vars(CONFIG) | {"keep_checkpoints": keep})
    folder = Path("a run")
    command = {"command": ["train.py", "data.parts=[a,b]"]}
    again = {"command": ["train.py", "resume=RUN"], "earlier": [command, {"other": 1}]}
    write_json(folder / VERSIONS_FILE, again)
    page = pages.RunReadme(config, folder)
    page.begin()
    texts = []
    for state in (pages.INTERRUPTED, pages.FINISHED):
        page.end(state, "for a reason" if state == pages.INTERRUPTED else "")
        texts.append((folder / "README.md").read_text())
    for name in ("overlay.png", "auc.png", "metrics.json", "config.yaml", "checkpoints/best.ckpt"):
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).touch()
    report.details["checkpoint"] = "checkpoints/best_tuned.ckpt"
    page.end(pages.FINISHED, report=report)
    texts.append((folder / "README.md").read_text())
    Path("pages").write_text("-----\n".join(texts))
    compare_golden(f"readme_{'kept' if keep else 'trial'}", "pages", terminal=False)


@pytest.fixture
def released(tiny_spec, tmp_path):
    """Release a checkpoint with the report of its run."""

    def make(name="bracket", checkpoint="best.ckpt", metrics="metrics.json", refined=None,
             part="pivconnector"):  # fmt: skip
        torch.manual_seed(0)
        config = {
            "virtual": {"preset": "wide"},
            "masking": {"probability": 0.3},
            "cache_dir": "/x/y",
        }
        content = Checkpoint(
            tiny_spec, build_network(tiny_spec).state_dict(), [load_part(part)],
            (64, 48), 8, 1.0, data={"name": "dopepp", "config": config},
        )  # fmt: skip
        write_atomic(content.to_file(), tmp_path / "best.ckpt")
        result = report_of("dopepp", {"pivconnector": BAD}, refined=refined)
        write_json(tmp_path / "metrics.json", result.to_record())
        return release(tmp_path / checkpoint, tmp_path / metrics, name, tmp_path / "out")

    return make


def test_readmes_of_jobs_and_multiruns(report, compare_golden):
    folder = Path("run")
    write_json(folder / VERSIONS_FILE, {"command": ["evaluate.py", "a=b c"]})
    (folder / "frame_rate.png").touch()
    texts = []
    for result in (None, report):
        pages.write_run_readme(folder, "Cost of x", result)
        texts.append((folder / "README.md").read_text())
    command = ["train.py", "-m", "seed=1,2"]
    for jobs in ({}, {"0": "finished", "1": "failed: a | b"}):
        pages.write_multirun_readme(folder, command, jobs)
        texts.append((folder / "README.md").read_text())
    (folder / "compare.md").touch()
    (folder / "compare.png").touch()
    pages.write_multirun_readme(folder, command, jobs)
    texts.append((folder / "README.md").read_text())
    Path("pages").write_text("-----\n".join(texts))
    compare_golden("readme_jobs", "pages", terminal=False)


def test_the_table_of_a_cost(compare_golden):
    cost = NetworkCost(**{**COSTS, "input_size": (416, 416), "picture_size": (640, 480)})
    rows = [{"measure": measure, "": text} for measure, text in cost.texts().items()]
    display.show_table(f"{cost.name}, untrained, on {cost.device}", rows)
    compare_golden("cost")


@pytest.mark.parametrize("is_refined", [True, False])
def test_the_card_of_a_release(is_refined, released, compare_golden):
    weights, _ = released(refined=GOOD if is_refined else None)
    assert read(weights).data["config"]["cache_dir"] is None
    compare_golden(f"card_{'refined' if is_refined else 'network'}", "out/bracket.md")


@pytest.mark.parametrize(("change", "message"), [
    ({"name": "../x"}, r"name '\.\./x'; allowed: letters"),
    ({"metrics": "other.json"}, r"other\.json"),
    ({"checkpoint": "other.ckpt"}, r"other\.ckpt"),
    ({"part": "servoholder"}, "results of pivconnector; allowed: results of servoholder"),
    ({}, "of weights in half precision; allowed: at most 100"),
], ids=str)  # fmt: skip
def test_rejected_releases(change, message, released, tmp_path, monkeypatch):
    torch.save({"a": 1}, tmp_path / "other.ckpt")
    if not change:
        monkeypatch.setattr(pages, "MAX_BYTES", 100)
    with pytest.raises(UserError, match=message):
        released(**change)
    assert not (tmp_path / "out").exists()


@pytest.fixture
def run(tmp_path):
    """Return a run folder with a space in its name."""
    folder = tmp_path / "a run"
    write_json(folder / VERSIONS_FILE, {"command": ["train.py", "data.parts=[a,b]"]})
    return folder


def test_the_readme_is_not_written_before_the_run_begins(run, monkeypatch):
    monkeypatch.setattr("sys.argv", ["/somewhere/bin/dopepp", "train", "seed=1"])
    page, path = pages.RunReadme(CONFIG, run), run / pages.README_FILE
    page.end(pages.FAILED, "too early")
    assert not path.exists()
    page.begin()
    assert path.read_text().startswith("# dopepp on hybrid: running\n\nSince ")
    assert f"\ndopepp train resume='{run}'  # continue" in path.read_text()


def test_shading_is_not_suggested_on_photographs(run):
    data = SimpleNamespace(name="bop", is_rendered=lambda split: False)
    page = pages.RunReadme(SimpleNamespace(**vars(CONFIG) | {"data": data}), run)
    page.begin()
    page.end(pages.FINISHED)
    text = (run / pages.README_FILE).read_text()
    assert "'by=[distance]'" in text
    assert "'shading=" not in text


def test_paths_are_relative_to_the_working_directory(run, monkeypatch):
    assert program.relative_path(run) == str(run)
    monkeypatch.chdir(run.parent)
    assert program.relative_path(run / "x") == "a run/x"


def test_a_failing_readme_does_not_end_the_run(run, caplog):
    (run / pages.README_FILE).mkdir()
    with caplog.at_level(logging.WARNING):
        pages.RunReadme(CONFIG, run).begin()
    assert f"cannot write {run / pages.README_FILE}" in caplog.text
