"""A user's mistake ends in one line on stderr with got, allowed and fix, and exit code 2."""

import os
import re
from pathlib import Path
from typing import Any

import pytest
import torch


@pytest.fixture
def train(call, tiny, tmp_path):
    """A tiny training with overrides; its mistake must be the only line, and nothing is begun."""

    def run(*overrides: str) -> str:
        output_dir = tmp_path / "outputs"
        done = call("train.py", *tiny, *overrides, f"output_dir={output_dir}")
        line: str = done.line
        assert done.err.count("\n") == 1, done.err
        assert not list(output_dir.glob("**/versions.json"))
        assert not list(output_dir.glob("**/*.ckpt"))
        return line

    return run


@pytest.mark.parametrize(("overrides", "expected"), [
    (["data.bach_size=4"], "override 'data.bach_size', which names no option; allowed: the "
                           "options of `--cfg job`, nearest data.batch_size"),
    (["bop_csv=true"], "'bop_csv', which names no option; allowed: the options of `--cfg job`; "
                       "bop_csv is an option of evaluate.py"),
    (["model/attention=cbm"], "model/attention=cbm; allowed: cbam none se"),
    (["trainer.max_epochs"], "trainer.max_epochs"),
    (["trainer.max_epochs=1,2"], "Ambiguous value"),
    (["trainer.max_epochs=many"], "trainer.max_epochs='many'; allowed: an integer from 1"),
    (["trainer.precision=17"], "which Lightning rejects"),
    (["trainer.accelerator=abacus"], "which Lightning rejects"),
], ids=lambda value: value[0] if isinstance(value, list) else "")  # fmt: skip
def test_a_mistake_in_the_overrides(overrides, expected, train):
    assert expected in train(*overrides)


def test_a_frame_that_breaks_in_training_ends_it(ycb_root, call, tmp_path):
    """The training data are read by worker processes; their mistake reaches the user as it is."""
    root = tmp_path / "ycb"
    for frame in ("0000/000001", "0050/000003"):
        for path in ycb_root.glob(f"data/{frame}-*"):
            copy = root / path.relative_to(ycb_root)
            copy.parent.mkdir(parents=True, exist_ok=True)
            copy.write_bytes(path.read_bytes())
    for name in ("models", "image_sets"):
        (root / name).symlink_to(ycb_root / name)
    # Cut in the middle, where OpenCV alone would return half of the image.
    image = root / "data" / "0050" / "000003-color.png"
    image.write_bytes(image.read_bytes()[: image.stat().st_size // 2])
    done = call(
        "train.py", "data=ycb_video", f"data.root={root}", "model.width=0.0625",
        "data.objects=[003_cracker_box]", "data.input_size=[64,64]", "data.batch_size=1",
        "data.samples_per_epoch=2", "data.num_workers=1", "trainer=cpu", "trainer.max_epochs=1",
        "data.image_sets={train: train, val: train, test: train}", "data.masking._target_=null",
        f"output_dir={tmp_path / 'outputs'}",
    )  # fmt: skip
    assert "000003-color.png" in done.line
    assert not list(tmp_path.glob("outputs/**/metrics.json"))


def hostile_pickle(path: Path) -> None:
    class Command:
        def __reduce__(self) -> tuple[Any, tuple[str]]:
            return os.mkdir, (str(path.parent / "trace"),)

    torch.save({"state_dict": Command(), "dopepp": {}}, path)


@pytest.mark.parametrize(
    ("write", "place", "expected"),
    [
        (hostile_pickle, "ckpt_path", "which torch cannot load"),
        (hostile_pickle, "init_from", "which torch cannot load"),
        (lambda path: None, "baseline", "which is not a file"),
    ],
)
def test_a_file_that_is_no_checkpoint(write, place, expected, trained, call, train, tmp_path):
    good, bad = trained[0] / "checkpoints" / "best.ckpt", tmp_path / "bad.ckpt"
    write(bad)
    if place == "init_from":
        line = train(f"init_from={bad}")
    else:
        others = [f"ckpt_path={good}"] if place == "baseline" else []
        folder = tmp_path / "evaluations"
        done = call("evaluate.py", *others, f"{place}={bad}", f"output_dir={folder}")
        line = done.line
        assert done.err.count("\n") == 1
        assert not list(folder.glob("**/versions.json"))
    assert expected in line
    assert str(bad) in line
    assert not (tmp_path / "trace").exists()


def test_the_shell_sees_one_line_and_code_two(command, tmp_path):
    done = command("train.py", "data.objects=[003_cracker_box]", f"output_dir={tmp_path}")
    assert "data.objects=['003_cracker_box'] without data.root" in done.line
    assert done.err.count("\n") == 1
    assert re.fullmatch("begins in .*\n", done.out)


def test_a_failed_job_of_an_evaluation_multirun_ends_it_with_code_1(call, tmp_path):
    files = "ckpt_path=/absent/a.ckpt,/absent/b.ckpt"
    call("evaluate.py", "-m", files, f"output_dir={tmp_path}", code=1)
    failures = sorted(tmp_path.glob("evaluate/*/*/failed.json"))
    assert [path.parent.name for path in failures] == ["0", "1"]
    assert "got /absent/b.ckpt, which is not a file" in failures[1].read_text()
