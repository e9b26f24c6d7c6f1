"""Run folders: none is written over, and each says what it holds."""

import pytest

from dopepp.experiment.results.folder import BEST_CHECKPOINT


def test_the_same_command_twice_makes_two_folders(call, tiny, tmp_path):
    command = ("job=cost", "cost.num_frames=1", "cost.batch_size=1", f"output_dir={tmp_path}")
    for count in (1, 2):
        call("train.py", *tiny, *command, code=0)
        folders = list(tmp_path.glob("*/*/cost.json"))
        assert len(folders) == count
    assert "# Cost of dopepp" in folders[0].with_name("README.md").read_text()


@pytest.mark.parametrize("script", ["train.py", "evaluate.py"])
def test_the_folder_of_a_run_is_refused_untouched(script, call, tiny, trained):
    run, _ = trained
    before = {path: path.read_bytes() for path in run.rglob("*") if path.is_file()}
    options = tiny if script == "train.py" else (f"ckpt_path={run / BEST_CHECKPOINT}",)
    done = call(script, *options, f"hydra.run.dir={run}")
    assert f"got hydra.run.dir={run}, which holds a run" in done.line
    assert f"resume={run}" in done.line
    assert {path: path.read_bytes() for path in run.rglob("*") if path.is_file()} == before


def test_a_fast_dev_run_does_everything_and_keeps_no_weights(call, tiny, tmp_path):
    done = call(
        "train.py", *tiny, "debug=fdr", "data.num_test=1", "tune=true", "num_empty=1",
        f"output_dir={tmp_path}", code=0,
    )  # fmt: skip
    # A network after one step is right nowhere, which teaches nothing.
    assert "not tuned: got " in done.out
    assert "removing the checkpoints" in done.out
    (run,) = (tmp_path / "debug").iterdir()
    assert (run / "metrics.json").is_file()
    assert not list(run.rglob("*.ckpt"))
    assert "kept no checkpoints" in (run / "README.md").read_text()
    done = call("train.py", f"resume={run}")
    assert "keep_checkpoints=false" in done.line


def test_the_learning_rate_finder_trains_nothing_else(call, tiny, tmp_path):
    options = ("job=lr_finder", "lr_finder.num_steps=20", f"output_dir={tmp_path}")
    done = call("train.py", *tiny, *options, code=0)
    assert "lr_finder.png" in done.out
    (run,) = tmp_path.glob("*/*")
    names = {path.name for path in run.iterdir()}
    assert {"lr_finder.csv", "lr_finder.png", "README.md", "config.yaml"} <= names
    assert not names & {"checkpoints", "metrics.json"}
    assert len((run / "lr_finder.csv").read_text().splitlines()) > 3
