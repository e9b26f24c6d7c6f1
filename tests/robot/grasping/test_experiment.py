"""Trials run in several processes, and the report counts them as Table 9 does."""

import json
from concurrent.futures import Future
from dataclasses import replace

import pytest

from dopepp.core.errors import RunError
from dopepp.core.files import read_csv
from dopepp.core.pool import LostWorkerError, ProcessPool
from dopepp.robot.grasping import grasp_experiment, grasp_report
from dopepp.robot.grasping.grasp_experiment import check_task, parse_sources, run_trials
from dopepp.robot.grasping.grasp_report import HeapCounts, markdown
from dopepp.robot.grasping.grasp_trial import GraspTask, PoseSource, Record


def record(number, *, recognised=True, caught=True, failure="", source="network", off=0.0):
    seen = failure != "not seen"
    add = 1.0 if seen else float("nan")
    return Record(number, source, off, seen, recognised, add, add, add, caught, failure, 0.2, 0.02)


@pytest.fixture
def records():
    """Records like the paper's first 50 and a few more, in reverse order."""
    records = [record(k) for k in range(47)]
    records += [record(k, caught=False, failure="slipped") for k in (47, 48)]
    records.append(record(49, recognised=False, caught=False, failure="not seen"))
    records += [
        record(k, caught=k != 52, failure="no plan" if k == 52 else "") for k in range(50, 54)
    ]
    records += [record(k, source="exact poses") for k in range(54)]
    records += [record(k, source="exact poses, off", off=3.0, caught=k < 27) for k in range(54)]
    return records[::-1]


def test_recognised_and_caught_are_counted_per_50(records):
    text = markdown([record for record in records if record.source == "network"], {"seed": 0})
    assert "| 1–50 | 49 (98 %) | 47 (94 %) | 49 (98 %) | 47 (94 %) |" in text
    assert "| 51–54 | 4 (100 %) | 3 (75 %) | – | – |" in text
    # Wilson's interval of 181 of 200, by its formula.
    assert "90.5 % (85.6 – 93.8)" in text


def test_failures_are_counted_by_kind(records):
    text = markdown(records, {})
    row = next(line for line in text.splitlines() if line.startswith("| network |"))
    assert row.split("|")[-6:-1] == [" 1 ", " 0 ", " 1 ", " 0 ", " 2 "]
    assert grasp_report.count_records(records).trials == 3 * 54


def test_all_formats_hold_every_trial(records, tmp_path):
    grasp_report.write_report(tmp_path, records, {"seed": 0})
    rows = read_csv(tmp_path / "grasps.csv")
    content = json.loads((tmp_path / "grasps.json").read_text())
    assert len(rows) == len(content["trials"]) == len(records)
    assert content["sources"]["network"]["caught"] == 50
    unseen = [trial for trial in content["trials"] if not trial["seen"]]
    assert [(record["number"], record["add_mm"]) for record in unseen] == [(49, None)]
    assert (tmp_path / "curve.png").is_file()
    assert (tmp_path / "grasps.md").read_text().count("\n") > 10


def test_heaps_are_counted_by_their_last_attempt():
    def attempts(number, *lifted, parts=3):
        for attempt, count in enumerate(lifted, 1):
            caught, failure = count > 0, "" if count else "slipped"
            part = record(number, caught=caught, failure=failure)
            yield replace(part, attempt=attempt, parts=parts, lifted=count)
            parts -= count

    # A heap emptied in four attempts, one in two with a double catch, and one left with a part.
    heaps = [*attempts(0, 1, 0, 1, 1), *attempts(1, 2, 1), *attempts(2, 0, 1, 0, 1, 0, 0)]
    counts = HeapCounts(3, emptied=2, parts=9, lifted=8, attempts=12)
    assert grasp_report.count_heaps(heaps[::-1]) == counts
    text = markdown(heaps, {})
    assert "| network | 3 | 66.7 % (20.8 – 93.9) | 8 of 9 | 66.7 % (20.8 – 93.9) |" in text
    row = next(line for line in text.splitlines() if line.startswith("| network | 12 |"))
    assert "58.3 %" in row  # 7 of 12 attempts
    assert row.endswith("| 0 | 0 | 0 | 0 | 5 |")
    assert "Table 9" not in text


TASK = GraspTask(sources=(PoseSource("exact"),))


@pytest.mark.slow
def test_two_processes_and_one_process_run_equal_trials(trials):
    source = TASK.sources[0]
    expected = [trials.attempt(trials.scene(number), source).record for number in (0, 1)]
    records = sorted(run_trials(TASK, 2, workers=2), key=lambda trial: trial[0].number)
    assert [record for (record,) in records] == expected


def test_films_and_facts_are_of_the_first_trial(monkeypatch, tmp_path):
    """Processes may finish the trials in any order."""
    trials = [[replace(record(number), second_view=f"{number}")] for number in (2, 0, 1)]
    shown = []
    monkeypatch.setattr(grasp_experiment, "run_trials", lambda *_: iter(trials))
    monkeypatch.setattr(grasp_experiment, "show", lambda task, records, *_: shown.extend(records))
    report = grasp_experiment.make_experiment(TASK, 3, 2, tmp_path, None, None, print)
    assert "- second view, first trial: 0\n" in report
    assert [record.number for record in shown] == [0, 1, 2]


def test_a_lost_process_ends_the_experiment_in_one_line(monkeypatch):
    class Lost(ProcessPool):
        def submit(self, item):
            future = Future()
            future.set_exception(LostWorkerError("a worker process died (signal 9)"))
            return future

    monkeypatch.setattr(grasp_experiment, "ProcessPool", Lost)
    with pytest.raises(RunError, match=r"died \(signal 9\)"):
        list(run_trials(TASK, 2, workers=2))


def test_equal_sources_are_used_once_and_a_curve_is_many_sources():
    assert parse_sources("exact, exact,random") == (PoseSource("exact"), PoseSource("random"))
    names = [source.name for source in parse_sources("curve")]
    assert names[0] == "exact poses, off by 1 mm and 1°"
    assert len(set(names)) == len(names) == 6


def test_a_network_is_omitted_if_no_source_needs_it():
    task = replace(TASK, network="net.ckpt")
    assert check_task(task, "exact", 1).network is None
    assert check_task(task, "network,exact", 1).network == "net.ckpt"
