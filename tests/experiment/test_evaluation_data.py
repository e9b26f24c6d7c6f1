"""Which data an evaluation uses: the checkpoint's, another set, or some options changed."""

from __future__ import annotations

from typing import Any

import pytest

from dopepp.core.errors import UserError
from dopepp.experiment.build.splits import share_of
from dopepp.experiment.config.chosen_data import chosen_data, trained_on

STORED: dict[str, Any] = {
    "name": "hybrid",
    "num_test": 300,
    "masking": {"probability": 0.5},
    "virtual": {"preset": "quickstart", "scene": {}, "renderer": "raster"},
    "test": {"renderer": None, "cache": "none"},
}


def test_the_checkpoints_own_data_by_default() -> None:
    given = {"data": None, "virtual": None}
    assert chosen_data(given, STORED, "best.ckpt") == STORED


def test_single_options_replace_the_stored_ones() -> None:
    given = {
        "data": {"num_test": 7, "test": {"renderer": "photoreal", "cache": "disk"}},
        "virtual": {"preset": "table", "scene": {"turning": {"tilt_deg": 10.0}}},
    }
    data = chosen_data(given, STORED, "best.ckpt")
    assert data["num_test"] == 7
    assert data["test"] == {"renderer": "photoreal", "cache": "disk"}
    assert data["virtual"]["preset"] == "table"
    assert data["virtual"]["scene"] == {"turning": {"tilt_deg": 10.0}}
    assert data["virtual"]["renderer"] == "raster"
    assert data["masking"] == STORED["masking"]
    assert STORED["num_test"] == 300


def test_a_whole_data_set_keeps_only_how_to_render() -> None:
    given = {"data": {"name": "virtual", "num_test": 5, "virtual": None}}
    data = chosen_data(given, STORED, "best.ckpt")
    assert data == {
        "name": "virtual",
        "num_test": 5,
        "virtual": STORED["virtual"],
        "test": {"renderer": None, "cache": "none"},
    }


@pytest.mark.parametrize(
    ("given", "stored", "message"),
    [
        ({"data": {"num_tests": 5}}, STORED, r"data\.num_tests=5.*num_test"),
        ({"data": {"masking": {"share": 1}}}, STORED, r"data\.masking\.share=1"),
        ({"virtual": {"presets": "bin"}}, STORED, r"virtual\.presets=bin"),
        ({"data": {"num_test": 5}}, None, r"best\.ckpt, which names no data"),
        ({"data": {"name": "virtual"}}, None, r"does not say how to render"),
    ],
)
def test_what_does_not_exist_is_named(given: Any, stored: Any, message: str) -> None:
    with pytest.raises(UserError, match=message):
        chosen_data(given, stored, "best.ckpt")


def test_a_folder_that_splits_share_is_divided() -> None:
    shared = {"train": "a", "val": "a", "test": "a"}
    ranges = [share_of(shared, split) for split in ("train", "val", "test")]
    assert ranges == [(0.0, 0.8), (0.8, pytest.approx(0.9)), (pytest.approx(0.9), 1.0)]
    assert ranges[1][1] == ranges[2][0]
    assert share_of({"train": "a", "val": "b", "test": "b"}, "train") == (0.0, 1.0)
    assert share_of({"train": "a", "val": "b", "test": "b"}, "test") == (0.5, 1.0)
    assert share_of({"train": "a", "val": "a", "test": "b"}, "val") == (0.8, 1.0)
    assert share_of({"train": "a", "val": "b", "test": "a"}, "test") == (0.8, 1.0)


def test_checkpoints_from_before_the_seed_of_evaluation_keep_their_images() -> None:
    assert trained_on({"seed": 7, "config": STORED}) == {"eval_seed": 7, **STORED}
    newer = {**STORED, "eval_seed": 3}
    assert trained_on({"seed": 7, "config": newer}) == newer
    assert trained_on({"seed": 7}) is None
    data = chosen_data(
        {"data": {"eval_seed": 5}}, trained_on({"seed": 7, "config": STORED}), "best.ckpt"
    )
    assert data["eval_seed"] == 5
