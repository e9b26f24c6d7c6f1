"""OFF files, and polygons cut into fans."""

import numpy as np
import pytest
import trimesh
from trimesh.exchange.off import export_off

from dopepp.parts import read_mesh
from dopepp.parts.mesh.polygons import FoldedPolygonError, fans

BOX = trimesh.creation.box((10.0, 20.0, 30.0))
QUADS = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
SQUARE = np.array([[0.0, 0, 0], [2, 0, 0], [2, 2, 0], [0, 2, 0]])
DART = np.array([[2.0, 0, 1], [0.5, 0.5, 1], [0, 2, 1], [0, 0, 1]])
ROUND = np.array([[np.cos(angle), np.sin(angle), 0] for angle in np.arange(12) * np.pi / 6])


def off(faces: list[list[int]], vertices: np.ndarray = BOX.vertices) -> str:
    rows = [" ".join(map(str, row)) for row in vertices.tolist()]
    rows += [" ".join(map(str, [len(face), *face])) for face in faces]
    return f"OFF\n{len(vertices)} {len(faces)} 0\n" + "\n".join(rows) + "\n"


def test_fans_lie_around_first_corners():
    triangles = fans(ROUND, np.arange(12), np.array([3, 5, 4]))
    assert triangles.tolist() == [
        [0, 1, 2], [3, 4, 5], [3, 5, 6], [3, 6, 7], [8, 9, 10], [8, 10, 11]
    ]  # fmt: skip
    with pytest.raises(ValueError, match="face 1 of fewer than 3 corners"):
        fans(ROUND, np.arange(5), np.array([3, 2]))


@pytest.mark.parametrize("other", [DART, SQUARE[[0, 2, 1, 3]]], ids=["dart", "bow tie"])
def test_a_fan_over_a_dent_is_folded(other):
    corners, counts = np.arange(8), np.array([4, 4])
    assert len(fans(np.vstack([SQUARE, SQUARE]), corners, counts)) == 4
    with pytest.raises(FoldedPolygonError, match="not convex, face 1"):
        fans(np.vstack([SQUARE, other]), corners, counts)
    # A face of a vertex that is not there is not judged.
    assert len(fans(np.vstack([SQUARE, other]), corners + 1, counts)) == 4


def test_off_polygons_and_dialects(write):
    text = off([*QUADS[:3], [2, 3, 7], [2, 7, 6], *QUADS[4:]])
    for number, dialect in enumerate([
        text, off(BOX.faces.tolist()), off(QUADS), export_off(BOX),
        text.replace("\n", "\r\n"), text.replace("OFF\n", "OFF"),
        "# a box\n\n" + text.replace("9 0\n", "9 0 # counts\n\n"),
        text.replace("3 2 3 7", "3 2 3 7 255 0 0"),
    ]):  # fmt: skip
        loaded = read_mesh(write(f"{number}.off", dialect), "mm")
        solid = trimesh.Trimesh(loaded.vertices, loaded.faces, process=False)
        assert solid.is_volume
        assert solid.volume == pytest.approx(6e-6)
        assert len(loaded.faces) == 12


def test_a_prism_of_hexagons_in_an_off_file(write):
    ring = ROUND[::2]
    sides = [[i, (i + 1) % 6, 6 + (i + 1) % 6, 6 + i] for i in range(6)]
    faces = [[5, 4, 3, 2, 1, 0], *sides, [6, 7, 8, 9, 10, 11]]
    vertices = np.concatenate([ring, ring + np.array([0, 0, 2])])
    loaded = read_mesh(write("a.off", off(faces, vertices)), "cm")
    solid = trimesh.Trimesh(loaded.vertices, loaded.faces, process=False)
    assert solid.volume == pytest.approx(3 * np.sqrt(3) * 1e-6)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("8 6", "8 5", "14 lines where its header promises 8 .* 5 faces"),
        ("8 6", "8 7", "14 lines where its header promises 8 .* 7 faces"),
        ("4 0 1 3 2", "2 0 1", "face 0 of fewer than 3 corners"),
        ("4 0 1 3 2", "4 0 1 3 8", "a face index outside of its 8"),
        ("4 0 1 3 2", "4 0 1 3 1.5", "invalid literal"),
        ("4 0 1 3 2", "4 0 3 1 2", "a polygon that is not convex, face 0"),
        ("OFF", "4OFF", "no OFF header"),
        ("-5.0", "five", "could not convert"),
        ("-5.0", "nan", "not a finite number, vertex 1"),
    ],
)
def test_a_damaged_off_file_is_named(refused, old, new, message):
    refused("a.off", off(QUADS).replace(old, new, 1), message)
