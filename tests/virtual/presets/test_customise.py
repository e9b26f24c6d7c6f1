"""Presets changed by plain values: nested, converted, and refused where they are wrong."""

from __future__ import annotations

from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dopepp.core.errors import UserError
from dopepp.virtual.presets.preset import PRESETS, customised_preset
from dopepp.virtual.presets.table import Table


def test_nested_fields_change_and_the_others_stay() -> None:
    preset = customised_preset(
        "table",
        {
            "targets_per_image": [0, 2],
            "materials": {"metal_share": 1, "layer_pitch": [0.0001, 0.0002]},
            "table": {"distance": (0.3, 0.4), "heaped": True},
            "sensors": {"jpeg_quality": [50, 60]},
            "distractors": {"number": [0, 8]},
        },
    )
    original = PRESETS["table"]
    assert preset.targets_per_image == (0, 2)
    assert preset.materials.metal_share == 1.0
    assert isinstance(preset.materials.metal_share, float)
    assert preset.materials.layer_pitch == (0.0001, 0.0002)
    assert preset.materials.print_share == original.materials.print_share
    assert preset.table is not None
    assert preset.table.distance == (0.3, 0.4)
    assert preset.table.heaped
    assert preset.sensors.jpeg_quality == (50, 60)
    assert preset.lighting == original.lighting
    assert PRESETS["table"] == original


def test_groups_come_and_go() -> None:
    assert customised_preset("paper", {"table": {}}).table == Table()
    assert customised_preset("paper", {"table": {"roll_deg": 5}}).table == Table(roll_deg=5.0)
    assert customised_preset("bin", {"table": None}).table is None
    narrow = customised_preset("ycb", {"intrinsics_px": None, "horizontal_fov_deg": 40})
    assert narrow.intrinsics_px is None
    assert narrow.K[0, 0] == pytest.approx(320 / 0.36397, rel=1e-4)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"colour": 1}, "'colour' in preset paper; allowed: name, width"),
        ({"materials": {"metal": 1}}, "'metal' in materials of preset paper"),
        ({"materials": 3}, "3 for materials of preset paper; allowed: a mapping"),
        ({"materials": {"metal_share": True}}, "True for metal_share"),
        ({"materials": {"metal_share": "0.2"}}, "'0.2' for metal_share"),
        ({"materials": {"metal_share": None}}, "None for metal_share"),
        ({"materials": {"metal_share": 1.1}}, r"metal_share=1.1 of Materials"),
        ({"lighting": {"num_lights": [1]}}, r"\[1\] for num_lights .* a list of 2 numbers"),
        ({"lighting": {"num_lights": [1, 2, 3]}}, "a list of 2 numbers"),
        ({"lighting": {"num_lights": 2}}, "a list of 2 numbers"),
        ({"lighting": {"num_lights": [1.0, 2.0]}}, "a whole number"),
        ({"lighting": {"key_intensity": [1.0, 0.5]}}, "smallest <= largest"),
        ({"sensors": {"blur_px": [float("nan"), 1]}}, "nan for blur_px"),
        ({"sensors": {"blur_px": [0, float("inf")]}}, "inf for blur_px"),
        ({"sensors": {"jpeg_quality": [0, 90]}}, "jpeg_quality"),
        ({"placement": {"distance": 10**400}}, "distance of placement"),
        ({"placement": {"distance": 0.05}}, "axial < distance"),
        ({"table": {"heaped": 1}}, "1 for heaped .* true or false"),
        ({"table": {"elevation_deg": [5, 80]}}, "elevation_deg"),
        ({"intrinsics_px": [1, 2]}, "a list of 4 numbers"),
        ({"targets_per_image": [-1, 1]}, "targets_per_image"),
        ({"width": 640.5}, "a whole number"),
        ({"width": 10**9}, "width"),
    ],
)
def test_wrong_changes_are_refused_in_one_line(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(UserError, match=message) as caught:
        customised_preset("paper", changes)
    assert "\n" not in str(caught.value)


def test_unknown_presets_are_refused() -> None:
    with pytest.raises(
        UserError, match="'shelf'; allowed: paper, quickstart, wide, ycb, table, bin"
    ):
        customised_preset("shelf", {})


PLAIN = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=3),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=3), inner),
    max_leaves=4,
)


@given(
    field=st.sampled_from(
        ["width", "table", "materials", "intrinsics_px", "targets_per_image", "placement", "name"]
    ),
    value=PLAIN,
)
def test_any_plain_value_is_taken_or_refused(field: str, value: Any) -> None:
    try:
        preset = customised_preset("paper", {field: value})
    except UserError:
        return
    assert type(preset) is type(PRESETS["paper"])
