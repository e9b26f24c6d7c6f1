from __future__ import annotations

import csv
import json
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from omegaconf import OmegaConf

from dopepp.errors import UserError
from dopepp.experiment import record
from dopepp.experiment.compare import Failure, compare, comparison_table
from dopepp.experiment.report import FULL_SIZE_COST, Cost, Report
from dopepp.experiment.sweep import CompareJobs, job_name, read_job
from dopepp.metrics.row import PoseRow


def make_report(name: str, add_01d: float | None = 0.5, num_objects: int = 1) -> Report:
    objects = [f"part{number}" for number in range(num_objects)]

    def rows(method: str, share: float | None) -> dict[str, PoseRow]:
        return {
            label: PoseRow(label, method, 4, share, 1.0, 1.0, share, 1.0, 0.9, 12.0, 0.003)
            for label in [*objects, "mean"]
        }

    errors = {label: np.array([0.001, 0.02, np.inf, 0.3]) for label in objects}
    references = {"best constant pose": rows("best constant pose", 0.2)}
    return Report(name, rows(name, add_01d), references, errors, Cost(1234567, 1.5, 7.25), 4)


def read_csv(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as stream:
        return list(csv.DictReader(stream))


@settings(max_examples=30, deadline=None)
@given(
    errors=st.lists(st.floats(0, 10) | st.just(np.inf), max_size=5),
    share=st.none() | st.floats(0, 1),
    ms=st.none() | st.floats(0, 1e6),
)
def test_a_report_survives_json(errors: list[float], share: float | None, ms: float | None) -> None:
    report = make_report("dopepp", share, num_objects=2)
    report.errors["part0"] = np.array(errors, np.float64)
    report.cost = Cost(1, 2.0, ms)
    report.details = {"checkpoint": "best.ckpt", FULL_SIZE_COST: vars(Cost(9, 8.0, 7.0))}
    text = json.dumps(report.to_record(), allow_nan=False)
    back = Report.from_record(json.loads(text))
    np.testing.assert_array_equal(back.errors["part0"], report.errors["part0"])
    assert back.rows == report.rows
    assert back.references == report.references
    assert (back.name, back.cost, back.num_images) == ("dopepp", report.cost, 4)
    assert back.details == report.details


def test_dope_stands_first_and_others_have_a_difference_to_it(tmp_path: Path) -> None:
    results = [make_report("dopepp", 0.625), make_report("dopepp model.width=2", None),
               make_report("dope", 0.5)]  # fmt: skip
    compare(results, tmp_path, "A note.")
    rows = read_csv(tmp_path / "compare.csv")
    assert [row["method"] for row in rows] == [
        "dope", "dopepp", "dopepp model.width=2", "best constant pose",
    ]  # fmt: skip
    assert [row["ADD-0.1d %"] for row in rows] == ["50.0", "62.5", "n/a", "20.0"]
    assert [row["Δ ADD-0.1d %"] for row in rows] == ["", "+12.5", "n/a", ""]
    assert rows[0]["parameters"] == "1,234,567"
    assert rows[0]["GMACs"] == "1.500"
    assert float(rows[0]["ms/frame"]) == pytest.approx(7.25, abs=0.051)

    lines = (tmp_path / "compare.md").read_text().splitlines()
    assert lines[0].startswith("| method | object |")
    assert len({line.count("|") for line in lines[:6]}) == 1
    assert lines[-1] == "A note."
    with (tmp_path / "compare_auc.csv").open() as stream:
        assert stream.readline().strip() == "threshold_m,dope,dopepp,dopepp model.width=2"
    assert (tmp_path / "compare_auc.png").read_bytes().startswith(b"\x89PNG")


def test_a_baseline_that_is_asked_for_stands_before_dope(tmp_path: Path) -> None:
    compare([make_report("dopepp"), make_report("dope")], tmp_path, baseline="dopepp")
    assert [row["method"] for row in read_csv(tmp_path / "compare.csv")][:2] == ["dopepp", "dope"]


def test_without_dope_the_first_is_the_baseline() -> None:
    table = comparison_table([make_report("a", 0.1), make_report("b", 0.3)])
    assert [row["Δ ADD-0.1d %"] for row in table[:2]] == ["", "+20.0"]


def test_several_objects_have_a_row_each_and_a_mean() -> None:
    table = comparison_table([make_report("dope", num_objects=2)])
    assert [row["object"] for row in table] == ["part0", "part1", "mean", "mean"]


@pytest.mark.parametrize("others", [[], [make_report("dope")]])
def test_a_failed_job_is_a_row(
    others: list[Report], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    reason = "got data.input_size=[30, 30] | x; allowed: [width, height] [/nothing]; fix: [bold]"
    compare([Failure("dopepp", reason), *others], tmp_path)
    rows = read_csv(tmp_path / "compare.csv")
    assert rows[len(others)]["method"] == "dopepp"
    assert rows[len(others)]["object"] == f"failed: {reason}"
    assert r"[30, 30] \| x" in (tmp_path / "compare.md").read_text()
    assert (tmp_path / "compare_auc.png").exists() == bool(others)
    # In the terminal it is folded, not read as markup.
    shown = "".join(capsys.readouterr().out.split())
    assert "[width," in shown
    assert "[/noth" in shown


def write_job(sweep: Path, number: int, overrides: list[str], result: Report | str | None) -> Path:
    job = sweep / str(number)
    (job / ".hydra").mkdir(parents=True)
    OmegaConf.save(OmegaConf.create(overrides), job / ".hydra" / "overrides.yaml")
    if isinstance(result, Report):
        record.write_json(job / record.METRICS_FILE, result.to_record())
        record.write_config(job, {"model": {"width": 0.25}})
    elif result is not None:
        record.write_json(job / record.FAILURE_FILE, {"reason": result})
    return job


def test_jobs_are_named_by_what_differs(tmp_path: Path) -> None:
    common = ["data=virtual", "seed=1"]
    jobs = [
        write_job(tmp_path, 0, [*common, "model=dope", "optimizer=adam"], None),
        write_job(tmp_path, 1, [*common, "model=dopepp", "optimizer=sgd"], None),
    ]
    assert [job_name(job) for job in jobs] == ["dope optimizer=adam", "dopepp optimizer=sgd"]
    alone = write_job(tmp_path / "other", 0, common, None)
    assert job_name(alone) == "dopepp"


def test_jobs_of_one_model_are_told_apart(tmp_path: Path) -> None:
    for number, name in enumerate(("none", "se")):
        write_job(tmp_path, number, [f"model/attention={name}"], make_report("dopepp"))
    names = [read_job(tmp_path / str(number)).name for number in (0, 1)]
    assert names == ["dopepp model/attention=none", "dopepp model/attention=se"]


def end_sweep(folder: Path) -> None:
    CompareJobs().on_multirun_end(OmegaConf.create({"hydra": {"sweep": {"dir": str(folder)}}}))


def test_the_sweep_ends_with_a_table_and_fails_after_it(tmp_path: Path) -> None:
    write_job(tmp_path, 0, ["model=dopepp"], make_report("dopepp"))
    write_job(tmp_path, 1, ["model=dope"], make_report("dope"))
    end_sweep(tmp_path)
    assert [row["method"] for row in read_csv(tmp_path / "compare.csv")][:2] == ["dope", "dopepp"]
    assert "model.width=0.25" in (tmp_path / "compare.md").read_text()

    write_job(tmp_path, 2, ["model=dopepp"], "out of memory")
    write_job(tmp_path, 10, ["model=dopepp"], None)
    with pytest.raises(SystemExit) as end:
        end_sweep(tmp_path)
    assert end.value.code == 1
    cells = [row["object"] for row in read_csv(tmp_path / "compare.csv")]
    assert cells[2] == "failed: out of memory"
    assert cells[3].startswith("failed: unfinished")


def test_a_run_records_what_it_ran_with(tmp_path: Path) -> None:
    environment: dict[str, Any] = record.environment(7, "abc")
    record.write_json(tmp_path / record.VERSIONS_FILE, environment)
    assert record.read_json(tmp_path / record.VERSIONS_FILE) == environment
    assert (environment["seed"], environment["data_fingerprint"]) == (7, "abc")
    assert environment["packages"]["torch"] == version("torch")
    assert set(environment) >= {"dopepp", "python", "platform", "git", "hardware", "command"}


def test_the_config_is_written_as_it_was(tmp_path: Path) -> None:
    config = {"b": {"x": [1, 2.5, None]}, "a": "größer"}
    record.write_config(tmp_path, config)
    path = tmp_path / record.CONFIG_FILE
    assert OmegaConf.to_container(OmegaConf.load(path)) == config
    assert list(OmegaConf.load(path)) == ["b", "a"]


def test_json_that_nobody_else_could_read_is_not_written(tmp_path: Path) -> None:
    path = tmp_path / "x.json"
    record.write_json(path, {"a": 1})
    with pytest.raises(ValueError, match="JSON"):
        record.write_json(path, {"a": float("nan")})
    assert record.read_json(path) == {"a": 1}


@pytest.mark.parametrize("content", ["", "{", "[1]", None])
def test_a_damaged_record_is_a_users_error(content: str | None, tmp_path: Path) -> None:
    path = tmp_path / "metrics.json"
    if content is not None:
        path.write_text(content)
    with pytest.raises(UserError, match=r"metrics\.json"):
        record.read_json(path)
