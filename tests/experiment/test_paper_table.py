"""Sweeps in the paper's layout, with the paper's figures beside them."""

from __future__ import annotations

import csv
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import yaml
from omegaconf import OmegaConf

from dopepp.drawing.pictures import read_rgb
from dopepp.errors import UserError
from dopepp.experiment import record
from dopepp.experiment.compare.compare import compare_paths
from dopepp.experiment.cost import measure_cost
from dopepp.experiment.methods import Cost
from dopepp.experiment.paper_table import PaperTable
from dopepp.experiment.report import Report
from dopepp.experiment.sweep import CompareJobs
from dopepp.metrics.pose import MEAN
from dopepp.metrics.row import mean_row, summarise

Composer = Callable[..., dict[str, Any]]

FOLDER = Path(__file__).parents[2] / "conf" / "experiment"
EXPERIMENTS = sorted(
    path.stem for path in FOLDER.glob("*.yaml") if path.stem.startswith(("table", "fig"))
)
LABELS = {"model=dope": "DOPE", "model=dopepp": "DOPE++"}


def job(folder: Path, overrides: list[str], errors: list[float] | None) -> None:
    """Write what a job of a sweep leaves; without errors, a failure."""
    (folder / ".hydra").mkdir(parents=True)
    (folder / ".hydra" / "overrides.yaml").write_text(yaml.safe_dump(overrides))
    if errors is None:
        record.write_json(folder / record.FAILURE_FILE, {"reason": "no memory"})
        return
    e = torch.tensor(errors, dtype=torch.float64)
    rows = {"part": summarise("part", "x", 0.1, e, e, e, 1000 * e, 1000 * e, 1)}
    rows[MEAN] = mean_row(list(rows.values()), "x")
    report = Report(
        "x", rows, {"best constant pose": rows}, {"part": np.array(errors)}, Cost(), len(errors),
        rotation_deg={"part": 1000 * np.array(errors)}, diameters={"part": 0.1}, test_set="a",
    )  # fmt: skip
    record.write_json(folder / record.METRICS_FILE, report.to_record())
    seed = next((int(text[5:]) for text in overrides if text.startswith("seed=")), 0)
    record.write_config(
        folder, {"model": {"name": "x", "width": 1}, "seed": seed, "a": overrides[0]}
    )


def end(folder: Path, table: dict[str, Any]) -> None:
    """What Hydra does when the last job of a sweep has ended."""
    hydra = {"sweep": {"dir": str(folder)}}
    CompareJobs().on_multirun_end(OmegaConf.create({"hydra": hydra, "table": table}))


def read_table(folder: Path) -> list[dict[str, str]]:
    with (folder / "table.csv").open(newline="") as stream:
        return list(csv.DictReader(stream))


def test_pass_rates_with_seeds_failures_and_the_papers_figures(tmp_path: Path) -> None:
    job(tmp_path / "0", ["model=dope", "seed=1"], [0.04, 0.06])
    job(tmp_path / "1", ["model=dope", "seed=2"], [0.04, 0.04])
    job(tmp_path / "2", ["model=dopepp", "seed=1"], None)
    table = {
        "title": "Table 6",
        "labels": LABELS,
        "paper": {"DOPE": {"ADD<5cm %": 91.5, "AUC[0,10cm] %": 9696958}},
    }
    with pytest.raises(SystemExit):
        end(tmp_path, table)
    dope, dopepp, reference, paper = read_table(tmp_path)
    assert dope["method"] == "DOPE"
    assert dope["ADD<5cm %"] == "75.0 ± 35.4"
    assert "ADD<10cm %" not in dope
    assert dopepp["method"] == "DOPE++: no memory"
    assert (reference["method"], reference["rotation °"]) == ("best constant pose", "50.0")
    assert (paper["method"], paper["ADD<5cm %"]) == ("DOPE, the paper", "91.5")
    assert paper["AUC[0,10cm] %"] == "9,696,958"
    text = (tmp_path / "table.md").read_text()
    assert text.startswith("# Table 6\n")
    assert "pass rate is ADD < 0.05 m" in text
    assert "not part of this project" not in text


def test_without_the_papers_figures_it_says_so(tmp_path: Path) -> None:
    job(tmp_path / "0", ["model=dope"], [0.06])
    end(tmp_path, {"title": "Table 7", "threshold": 0.1})
    assert "not part of this project" in (tmp_path / "table.md").read_text()
    assert read_table(tmp_path)[0]["ADD<10cm %"] == "100.0"


def test_shading_is_averaged_over_seeds_and_drawn(tmp_path: Path) -> None:
    header = "method,object,share,num_instances,pass_5cm,add_01d\n"
    for number, rates in enumerate([(1.0, 0.5), (0.8, 0.3)]):
        folder = tmp_path / str(number)
        job(folder, ["model=dope", f"seed={number}"], [0.04, 0.06])
        lines = [
            f"x,part,{share},10,{rate},{rate / 2}\n"
            for share, rate in zip((0, 0.8), rates, strict=True)
        ]
        (folder / "shading.csv").write_text(header + "".join(lines))
    job(tmp_path / "2", ["model=dopepp"], [0.04, 0.06])
    end(tmp_path, {"title": "Table 3", "kind": "shading", "labels": LABELS})
    lenient, missing, strict, _ = read_table(tmp_path)
    assert (lenient["method"], lenient["measure"]) == ("DOPE", "ADD<5cm %")
    assert (lenient["0 %"], lenient["80 %"]) == ("90.0", "40.0")
    assert missing["method"] == "DOPE++: no such measurement"
    assert (strict["measure"], strict["80 %"]) == ("ADD-0.1d %", "20.0")
    assert read_rgb(tmp_path / "table_shading.png").std() > 0


@pytest.mark.parametrize("experiment", ["table4_parameters", "table8_time"])
def test_costs(composed: Composer, tmp_path: Path, experiment: str) -> None:
    small = ("scale=laptop", "data.input_size=[32,32]", "cost.num_frames=3", "cost.batch_size=2")
    config = composed(f"experiment={experiment}", *small)
    for number, name in enumerate(("dope", "dopepp")):
        folder = tmp_path / str(number)
        job(folder, [f"model={name}"], None)
        (folder / record.FAILURE_FILE).unlink()
        measure_cost(composed(f"experiment={experiment}", f"model={name}", *small), folder)
    end(tmp_path, {**config["table"], "labels": LABELS, "paper": {}})
    dope, dopepp = read_table(tmp_path)
    assert (dope["method"], dopepp["method"]) == ("DOPE", "DOPE++")
    if experiment == "table4_parameters":
        assert int(dope["parameters"].replace(",", "")) > int(dopepp["parameters"].replace(",", ""))
    else:
        assert float(dope["ms/frame"]) > 0
    assert (tmp_path / "frame_rate.png").exists() == (experiment == "table8_time")


@pytest.mark.parametrize("experiment", EXPERIMENTS)
@pytest.mark.parametrize("scale", ["paper", "laptop"])
def test_every_experiment_composes(composed: Composer, experiment: str, scale: str) -> None:
    config = composed(f"experiment={experiment}", f"scale={scale}")
    table = PaperTable.of(config["table"])
    assert set(table.paper) <= set(table.labels.values())
    assert config["model"]["width"] == (0.25 if scale == "laptop" else 1.0)


@pytest.mark.parametrize(
    ("table", "message"),
    [
        ({"title": "T", "colour": 1}, r"table\.colour; allowed: title, kind"),
        ({"title": "T", "kind": "pie"}, r"table\.kind='pie'; allowed: poses, shading"),
        ({"title": "T", "threshold": 0.2}, r"table\.threshold=0\.2; allowed: 0\.05, 0\.1"),
        ({}, "table without a title"),
    ],
)
def test_impossible_tables(table: dict[str, Any], message: str) -> None:
    with pytest.raises(UserError, match=message):
        PaperTable.of(table)


def test_finished_runs_in_another_tables_layout(tmp_path: Path) -> None:
    job(tmp_path / "sweep" / "0", ["model=dope"], [0.04, 0.06])
    job(tmp_path / "sweep" / "1", ["model=dopepp"], [0.04, 0.04])
    out = compare_paths(
        [tmp_path / "sweep"],
        tmp_path / "out",
        table=FOLDER / "table6_dope_vs_dopepp.yaml",
    )
    assert [row["method"] for row in read_table(out)] == ["DOPE", "DOPE++", "best constant pose"]
    assert (out / "table.md").read_text().startswith("# Table 6")


@pytest.mark.parametrize("text", ["model: dope\n", "table: Table 6\n", "- table\n"])
def test_an_experiment_without_a_table_is_refused_before_anything_is_written(
    text: str, tmp_path: Path
) -> None:
    job(tmp_path / "0", ["model=dope"], [0.04, 0.06])
    path = tmp_path / "experiment.yaml"
    path.write_text(text)
    with pytest.raises(UserError, match="lays out no table"):
        compare_paths([tmp_path / "0"], tmp_path / "out", table=path)
    assert not (tmp_path / "out").exists()
