import copy
import json
import math

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import KDTree

from dopepp.core.errors import UserError
from dopepp.parts import Part, make_part, servoholder
from dopepp.parts.part import MAX_LIGHT_FACES, MAX_POINTS, Mesh


def symmetric_part():
    symmetries = {
        "symmetries_discrete": np.diag([-1.0, -1, 1, 1])[None],
        "symmetries_continuous": (((0.0, 0.0, 1.0), (0.01, 0.0, 0.0)),),
    }
    return make_part("holder", servoholder().mesh, **symmetries)


RECORD = make_part("p", None, np.array([[0.0, 0, 0], [0.1, 0.2, 0.3]])).to_record()
BAD_CUBOIDS = {
    "8 rows": RECORD["cuboid"][:8],
    "reversed": RECORD["cuboid"][::-1],
    "two corners swapped": [RECORD["cuboid"][i] for i in (1, 0, 2, 3, 4, 5, 6, 7, 8)],
    "centre elsewhere": [*RECORD["cuboid"][:8], [0.0, 0.0, 0.0]],
    "4 columns": [[*row, 0.0] for row in RECORD["cuboid"]],
}
TRIANGLE = {"vertices": [[0, 0, 0], [0.1, 0, 0], [0, 0.1, 0]], "faces": [[0, 1, 2]]}


@pytest.mark.parametrize("part", [servoholder(), symmetric_part()], ids=lambda p: p.name)
def test_a_record_is_unchanged_by_json(part):
    again = Part.from_record(json.loads(json.dumps(part.to_record())))
    corners, expected = (item.mesh.vertices[item.mesh.faces] for item in (again, part))
    np.testing.assert_allclose(corners, expected, atol=0.6e-7)
    for field in ("name", "diameter", "mesh_hash", "cuboid", "points", "symmetries_continuous"):
        np.testing.assert_array_equal(getattr(again, field), getattr(part, field))
    assert (again.symmetries_discrete is None) == (part.symmetries_discrete is None)
    if part.symmetries_discrete is not None:
        np.testing.assert_array_equal(again.symmetries_discrete, part.symmetries_discrete)
    assert again.to_record() == part.to_record()


def test_a_record_holds_few_triangles_and_their_deviation():
    sphere = trimesh.creation.icosphere(6, 0.05)  # 81,920 triangles
    light, deviation = make_part("ball", Mesh(sphere.vertices, sphere.faces)).light_mesh
    assert 2000 < len(light.faces) <= MAX_LIGHT_FACES
    solid = trimesh.Trimesh(light.vertices, light.faces)
    points, _ = trimesh.sample.sample_surface(solid, 300_000, seed=0)
    away = KDTree(points).query(sphere.vertices)[0].max()
    assert away - 0.0005 < deviation < 1.05 * away
    assert deviation < 0.001


def test_no_symmetries_differ_from_unknown_ones():
    known = Part.from_record({**RECORD, "symmetries_discrete": []})
    assert known.symmetries_discrete.shape == (0, 4, 4)


def mesh(**change):
    return {**TRIANGLE, "deviation": 0.0, **change}


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        ("name", "", "part name ''"),
        ("name", "x" * 201, "1–200 printable"),
        ("name", "a\x1b[2Jb", "printable"),
        ("diameter", 0.0, "diameter=0.0; .*greater than 0"),
        ("diameter", math.nan, "diameter=nan; .*finite"),
        ("diameter", True, "diameter=True; .*finite"),
        ("points", [], "points=.*at least 1 "),
        ("points", [[0.0, 0.0]], r"no part.points\[0\]\[2\]"),
        ("points", [[0.0, 0.0, -math.inf]], r"points\[0\]\[2\]=-inf; .*finite"),
        ("points", [[0.0, 0.0, 1e300]], r"points\[0\]\[2\]=1e\+300; .*1000000"),
        ("points", [[0, 0, 0]] * (MAX_POINTS + 1), "at most 100000 items"),
        ("mesh_hash", "abc", "mesh_hash='abc'; .*a-f"),
        ("symmetries_discrete", [[[1.0] * 4] * 4], "not a rigid transform"),
        ("symmetries_discrete", [(2 * np.eye(4)).tolist()], "not a rigid transform"),
        ("symmetries_discrete", [np.diag([1, 1, -1, 1]).tolist()], "not a rigid transform"),
        ("symmetries_discrete", [np.eye(4).tolist()] * 1001, "at most 1000 items"),
        ("symmetries_continuous", [[[0, 0, 0], [0, 0, 0]]], "axis of length 0"),
        ("symmetries_continuous", [[[0, 0, 1]]], "symmetries_continuous"),
        ("mesh", mesh(deviation=-1), "mesh.deviation=-1"),
        ("mesh", mesh(faces=[[0, 1, 3]]), "whose faces use a missing vertex"),
        ("mesh", mesh(faces=[[0, 1, -1]]), r"mesh.faces\[0\]\[2\]=-1"),
        ("mesh", mesh(faces=[]), "at least 1 "),
        ("mesh", mesh(faces=[[0, 1, 2]] * (MAX_LIGHT_FACES + 1)), "at most 4000 items"),
        ("mesh", mesh(texture=[]), r"mesh.texture=\[\]; allowed: vertices, faces, deviation"),
        *[("cuboid", rows, "cuboid") for rows in BAD_CUBOIDS.values()],
    ],
)
def test_a_bad_field_is_named(field, value, message):
    with pytest.raises(UserError, match=message) as caught:
        Part.from_record({**RECORD, field: value})
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 500


@pytest.mark.parametrize(
    ("record", "message"),
    [
        *((other, "part") for other in (None, [], 1, {}, {1: 2}, {**RECORD, "more": None})),
        *(({key: RECORD[key] for key in RECORD if key != field}, f"no part.{field}")
          for field in RECORD),
    ],
)  # fmt: skip
def test_other_values_and_missing_fields_are_refused(record, message):
    with pytest.raises(UserError, match=message):
        Part.from_record(record)


JUNK = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text() | st.binary(),
    lambda inner: st.lists(inner, max_size=9) | st.dictionaries(st.text(), inner, max_size=5),
    max_leaves=40,
)


PLACES = st.none() | st.tuples(st.integers(0, 1), st.integers(0, 2))


@settings(max_examples=100)
@given(st.sampled_from(sorted(RECORD)), PLACES, JUNK)
def test_junk_in_a_field_or_a_number_is_refused_or_valid(field, place, junk):
    record = copy.deepcopy(RECORD)
    if place is None or field not in ("cuboid", "points"):
        record[field] = junk
    else:
        record[field][place[0]][place[1]] = junk
    try:
        part = Part.from_record(record)
    except UserError:
        return
    assert part.diameter > 0
    assert part.cuboid.shape == (9, 3)
    assert np.isfinite([*part.cuboid.flat, *part.points.flat]).all()
