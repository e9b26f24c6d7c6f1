"""Hydra's sweeps as Optuna's distributions, and searches over trainings that take no time."""

import fcntl
import json
import statistics
from pathlib import Path

import pytest

pytest.importorskip("optuna")
import optuna
from hydra._internal.config_loader_impl import ConfigLoaderImpl
from hydra._internal.utils import create_config_search_path
from optuna.distributions import CategoricalDistribution, FloatDistribution, IntDistribution
from optuna.trial import FrozenTrial, TrialState

from dopepp.core.errors import UserError
from dopepp.experiment.sweep.optuna_search import examples, overrides, read_space


@pytest.fixture(scope="module")
def loader():
    return ConfigLoaderImpl(create_config_search_path(None))


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("interval(0, 1)", FloatDistribution(0, 1)),
        ("interval(1e-4, 0.5)", FloatDistribution(1e-4, 0.5)),
        ("tag(log, interval(1e-4, 1))", FloatDistribution(1e-4, 1, log=True)),
        ("int(interval(8, 64))", IntDistribution(8, 64)),
        ("tag(log, int(interval(8, 64)))", IntDistribution(8, 64, log=True)),
        ("range(1, 10, 4)", IntDistribution(1, 9, step=4)),
        ("range(3)", IntDistribution(0, 2)),
        ("range(9, 0, -3)", IntDistribution(3, 9, step=3)),
        ("range(0.5, 3.5)", CategoricalDistribution(["0.5", "1.5", "2.5"])),
        ("range(0.0, 0.5, 0.25)", CategoricalDistribution(["0.0", "0.25"])),
        ("choice(a, 3, true)", CategoricalDistribution(["a", "3", "True"])),
        ("a,b", CategoricalDistribution(["a", "b"])),
    ],
)
def test_sweeps_become_distributions(text, expected, loader):
    space = read_space(loader, [f"x.y={text}"], [])
    assert (space.varied, space.texts) == ({"x.y": expected}, {"x.y": text})


def test_the_command_line_extends_and_fixes_the_space(loader):
    listed = ["a=interval(0, 1)", "b=choice(1, 2)", "c=interval(0, 1)"]
    space = read_space(loader, listed, ["model=dope", "b=7", "c=interval(0, 9)", "+d=x,y"])
    assert list(space.varied) == ["a", "c", "+d"]
    assert space.varied["c"] == FloatDistribution(0, 9)
    assert space.fixed == ["model=dope", "b=7"]
    written = overrides(space, {"a": 0.123456789, "+d": "x"})
    assert written == ["model=dope", "b=7", "a=0.1235", "+d=x"]


def test_examples_cover_every_choice(loader):
    space = read_space(loader, ["a=choice(1, 2)", "b=interval(0, 1)", "c=choice(x, y)"], [])
    assert examples(space) == [["a=1", "b=0", "c=x"], ["a=2", "b=0", "c=x"], ["a=1", "b=0", "c=y"]]


@pytest.mark.parametrize("bad", ["a=1", "a=", "a=interval(1,", "a=interval(2, 1)", "a"])
def test_entries_that_are_no_sweep_are_rejected(bad, loader):
    with pytest.raises(UserError, match=r"search\.space with .*allowed: interval\(low, high\)"):
        read_space(loader, [bad], [])


SEARCH = ("search=optuna", "search.study=s", "search.space=[]")
LR = "optimizer.lr=tag(log, interval(1e-6, 1.0))"
FAST = (*SEARCH, LR, "search.prune=false")


def trials(folder: Path) -> list[FrozenTrial]:
    storage = f"sqlite:///{folder}/search/s/study.db"
    return optuna.load_study(study_name="s", storage=storage).trials


def started(folder: Path) -> list[list[str]]:
    lines = (folder / "search" / "s" / "started.txt").read_text().splitlines()
    return [line.split() for line in lines]


def test_a_study_goes_on_after_an_interruption_and_a_failure(call_fast, tmp_path, monkeypatch):
    """The interrupted command ran two trials at a time, and the first has a result."""
    command = (*FAST, "search.num_parallel=2")

    def numbers() -> list[int]:
        return [int(number) for number, _ in started(tmp_path)]

    monkeypatch.setenv("END_1", "interrupt")
    call_fast(*command, "search.num_trials=2", code=130)
    assert [trial.state for trial in trials(tmp_path)] == [TrialState.RUNNING] * 2
    drawn = [trial.params for trial in trials(tmp_path)]
    done = call_fast(*command, "search.num_trials=2", code=0)
    assert "continues with trials 1" in done.out
    assert numbers() == [0, 1, 1]  # the first result is not computed again
    assert [trial.params for trial in trials(tmp_path)] == drawn

    monkeypatch.setenv("END_2", "raise")
    for _ in range(2):  # the second time, nothing is missing
        done = call_fast(*command, "search.num_trials=4", code=0)
        assert numbers() == [0, 1, 1, 2, 3]
    assert "study s: 3 complete, 1 fail" in done.out
    result = trials(tmp_path)
    assert result[2].state == TrialState.FAIL
    failed = json.loads((tmp_path / "search" / "s" / "2" / "failed.json").read_text())
    assert failed["reason"] == "as the test asked"
    rates = {int(number): float(lr) for number, lr in started(tmp_path)}
    assert len(set(rates.values())) == 4
    for trial in result:
        assert trial.params["optimizer.lr"] == pytest.approx(rates[trial.number], rel=1e-3)
    best = max((trial for trial in result if trial.value is not None), key=lambda t: t.value)
    assert f"best trial {best.number}, objective {best.value:.4f}: optimizer.lr=" in done.out

    # Another configuration or space is another study.
    line = call_fast(*FAST, "search.num_trials=5", "data.batch_size=7").line
    assert "data.batch_size=7, but data.batch_size=32 at the start of the study s" in line
    done = call_fast(*SEARCH, "optimizer.lr=interval(1e-6,1e-5)", "search.prune=false")
    assert "search.study=NAME" in done.line


def test_trials_below_the_median_are_pruned(call_fast, tmp_path):
    rule = ("search.prune_after_trials=2", "search.prune_after_epochs=1", "search.num_trials=6")
    assert call_fast(*SEARCH, LR, *rule)[0] == 0
    result = trials(tmp_path)
    pruned = [trial for trial in result if trial.state == TrialState.PRUNED]
    assert pruned
    assert all(trial.number >= 2 for trial in pruned)
    for trial in result:
        # Only finished trials count, and those of before: one ran after the other.
        before = [item for item in result[: trial.number] if item.state == TrialState.COMPLETE]
        reported = trial.intermediate_values
        for epoch in (1, 2):
            if epoch not in reported or trial.number < 2:
                continue
            median = statistics.median(trial.intermediate_values[epoch] for trial in before)
            best = max(value for step, value in reported.items() if step <= epoch)
            is_last = epoch == max(reported)
            assert (best < median) == (is_last and trial.state == TrialState.PRUNED)
        record = tmp_path / "search" / "s" / str(trial.number) / "pruned.json"
        assert record.is_file() == (trial.state == TrialState.PRUNED)
    record = tmp_path / "search" / "s" / str(pruned[0].number) / "pruned.json"
    assert "worse than the other trials' median" in json.loads(record.read_text())["reason"]


def test_a_folder_of_another_study_or_command_is_rejected(call_fast, tmp_path):
    folder = tmp_path / "search" / "s"
    (folder / "0").mkdir(parents=True)
    assert "with the jobs 0 of another study" in call_fast(*FAST).line
    with (folder / ".search.lock").open("w") as stream:
        fcntl.flock(stream, fcntl.LOCK_EX)
        assert "search.study=s, which another command is searching" in call_fast(*FAST).line


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["search.num_trials=0"], "search.num_trials=0"),
        (["search.num_parallel=x"], "search.num_parallel='x'"),
        (["experiment=table6_dope_vs_dopepp"], "already sweeps over model, data.parts"),
        (["optimizer.lr=range(0.1,0.5,0.1)", "optimizer.lx=interval(0,1)"], "optimizer.lx"),
        (["optimizer.lr=tag(log, interval(0.0, 1.0))"], "optimizer.lr"),
        (["search.space=['optimizer.lr=1']"], "which is a single value"),
        (["search.space=[]", "optimizer.lr=1"], "no option to vary"),
        (["model/attention=choice(cbam,cbbm)"], "cbbm"),
        (["search.storage=/dev/null/study.db"], "search.storage=/dev/null/study.db"),
        (["search.storage=nowhere://x"], "search.storage=nowhere://x"),
    ],
)
def test_mistakes_are_reported_in_one_line(arguments, message, call_fast, tmp_path):
    assert message in call_fast("search=optuna", "search.study=s", *arguments).line
    assert not (tmp_path / "search" / "s" / "started.txt").exists()


def test_without_optuna_the_error_names_the_extra(call_fast, monkeypatch):
    monkeypatch.setattr("dopepp.core.errors.find_spec", lambda name: None)
    assert "pip install 'dopepp[search]'" in call_fast(*FAST).line
