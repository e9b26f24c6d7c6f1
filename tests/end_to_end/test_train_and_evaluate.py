import json
import re
from pathlib import Path

import cv2
import pytest
import torch
import yaml

from dopepp.core.files import read_csv
from dopepp.data.rendered import RenderedSource
from dopepp.experiment.results.folder import BEST_CHECKPOINT
from dopepp.inference.estimator import PoseEstimator
from dopepp.metrics.references import REFERENCES
from dopepp.parts.catalogue import pivconnector
from dopepp.virtual.factory import Factory
from dopepp.virtual.presets import PRESETS


def test_a_run_folder_holds_everything(trained, tiny):
    run, _ = trained
    for name in ("auc.png", "overlay.png", "val_auc.png", "val_overlay.png", "val_belief.png"):
        image = cv2.imread(str(run / name))
        assert image is not None, name
        assert image.std() > 0, name
    assert read_csv(run / "auc.csv")[0].keys() == {"threshold_m", "pivconnector"}

    readme = (run / "README.md").read_text()
    assert readme.startswith("# dopepp on virtual: finished\n")
    for text in (
        "python train.py data=virtual", "| pivconnector | dopepp |", "](overlay.png)",
        "python evaluate.py ckpt_path=", f"resume={run}", "- `metrics.csv`: ",
    ):  # fmt: skip
        assert text in readme, text
    for name in re.findall(r"\]\(([^)]+)\)", readme):
        assert (run / name).is_file(), name

    metrics = json.loads((run / "metrics.json").read_text())
    assert metrics["num_images"] == 3
    assert set(metrics["objects"]) == {"pivconnector", "mean"}
    assert set(metrics["references"]) == set(REFERENCES)
    assert metrics["objects"]["pivconnector"]["num_instances"] == 3
    assert len(metrics["add"]["pivconnector"]) == 3
    assert metrics["cost"]["ms_per_frame"] > 0
    assert (run / metrics["checkpoint"]).name == "best.ckpt"

    table = read_csv(run / "metrics.csv")
    assert [row["step"] for row in table] == sorted({row["step"] for row in table}, key=int)
    assert {"train/loss", "val/loss", "val/auc_10cm", "throughput/images_per_s"} <= set(table[0])
    assert any(name.startswith("lr-") for name in table[0])

    config = yaml.safe_load((run / "config.yaml").read_text())
    assert config["data"]["parts"] == ["pivconnector"]
    assert config["model"]["backbone"]["width"] == 0.0625  # every interpolation is resolved
    versions = json.loads((run / "versions.json").read_text())
    assert versions["packages"]["torch"]
    assert versions["command"][:2] == ["train.py", tiny[0]]
    assert len(versions["data_fingerprint"]) == 64


def test_a_run_shows_what_it_does(trained):
    _, done = trained
    for text in (
        "config", "model", "width: 0.0625",  # the config's tree
        "train", "virtual",  # the sources
        "precision",
        "pivconnector: 3 test images", "ADD-0.1d", "AUC[0,10cm]", "rotation °", "missed %",
        "chance, all rotations", "best constant pose",
        "checkpoints/best.ckpt", "metrics.json",
    ):  # fmt: skip
        assert text in done.out, text
    assert "Epoch 0" in done.out + done.err  # the progress bar


def test_a_checkpoint_is_one_safe_file_that_predicts(trained):
    run, _ = trained
    path = run / "checkpoints" / "best.ckpt"
    assert "=" not in path.name  # which Hydra could not parse in ckpt_path=…
    payload = torch.load(path, weights_only=True)["dopepp"]
    assert payload["data"]["name"] == "dopepp"
    estimator = PoseEstimator.load(path)
    source = RenderedSource(Factory([pivconnector()], PRESETS["paper"], seed=3), 1, "test")
    sample = source.sample(0)
    assert isinstance(estimator.predict(sample.image, sample.K), list)


@pytest.fixture
def evaluate(trained, call, find_run, tmp_path):
    """Evaluate the best checkpoint of the training; returns the folder and the output."""

    def run(*overrides: str) -> tuple[Path, str]:
        path = trained[0] / "checkpoints" / "best.ckpt"
        arguments = (f"ckpt_path={path}", *overrides, f"output_dir={tmp_path}")
        done = call("evaluate.py", *arguments, code=0)
        return find_run(tmp_path), done.out

    return run


def test_evaluation_needs_the_checkpoint_alone(trained, evaluate):
    run, (folder, _) = trained[0], evaluate()
    ours, theirs = (json.loads((f / "metrics.json").read_text()) for f in (folder, run))
    # The same images, the same poses: the same figures as at the end of training.
    assert (ours["objects"], ours["add"]) == (theirs["objects"], theirs["add"])
    assert {path.name for path in folder.iterdir()} >= {
        "auc.png", "auc.csv", "overlay.png", "config.yaml", "versions.json", "README.md",
    }  # fmt: skip


def test_a_baseline_stands_first_and_is_drawn(trained, evaluate):
    last = trained[0] / "checkpoints" / "last.ckpt"
    folder, _ = evaluate(f"baseline={last}", "num_pictures=1")
    methods = [row["method"] for row in read_csv(folder / "compare.csv")]
    assert methods[:2] == ["dopepp (baseline)", "dopepp"]
    assert cv2.imread(str(folder / "overlay.png")) is not None
    assert set(read_csv(folder / "auc.csv")[0]) >= {"dopepp pivconnector"}


@pytest.mark.slow
def test_shading_scale_and_bins_are_measured_of_both_networks(trained, evaluate, call, tmp_path):
    best, last = (trained[0] / "checkpoints" / name for name in ("best.ckpt", "last.ckpt"))
    protocols = ("shading=[0.4,0.8]", "scale=[0.5,1]", "by=[distance,size]", "num_bins=2")
    folder, out = evaluate(f"baseline={last}", *protocols)
    shading = read_csv(folder / "shading.csv")
    assert [row["method"] for row in shading] == ["dopepp (baseline)"] * 3 + ["dopepp"] * 3
    assert [row["share"] for row in shading] == ["0.0", "0.4", "0.8"] * 2
    assert {row["num_instances"] for row in shading} == {"3"}
    assert [row["scale"] for row in read_csv(folder / "scale.csv")] == ["0.5", "1.0"] * 2
    bins = read_csv(folder / "by_distance.csv")
    assert [row["num_instances"] for row in bins] in (["1", "1", "2", "2"], ["2", "2", "1", "1"])
    for name in (
        "shading.png", "shading_examples.png", "scale.png", "scale_examples.png",
        "by_distance.png", "by_size.png",
    ):  # fmt: skip
        assert cv2.imread(str(folder / name)) is not None, name
    assert "shading: share of the visible area covered" in out
    options = (f"ckpt_path={best}", "tune=true", "by=size", f"output_dir={tmp_path}")
    assert "tune" in call("evaluate.py", *options).line


def test_other_data_must_show_the_checkpoints_objects(trained, evaluate, call, tmp_path):
    _, out = evaluate("data=virtual", "data.num_test=1", "virtual.preset=quickstart")
    assert "pivconnector: 1 test images" in out
    path = trained[0] / "checkpoints" / "best.ckpt"
    done = call(
        "evaluate.py", f"ckpt_path={path}", "data=virtual", "data.parts=[servoholder]",
        f"output_dir={tmp_path}",
    )  # fmt: skip
    assert "test data without pivconnector" in done.line


def test_a_baseline_must_share_an_object(trained, call, tmp_path):
    path = trained[0] / "checkpoints" / "best.ckpt"
    other = torch.load(path, weights_only=True)
    other["dopepp"]["parts"][0]["name"] = "cup"
    torch.save(other, tmp_path / "cup.ckpt")
    options = f"baseline={tmp_path / 'cup.ckpt'}", f"output_dir={tmp_path}"
    line = call("evaluate.py", f"ckpt_path={path}", *options).line
    assert "got a baseline of cup; allowed: one or more of pivconnector" in line


@pytest.mark.slow
def test_average_early_stopping_and_profiler_go_together(call, find_run, tiny, tmp_path):
    done = call(
        "train.py", *tiny, "ema=0.5", "callbacks=early_stopping",
        "callbacks.early_stopping.patience=1", "callbacks.early_stopping.min_delta=1",
        "trainer.max_epochs=4", "trainer.profiler=simple", f"output_dir={tmp_path}", code=0,
    )  # fmt: skip
    run = find_run(tmp_path)
    assert "stopped early after epoch 1" in done.out
    assert "run_training_epoch" in done.out  # what took the time
    (report,) = (run / "profile").iterdir()
    assert "[Callback]AveragedWeights" in report.read_text()
    best = torch.load(run / "checkpoints" / "best.ckpt", weights_only=True)
    trained = best["trained_state"]
    network = PoseEstimator.load(run / "checkpoints" / "best.ckpt").checkpoint.state_dict
    averaged = {name: best["state_dict"][f"network.{name}"] for name in network}
    assert all(torch.equal(network[name], averaged[name]) for name in network)
    assert any(not torch.equal(averaged[name], trained[f"network.{name}"]) for name in network)


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
