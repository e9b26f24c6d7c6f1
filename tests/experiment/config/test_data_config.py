"""Which data an evaluation uses: the checkpoint's, another set, or some options changed."""

from dataclasses import replace
from pathlib import Path

import pytest

from dopepp.core.errors import UserError
from dopepp.experiment.assembly.build_sources import share_of
from dopepp.experiment.config.data_config import DataConfig, evaluation_data, stored_config
from dopepp.experiment.config.run_config import EvaluationConfig
from dopepp.models.checkpoint import read

PRETRAINED = sorted((Path(__file__).parents[3] / "dopepp" / "pretrained").glob("*.safetensors"))


@pytest.fixture
def trained(tiny):
    return tiny("data.num_test=300")


@pytest.fixture
def stored(trained):
    """Data config as stored in a checkpoint."""
    return trained.stored_data()


@pytest.fixture
def evaluated(composed):
    """Select the data of ``evaluate.py`` from the stored config and overrides."""

    def choose(stored: object, *overrides: str) -> DataConfig:
        options = EvaluationConfig.of(composed(*overrides, config="evaluate"))
        return evaluation_data(options.data, options.virtual, stored, "best.ckpt")

    return choose


def test_the_checkpoints_own_data_by_default(evaluated, stored, trained):
    assert evaluated(stored) == trained.data


def test_single_options_replace_stored_options(evaluated, stored, trained):
    data = evaluated(
        stored, "++data.num_test=7", "data/test=photoreal", "++data.image_sets.test=other",
        "++virtual.preset=wide", "++virtual.scene.turning.tilt_deg=10",
    )  # fmt: skip
    virtual = replace(trained.data.virtual, preset="wide", scene={"turning": {"tilt_deg": 10}})
    test = replace(trained.data.test, renderer="photoreal", cache="disk")
    sets = {**trained.data.image_sets, "test": "other"}
    assert data == replace(trained.data, num_test=7, test=test, image_sets=sets, virtual=virtual)
    assert stored["num_test"] == 300


def test_a_whole_data_node_keeps_only_the_stored_render_options(evaluated, stored, trained):
    data = evaluated(stored, "data=virtual", "data.num_test=5")
    assert (data.name, data.num_test, data.samples_per_epoch) == ("virtual", 5, 10000)
    assert data.virtual == trained.data.virtual
    whole = evaluated(stored, "data=virtual", "virtual=default", "virtual.preset=table")
    assert whole.virtual == replace(trained.data.virtual, preset="table")
    # Labelled images need no renders.
    assert evaluated(None, "data=bop", "data.root=x").virtual.preset is None


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("++data.num_tests=5", r"data\.num_tests=5.*num_test"),
        ("++data.num_test=many", r"best\.ckpt.*data\.num_test='many'"),
        ("++data.masking.share=1", r"data\.masking\.share=1"),
        ("++virtual.presets=bin", r"virtual\.presets='bin'; allowed: preset"),
        ("++data.virtual.preset=bin", r"data\.virtual=.*"),
    ],
)
def test_unknown_options_are_named(override, message, evaluated, stored):
    with pytest.raises(UserError, match=message):
        evaluated(stored, override)


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("++data.num_test=5", r"best\.ckpt, which contains no data config"),
        ("data=virtual", r"best\.ckpt, which contains no options of the renders"),
    ],
)
def test_a_checkpoint_without_a_data_config_is_rejected(override, message, evaluated):
    with pytest.raises(UserError, match=message):
        evaluated(None, override)


@pytest.mark.parametrize("path", PRETRAINED, ids=lambda path: path.stem)
def test_the_data_of_released_checkpoints_are_read(path, evaluated):
    stored = stored_config(read(path).data)
    data = evaluated(stored)
    assert data.virtual.preset == stored["virtual"]["preset"]
    assert (data.num_test, data.is_rendered("test")) == (300, True)


def test_a_folder_that_splits_share_is_divided():
    shared = {"train": "a", "val": "a", "test": "a"}
    ranges = [share_of(shared, split) for split in ("train", "val", "test")]
    assert ranges == [(0.0, 0.8), (0.8, pytest.approx(0.9)), (pytest.approx(0.9), 1.0)]
    assert ranges[1][1] == ranges[2][0]
    assert share_of({"train": "a", "val": "b", "test": "b"}, "train") == (0.0, 1.0)
    assert share_of({"train": "a", "val": "b", "test": "b"}, "test") == (0.5, 1.0)
    assert share_of({"train": "a", "val": "a", "test": "b"}, "val") == (0.8, 1.0)
    assert share_of({"train": "a", "val": "b", "test": "a"}, "test") == (0.8, 1.0)


@pytest.mark.parametrize(
    ("seen_on", "preset", "turning"),
    [(None, "wide", "facing"), ("front", "wide", "facing"), ("any", "wide", "free"),
     ("table", "table", "free"), ("bin", "heap", "free")],
)  # fmt: skip
def test_seen_on_selects_preset_and_rotations(seen_on, preset, turning, parsed):
    chosen = () if seen_on is None else (f"seen_on={seen_on}",)
    scenes = parsed("experiment=my_part", *chosen).data.preset
    assert (scenes.name, scenes.turning.kind) == (preset, turning)
    assert (scenes.table is not None) == (preset != "wide")


@pytest.mark.parametrize(
    ("materials", "changes"),
    [
        ("mixed", {}),
        ("metal", {"metal_share": 0.8, "metal_roughness": (0.1, 0.5)}),
        ("plastic", {"metal_share": 0.0, "print_share": 0.0}),
        ("print", {"metal_share": 0.0, "print_share": 1.0}),
    ],
)
@pytest.mark.parametrize("seen_on", ["front", "bin"])
def test_materials_change_surfaces_and_metals_see_panels(seen_on, materials, changes, parsed):
    options = ("experiment=my_part", f"seen_on={seen_on}")
    mixture = parsed(*options).data.preset
    chosen = parsed(*options, f"materials={materials}").data.preset
    assert chosen.materials == replace(mixture.materials, **changes)
    assert (chosen.lighting == mixture.lighting) == (materials != "metal")
    assert chosen.lighting.num_panels == ((1, 5) if materials == "metal" else (0, 0))
