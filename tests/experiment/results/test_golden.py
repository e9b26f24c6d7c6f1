"""Every table, page and sentence of the results, compared with a stored text to the character.

``WRITE_GOLDEN=1 pytest tests/experiment/results/test_golden.py`` updates the texts.
"""

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

from dopepp.experiment.results import display, pages
from dopepp.experiment.results.breakdown import record_breakdown
from dopepp.experiment.results.compare import compare_paths, write_comparison
from dopepp.experiment.results.compared_runs import Entry
from dopepp.experiment.results.conditions import SCALE, SHADING, Level, record_condition
from dopepp.experiment.results.cost import COST_FILE, NetworkCost
from dopepp.experiment.results.folder import VERSIONS_FILE, write_json
from dopepp.experiment.results.frame import ADD_01D, ADD_5CM
from dopepp.experiment.results.pages import release
from dopepp.experiment.sweep.multirun import CompareJobs
from dopepp.metrics.pose import MEAN, PoseMetrics
from dopepp.metrics.row import COLUMNS, PoseRow, mean_row
from dopepp.models.checkpoint import Checkpoint, write_atomic
from dopepp.models.network import build_network
from dopepp.parts import load_part

GOLDEN = Path(__file__).parent / "golden"
EXPERIMENTS = Path(__file__).parents[3] / "conf" / "experiment"

GOOD = [0.005] * 30 + [np.inf] * 2
BAD = [0.004] * 10 + [0.02] * 20 + [np.inf] * 2
BEST = [0.001] * 32


@pytest.fixture
def compare_golden(tmp_path, monkeypatch, capsys):
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


def test_a_sweep_of_seeds_refined_failed_and_costs(compare_golden, report_of, write_run):
    rng = np.random.default_rng(0)
    for number, (model, seed) in enumerate(product(("dopepp", "dope"), (1, 2))):
        errors = rng.gamma(1, 0.01 if model == "dope" else 0.004, 60)
        overrides = [f"model={model}", f"seed={seed}", "data=virtual"]
        result = report_of(model, {"bolt": errors, "nut": errors[::-1] * 1.01}, refined=errors / 2)
        result.details["full_size_cost"] = {"parameters": 7, "gmacs": 2.5, "ms_per_frame": None}
        write_run(Path("sweep", str(number)), overrides, result)
    write_run(Path("sweep", "4"), ["model=other", "seed=1"], "got x=[1] | y; allowed: [2]; fix: z")
    write_json(write_run(Path("sweep", "5"), ["model=p"]) / "pruned.json", {"reason": "bad"})
    cost = {"parameters": 1234, "gmacs": 2.5, "ms_per_frame": 12.0}
    write_json(write_run(Path("sweep", "6"), ["model=small"]) / COST_FILE, cost)
    write_run(Path("sweep", "7"), ["model=dopepp", "seed=3"])
    end("sweep")
    compare_golden("sweep", "sweep/compare.md", "sweep/compare.csv", "sweep/README.md")


def test_a_single_training_per_method(compare_golden, report_of):
    entries = [
        Entry("dope", [report_of("dope", BAD)], [None]),
        Entry("dopepp", [report_of("dopepp", GOOD)], [None]),
        Entry("close", [report_of("close", [*GOOD[:-1], 0.02])], [None]),
        Entry("missed", [report_of("missed", [np.inf] * 32)], [None]),
        Entry("elsewhere", [report_of("elsewhere", GOOD, test_set="others")], [None]),
    ]
    write_comparison(entries, Path())
    compare_golden("comparison", "compare.md", "compare.csv")


def test_symmetric_objects_and_unknown_images(compare_golden, report_of):
    entries = [
        Entry("dope", [report_of("dope", BAD, test_set="", num_symmetries=2)] * 2, [1, 2]),
        Entry("dopepp", [report_of("dopepp", GOOD, num_symmetries=2)], [1]),
    ]
    write_comparison(entries, Path())
    compare_golden("comparison_symmetric", "compare.md", "compare.csv")


def test_unequal_seeds(compare_golden, report_of):
    entries = [
        Entry("dope", [report_of("dope", BAD), report_of("dope", GOOD)], [1, 2]),
        Entry("dopepp", [report_of("dopepp", GOOD), report_of("dopepp", BEST)], [2, 3]),
        Entry("single", [report_of("single", GOOD, refined=BEST)], [1]),
    ]
    write_comparison(entries, Path())
    compare_golden("comparison_seeds", "compare.md", "compare.csv")


def test_nothing_but_failures(compare_golden, write_run):
    write_run(Path("runs", "0"), ["model=dope"], "no memory")
    write_run(Path("runs", "1"), ["model=dopepp"], "no disk")
    compare_paths([Path("runs")], Path("out"))
    compare_golden("failures", "out/compare.md", "out/compare.csv")


# The paper's tables


def runs_of_table(table: dict[str, Any]) -> list[tuple[list[str], list[str]]]:
    """Return the overrides and parts of a run for each label and object of a table."""
    parts = sorted({part for row in table["paper"].values() for part in row} - {MEAN}) or ["part"]
    return [([label], parts) for label in table["labels"]]


@pytest.mark.parametrize(
    "experiment",
    ["table1_real_hybrid", "table2_mask", "table5_attention", "table6_dope_vs_dopepp",
     "table7_ycbv"],
)  # fmt: skip
def test_paper_tables_of_poses(experiment, compare_golden, report_of, write_run):
    table = yaml.safe_load((EXPERIMENTS / f"{experiment}.yaml").read_text())["table"]
    rng, number = np.random.default_rng(1), 0
    for label, parts in runs_of_table(table)[:4]:
        for seed in (1, 2):
            errors = {part: rng.gamma(1, 0.01, 40) for part in parts[:3]}
            result = report_of("x", errors, refined=rng.gamma(1, 0.004, 40) if seed else None)
            overrides = [*label, f"seed={seed}"]
            write_run(Path("sweep", str(number)), overrides, result, label=label, recipe="paper")
            number += 1
    write_run(Path("sweep", str(number)), ["model=other"], "no memory")
    end("sweep", table)
    compare_golden(
        experiment, "sweep/table.md", "sweep/table.csv", terminal=experiment.endswith("pp")
    )


def test_a_table_of_one_network_per_part(compare_golden, report_of, write_run):
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


def test_a_table_without_results(compare_golden, write_run):
    table = yaml.safe_load((EXPERIMENTS / "table6_dope_vs_dopepp.yaml").read_text())["table"]
    write_run(Path("sweep", "0"), ["model=dope"], "no memory")
    end("sweep", table)
    compare_golden("table_empty", "sweep/table.md", "sweep/table.csv")


SHARES = (0.0, 0.2, 0.4, 0.6, 0.8)


def shading_csv(rates: dict[str, Sequence[float]], part: str = "part") -> str:
    lines = ["method,object,share,share_reached,num_instances,pass_5cm,add_01d,median_rotation_deg"]
    for method, values in rates.items():
        for share, value in zip(SHARES, values, strict=True):
            lines.append(f"{method},{part},{share},{share},10,{value},{value / 2},")
    return "\n".join(lines) + "\n"


def test_paper_table_of_shading(compare_golden, report_of, write_run):
    number = 0
    for mask, seed, part in product(("none", "random"), (1, 2, 3), ("servoholder", "pivconnector")):
        folder = Path("sweep", str(number))
        config = {"data": {"parts": [part]}, "mask": mask}
        overrides = [f"data/masking={mask}", f"data.parts=[{part}]", f"seed={seed}"]
        result = report_of("x", {part: BAD}, refined=GOOD, test_set=part)
        write_run(folder, overrides, result, **config)
        base = 0.9 if mask == "random" else 0.7
        rates = [base - 0.4 * share * seed for share in SHARES]
        rows = {"x": rates, "x + region": [1.0, 0.9, 0.8, 0.7, 0.6], "stray": [0.1] * 5}
        (folder / "shading.csv").write_text(shading_csv(rows, part))
        number += 1
    write_run(Path("sweep", str(number)), ["model=other"], report_of("other", BAD))
    table = yaml.safe_load((EXPERIMENTS / "table3_shading.yaml").read_text())["table"]
    end("sweep", table)
    compare_golden("table3_shading", "sweep/table.md", "sweep/table.csv")


COSTS = {
    "name": "x", "backbone_weights": 1107776, "parameters": 2345678, "gmacs": 12.3456,
    "input_size": [416, 416], "picture_size": [640, 480], "device": "x86_64", "threads": 2,
    "ms_per_frame": 33.25, "network_ms": 25.55, "recovery_ms": 5.25, "batch_size": 8,
    "frames_per_s": 40.44,
}  # fmt: skip


@pytest.mark.parametrize("experiment", ["table4_parameters", "table8_time"])
def test_paper_tables_of_cost(experiment, compare_golden, report_of, write_run):
    table = yaml.safe_load((EXPERIMENTS / f"{experiment}.yaml").read_text())["table"]
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
def report(report_of):
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
    config: Any = SimpleNamespace(
        model=SimpleNamespace(name="dopepp"),
        data=SimpleNamespace(name="hybrid"),
        trainer=SimpleNamespace(max_epochs=3),
        keep_checkpoints=keep,
    )
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
def test_the_card_of_a_release(is_refined, report_of, tiny_spec, compare_golden):
    config = {"virtual": {"preset": "wide"}, "masking": {"probability": 0.3}, "cache_dir": "/x/y"}
    torch.manual_seed(0)
    checkpoint = Checkpoint(
        tiny_spec, build_network(tiny_spec).state_dict(), [load_part("pivconnector")],
        (64, 48), 8, 1.0, data={"name": "dopepp", "config": config},
    )  # fmt: skip
    write_atomic(checkpoint.to_file(), Path("best.ckpt"))
    result = report_of("dopepp", {"pivconnector": BAD}, refined=GOOD if is_refined else None)
    write_json(Path("metrics.json"), result.to_record())
    release(Path("best.ckpt"), Path("metrics.json"), "bracket", Path("out"))
    compare_golden(f"card_{'refined' if is_refined else 'network'}", "out/bracket.md")
