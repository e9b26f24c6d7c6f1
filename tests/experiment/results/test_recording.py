"""Poses of another method are read, measured and written by an evaluation."""

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from dopepp.core.errors import UserError
from dopepp.core.files import read_csv
from dopepp.data.formats.bop.bop_models import bop_parts
from dopepp.data.formats.bop.bop_reader import BopReader
from dopepp.data.formats.bop.bop_results import BopResult, read_results, write_results
from dopepp.data.formats.bop.bop_writer import BopWriter
from dopepp.data.rendered import rendered_sample
from dopepp.data.sample import Sample
from dopepp.experiment.results.measurement import image_id, object_numbers
from dopepp.experiment.results.report import Cost
from dopepp.parts.catalogue import pivconnector, servoholder
from dopepp.virtual.factory import Factory
from dopepp.virtual.presets import PRESETS
from tests.data.makers import write_set

NUM_IMAGES = 4
SPLITS = "data.image_sets={train: none, val: none, test: train_pbr}"


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    """A BOP data set of two parts on every image."""
    parts = [servoholder(), pivconnector()]
    factory = Factory(parts, PRESETS["bin"].resized(160, 120), seed=11)
    samples = [rendered_sample(factory.render(0, n), "virtual", str(n)) for n in range(NUM_IMAGES)]
    return write_set(BopWriter, tmp_path_factory.mktemp("two-parts"), parts, samples)


@pytest.fixture
def results_of(root, evaluate):
    """Evaluate the poses of a file, which is written first, on the data set."""

    def run(path, *others, poses=None, folder="run"):
        if poses is not None:
            write_results(path, poses)
        options = ("data=bop", f"data.root={root}", SPLITS, "num_pictures=1", f"results={path}")
        return evaluate(*options, *others, folder=folder)

    return run


def results(root: Path, offset: float = 0.0) -> list[BopResult]:
    """Return the truth, moved along x, with scores and times."""
    parts = bop_parts(root)
    numbers = {part.name: number for number, part in enumerate(parts, 1)}
    source = BopReader(root, parts, "train_pbr")
    poses = []
    for index in range(len(source)):
        for instance in source.sample(index).instances:
            T = instance.T_cam_obj.copy()
            T[0, 3] += offset
            poses.append(BopResult(0, index, numbers[instance.label], 0.5, T, 0.25))
    return poses


def test_poses_of_a_file_are_measured_and_written_again(root, results_of, tmp_path, capsys):
    poses = results(root, 0.002)
    (report,) = results_of(tmp_path / "posecnn_two-test.csv", "bop_csv=true", poses=poses)
    assert report.name == report.mean.method == "posecnn"
    assert report.cost == Cost(None, None, 250)
    for name in ("servoholder", "pivconnector"):
        counted = [error for error in report.errors[name] if np.isfinite(error)]
        assert counted == pytest.approx([0.002] * len(counted), rel=1e-6)
        row = report.rows[name]
        assert (row.ar_mssd, row.average_precision) == (1, 1)
        assert row.ar_mspd is not None
    shown = capsys.readouterr().out
    assert "AR_MSPD %" in shown
    assert "ADD-S-0.1d %" not in shown

    written = tmp_path / "run" / f"posecnn_{root.name.replace('-', '')}-train-pbr.csv"
    for read, pose in zip(read_results(written, {1, 2}), poses, strict=True):
        np.testing.assert_allclose(read.T_cam_obj[:3, 3], pose.T_cam_obj[:3, 3], atol=1e-6)
    (second,) = results_of(written, "method=again", folder="second")
    assert {name: vars(row) | {"method": ""} for name, row in second.rows.items()} == {
        name: vars(row) | {"method": ""} for name, row in report.rows.items()
    }
    record = json.loads((tmp_path / "second" / "metrics.json").read_text())
    assert record["objects"]["mean"]["ar_mspd"] == report.mean.ar_mspd
    columns = read_csv(tmp_path / "second" / "auc.csv")[0]
    assert list(columns)[1:] == ["servoholder", "pivconnector"]


def test_metrics_json_describes_the_network_not_the_file(root, results_of, tmp_path):
    network = ("ckpt_path=pretrained/pivconnector", "refine=region")
    reports = results_of(tmp_path / "other_two-test.csv", *network, poses=results(root))
    assert [report.name for report in reports] == ["dopepp_fast", "dopepp_fast + region", "other"]
    written = json.loads((tmp_path / "run" / "metrics.json").read_text())
    assert written == reports[0].to_record()
    assert written["refined"]["name"] == "dopepp_fast + region"
    assert "| other " not in (tmp_path / "run" / "README.md").read_text()


def test_poses_beside_the_test_set_are_left_out(root, results_of, tmp_path, caplog):
    poses = results(root)
    elsewhere = BopResult(7, 0, 1, 0.9, poses[0].T_cam_obj)
    chosen = ("data.objects=[pivconnector]", "num_pictures=0")
    (report,) = results_of(tmp_path / "results.csv", *chosen, poses=[*poses, elsewhere])
    assert list(report.rows) == ["pivconnector", "mean"]
    others = sum(pose.obj_id == 1 for pose in poses)
    assert f"ignoring 1 poses on images outside the test set and {others} poses" in caplog.text


def test_a_results_file_of_other_data_is_rejected(root, results_of, tmp_path):
    poses = [replace(results(root)[0], scene_id=3)]
    with pytest.raises(UserError, match=r"results\.csv.* outside the test set, e.g. scene 3"):
        results_of(tmp_path / "results.csv", poses=poses)


@pytest.mark.parametrize(
    ("source", "key", "expected"),
    [
        ("bop/test", "000048/000017", (48, 17)),
        ("webdataset/shards", "000048_000017", (48, 17)),
        ("ycb_video/data", "0050/000003", (50, 3)),
        ("virtual", "test/0/12", (0, 5)),
        ("ndds/folder", "12/000034", (0, 5)),
        ("webdataset/shards", "photo-7", (0, 5)),
    ],
)
def test_images_have_bops_numbers_or_their_place(source, key, expected):
    sample = Sample(np.zeros((1, 1, 3), np.uint8), np.eye(3), source=source, key=key)
    assert image_id(sample, 5) == expected


def test_objects_have_their_data_sets_numbers(root, ycb_root):
    piv = pivconnector()
    bop: Any = SimpleNamespace(root=root, format="bop")
    assert object_numbers(bop, [piv]) == {"servoholder": 1, "pivconnector": 2}
    frames: Any = SimpleNamespace(root=ycb_root, format="ycb_video")
    ycb = object_numbers(frames, [])
    assert len(ycb) == 21
    assert (ycb["002_master_chef_can"], ycb["003_cracker_box"]) == (1, 2)
    bop.root = None
    assert object_numbers(bop, [piv]) == {"pivconnector": 1}
