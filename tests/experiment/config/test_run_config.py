"""Options are parsed once; wrong values are rejected in one line."""

import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from dopepp.core.errors import UserError
from dopepp.experiment.command_line import EVALUATION_SHORT_NAMES
from dopepp.experiment.config.run_config import EvaluationConfig, Protocols, RunConfig
from dopepp.experiment.entries import entry

WRONG = (
    "+speed=1", "seed=-1", "seed=1.5", "compile=1", "ema=nan", "num_empty=0", "num_empty=2.5",
    "maps.sigma=0", "false_positive_rate=1.5", "data.eval_seed=-1", "data.batch_size=0",
    "data.num_val=0", "data.num_workers=-1", "data.real_fraction=1.5", "data.input_size=64",
    "data.root=1", "lr_finder.num_steps=9", "trainer.max_epochs=0", "+trainer.num_nodes=0",
    "trainer.ddp_timeout_s=0", "cost.batch_size=0.5", "stop_at=1.5",
)  # fmt: skip


@pytest.mark.parametrize(("override", "got"), [
    *((option, option.lstrip("+")) for option in WRONG),
    ("+data.colour=red", "data.colour='red'"),
    ("+virtual.colour=red", "virtual.colour='red'"),
    ("++data.virtual.preset=table", "data.virtual={'preset': 'table'}"),
    ("+virtual.scene.colour=red", "virtual.scene.colour='red'"),
    ("++virtual.scene.turning.tilt_deg=-1", "virtual.scene.turning.tilt_deg=-1"),
    ("virtual.preset=blue", "preset 'blue'"),
    ("~data.batch_size", "no data.batch_size"),
    ("~trainer", "no trainer.max_epochs"),
    ("data.parts=pivconnector", "data.parts='pivconnector'"),
    ("job=mow", "job='mow'"),
    ("seed=true", "seed=True"),
    ("tune=maybe", "tune='maybe'"),
    ("resume=[a]", "resume=['a']"),
    ("recovery.max_peaks=all", "recovery.max_peaks='all'"),
    ("data.parts=[1]", "data.parts[0]=1"),
    ("data.input_size=[100,64]", "data.input_size=[100, 64]"),
    ("data.test.cache=tape", "data.test.cache='tape'"),
    ("data.masking=none", "data.masking='none'"),
    ("data.image_sets={train: 1}", "data.image_sets.train=1"),
    ("model.backbone=vgg", "model.backbone='vgg'"),
    ("lr_finder.max_lr=1e-7", "lr_finder.max_lr=1e-07"),
    ("trainer.profiler=slow", "trainer.profiler='slow'"),
])  # fmt: skip
def test_a_wrong_option_is_named(override, got, composed):
    with pytest.raises(UserError) as error:
        RunConfig.of(composed(override))
    assert error.value.got == got
    assert error.value.allowed
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("override", "got"),
    [("bop_csv=1", "bop_csv=1"), ("num_pictures=-1", "num_pictures=-1"), ("+x=1", "x=1"),
     ("tune=1", "tune=1"), ("ckpt_path=[a]", "ckpt_path=['a']")],
)  # fmt: skip
def test_a_wrong_option_of_an_evaluation_is_named(override, got, composed):
    with pytest.raises(UserError) as error:
        EvaluationConfig.of(composed(override, config="evaluate"))
    assert error.value.got == got


@pytest.mark.parametrize(
    ("override", "terms"),
    [("refine=null", None), ("refine=depth", "depth"),
     ("refine=[region,depth]", ("region", "depth"))],
)  # fmt: skip
def test_refine_is_a_term_or_a_list_of_terms(override, terms, composed):
    assert EvaluationConfig.of(composed(override, config="evaluate")).refine == terms
    with pytest.raises(UserError, match=r"refine\[0\]=3"):
        EvaluationConfig.of(composed("refine=[3]", config="evaluate"))


def test_values_are_typed_and_the_plain_config_is_unchanged(composed):
    plain = composed("data.root=photos", "+trainer.limit_val_batches=2", "ema=0.5", "shading=0.4")
    config = RunConfig.of(plain)
    assert (config.plain, config.data.root) == (plain, Path("photos"))
    assert (config.data.input_size, config.data.parts[0]) == ((416, 416), "servoholder")
    assert config.trainer.lightning["limit_val_batches"] == 2
    assert config.protocols.shading == (0.4,)
    assert type(config.recovery["max_peaks"]) is int
    assert (config.num_empty, config.stored_data()["virtual"]) == (90, plain["virtual"])
    assert (config.ema, config.logger, config.search) == (0.5, None, None)


def test_classes_of_ndds_are_typed_as_on_the_page(parsed):
    assert parsed("data=ndds", "data.classes={Mug_01: mug}").data.classes == {"Mug_01": "mug"}


OPTIONS: dict[str, Any] = {"shading": None, "by": None, "num_bins": 5, "scale_factors": None}
SHARES = r"shading=.*; allowed: shares .* 0 to 1"
FACTORS = r"scale=.*; allowed: factors from 0\.05 to 20"


NAN, INF = float("nan"), float("inf")


@pytest.mark.parametrize(("option", "message", "given"), [
    ("by", "by=.*; allowed: one or more of distance, visibility, size, rotation",
     [["distance", "colour"], "sice", [], [["size"]]]),
    ("shading", SHARES, [[0.2, 80], "20%", [True], [], [0], [NAN], {"a": 1}]),
    ("scale_factors", FACTORS, [0, [0.5, 0], [-1], [NAN], [INF], [21], [1], [], "big", [True]]),
    ("num_bins", "num_bins=0; allowed: an integer from 1", [0]),
])  # fmt: skip
def test_wrong_options_are_reported_in_one_line(option, message, given):
    for value in given:
        with pytest.raises(UserError, match=message) as error:
            Protocols.of({**OPTIONS, option: value})
        assert "\n" not in str(error.value)


def test_levels_are_sorted_and_unique():
    assert not Protocols.of(OPTIONS)
    given = Protocols.of({**OPTIONS, "shading": [0.8, 0, 0.2, 0.2, 1], "by": "size"})
    assert given == Protocols((0.2, 0.8, 1.0), by=("size",), num_bins=5)
    assert given
    assert Protocols.of({**OPTIONS, "shading": 0.4}).shading == (0.4,)
    assert Protocols.of({**OPTIONS, "scale_factors": 2}).scales == (2.0,)


def test_scale_is_a_short_name(composed, monkeypatch):
    monkeypatch.setattr(sys, "argv", ["evaluate.py", "scale=[0.5,1,2]", "data.num_test=3"])
    monkeypatch.setenv("HYDRA_FULL_ERROR", "1")
    seen: list[str] = []
    entry(lambda: seen.extend(sys.argv[1:]), ["data"], EVALUATION_SHORT_NAMES)
    assert seen == ["scale_factors=[0.5,1,2]", "++data.num_test=3"]
    config = composed(seen[0], config="evaluate")
    assert Protocols.of(config) == Protocols(scales=(0.5, 2.0))
    assert not replace(Protocols.of(config), scales=())
    assert not Protocols.of(composed())  # a training has no such option
