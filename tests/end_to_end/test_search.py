"""A search with real trainings: killed, started again, pruned, compared."""

import json
import time
from typing import Any

import pytest

from dopepp.core.files import read_csv

SPACE = "optimizer.lr=tag(log, interval(1e-6, 1e-2))"
SEARCH = (
    "search=optuna", "search.study=s", "search.num_trials=5", "search.prune_after_trials=1",
    "search.prune_after_epochs=0", SPACE,
    # Of networks this small no pose is ever right.
    "callbacks.checkpoint.monitor=val/loss", "callbacks.checkpoint.mode=min",
    "trainer.max_epochs=3", "data.samples_per_epoch=32",
)  # fmt: skip


@pytest.mark.slow
def test_a_killed_search_goes_on_and_prunes(start, call, tiny, tmp_path):
    optuna = pytest.importorskip("optuna")
    arguments = [*tiny, *SEARCH, f"output_dir={tmp_path}"]
    sweep = tmp_path / "search" / "s"
    with start("train.py", *arguments) as process:
        while not (sweep / "0" / "checkpoints" / "last.ckpt").exists():
            assert process.poll() is None, process.communicate()
            time.sleep(0.05)
        process.kill()

    def trials() -> list[Any]:
        return optuna.load_study(study_name="s", storage=f"sqlite:///{sweep / 'study.db'}").trials

    assert [trial.state.name for trial in trials()] == ["RUNNING"]
    done = call("train.py", *arguments, code=0)
    assert "continues with trials 0" in done.out
    states = [trial.state.name for trial in trials()]
    assert len(states) == 5
    assert set(states) == {"COMPLETE", "PRUNED"}
    for trial in trials():
        job = sweep / str(trial.number)
        if trial.state.name == "PRUNED":
            assert "worse than the other trials' median" in (job / "pruned.json").read_text()
            assert not (job / "metrics.json").exists()
        else:
            assert trial.value == min(trial.intermediate_values.values())
            assert json.loads((job / "metrics.json").read_text())["objective"] == trial.value
    rows = [row["object"] for row in read_csv(sweep / "compare.csv")]
    assert sum(text.startswith("pruned: after epoch") for text in rows) == states.count("PRUNED")
    assert not any(text.startswith("failed") for text in rows)
    # The killed trial went on from its checkpoint: each step stands once in its table.
    table = read_csv(sweep / "0" / "metrics.csv")
    steps = [row["step"] for row in table if row.get("val/loss")]
    assert len(steps) == len(set(steps))
