"""PLY and OFF files: dialects, wrong counts in headers and lists, and polygons cut into fans."""

import struct
from collections.abc import Sequence

import numpy as np
import pytest
import trimesh
from PIL import Image
from trimesh.exchange.off import export_off

from dopepp.parts import read_mesh
from dopepp.parts.mesh.obj import FoldedPolygonError, fans
from dopepp.parts.mesh.ply import read_ply

BOX = trimesh.creation.box((10.0, 20.0, 30.0))
TRIANGLES = BOX.faces.tolist()
QUADS = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
MIXED = [*QUADS[:3], [2, 3, 7], [2, 7, 6], *QUADS[4:]]
CODES = {"uchar": "B", "int": "i", "uint": "I", "ushort": "H", "int32": "i", "uint8": "B"}
CODES |= {"float": "f", "double": "d"}
FORMATS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
Columns = Sequence[tuple[str, str, Sequence[float]]]
EXTRA = [("uchar", "red", [7] * 8), ("double", "quality", [1.5] * 8)]


def ply(
    form,
    faces,
    *,
    columns=(),
    texture=False,
    extra=False,
    types=("uchar", "int"),
    promised=None,
    count=None,
    newline="\n",
):
    """Write a box with further columns (kind, name, values) per vertex.

    With ``extra``, further columns and a further table stand before, between and behind.
    """
    order, columns = FORMATS[form], [*(EXTRA if extra else ()), *columns]
    num_vertices, num_faces = promised or (8, len(faces))
    header = ["ply", f"format {form} 1.0", "comment by hand", "obj_info none"]
    header += ["comment TextureFile t.png"] if texture else []
    header += ["element camera 1", "property list uchar float view"] if extra else []
    header += [f"element vertex {num_vertices}"] + [f"property float {axis}" for axis in "xyz"]
    header += [f"property {kind} {name}" for kind, name, _ in columns]
    header += [f"element face {num_faces}", f"property list {types[0]} {types[1]} vertex_indices"]
    header += ["property list uchar float weights", "property uchar flags"] if extra else []
    header += ["end_header"]
    rows = [("B2f", (2, 0.5, 0.25))] if extra else []
    for number, vertex in enumerate(BOX.vertices.tolist()):
        values = (values[number] for _, _, values in columns)
        rows.append(("3f" + "".join(CODES[kind] for kind, *_ in columns), (*vertex, *values)))
    for number, face in enumerate(faces):
        weights = [0.5] * (number % 3)
        code = f"{CODES[types[0]]}{len(face)}{CODES[types[1]]}"
        values = (len(face) if count is None else count, *face)
        if extra:
            code, values = f"{code}B{len(weights)}fB", (*values, len(weights), *weights, 3)
        rows.append((code, values))
    text = newline.join(header) + newline
    if form == "ascii":
        return (text + newline.join(" ".join(map(str, v)) for _, v in rows) + newline).encode()
    return text.encode() + b"".join(struct.pack(order + code, *v) for code, v in rows)


@pytest.mark.parametrize("form", FORMATS)
@pytest.mark.parametrize("faces", [TRIANGLES, QUADS, MIXED], ids=["triangles", "quads", "mixed"])
@pytest.mark.parametrize("extra", [False, True])
@pytest.mark.parametrize("types", [("uchar", "int"), ("uint8", "int32"), ("uint", "ushort")])
def test_every_dialect_gives_the_box(write, form, faces, extra, types, volume):
    loaded = read_mesh(write("a.ply", ply(form, faces, extra=extra, types=types)), "mm")
    assert loaded.uv is None
    assert volume(loaded) == pytest.approx(6e-6)
    assert len(loaded.faces) == 12


@pytest.mark.parametrize("newline", ["\r\n", "\r"])
@pytest.mark.parametrize("form", FORMATS)
def test_line_ends_of_all_systems(write, form, newline):
    assert len(read_mesh(write("a.ply", ply(form, MIXED, newline=newline)), "mm").faces) == 12


@pytest.mark.parametrize("form", FORMATS)
@pytest.mark.parametrize("names", [("s", "t"), ("u", "v"), ("texture_u", "texture_v")])
def test_texture_coordinates_of_all_names(tmp_path, write, form, names):
    pixels = np.random.default_rng(0).integers(0, 256, (4, 4, 3), np.uint8)
    Image.fromarray(pixels).save(tmp_path / "t.png")
    columns = [("float", names[0], np.arange(8) / 8), ("float", names[1], [0.25] * 8)]
    content = ply(form, TRIANGLES, columns=columns, texture=True, extra=True)
    loaded = read_mesh(write("a.ply", content), "mm")
    np.testing.assert_allclose(loaded.uv, np.stack([np.arange(8) / 8, np.full(8, 0.25)], axis=1))
    np.testing.assert_array_equal(loaded.texture, pixels)


@pytest.mark.parametrize("encoding", ["ascii", "binary"])
def test_agrees_with_trimesh(tmp_path, encoding):
    ball = trimesh.creation.icosphere(subdivisions=3)
    ball.visual.vertex_colors = np.arange(4 * len(ball.vertices)).reshape(-1, 4) % 256
    ball.export(tmp_path / "a.ply", encoding=encoding)
    expected = trimesh.load(tmp_path / "a.ply", process=False)
    mesh = read_ply(tmp_path / "a.ply")
    np.testing.assert_allclose(mesh.vertices, expected.vertices, rtol=1e-7)
    np.testing.assert_array_equal(mesh.faces, expected.faces)


@pytest.mark.parametrize("form", FORMATS)
@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"promised": (7, 12)}, "export the mesh again"),
        ({"promised": (8, 11)}, "more than stated in its header"),
        ({"promised": (8, 13)}, "less data|buffer is smaller"),
        ({"promised": (0, 0)}, "more than stated in its header"),
        ({"types": ("int", "int"), "count": -3}, "a list of -3"),
        ({"count": 200}, "less data than 12 rows"),
        ({"count": 2}, "face 0 with fewer than 3|bytes more"),
    ],
)
def test_a_wrong_count_in_a_header_or_list_is_refused(refused, form, options, message):
    refused("a.ply", ply(form, TRIANGLES, **options), message)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("format ascii 1.0", "", "not one of binary_little_endian"),
        ("format ascii", "format text", "not one of binary_little_endian"),
        ("property float z", "property float w", "no vertex table with x, y, z"),
        ("property float z", "property float y", "element vertex with 8 rows"),
        ("vertex_indices", "corners", "no face table with vertex_indices"),
        ("property float x", "property half x", "KeyError"),
        ("end_header", "header_end", "no PLY header"),
        ("ply\n", "obj\n", "no PLY header"),
        ("-5.0", "five", "export the mesh again"),
        ("3 1 3 0", "3.5 1 3 0", "a list of 3.5 values"),
        ("3 1 3 0", "3 1 3 -1", "a face index outside"),
        ("3 1 3 0", "3 1 3 8", "a face index outside of its 8 vertices"),
        ("obj_info none", "comment TextureFile t.png", "1 textures, no uv"),
    ],
)
def test_damage_is_named(refused, old, new, message):
    content = ply("ascii", TRIANGLES)
    assert old.encode() in content
    refused("a.ply", content.replace(old.encode(), new.encode(), 1), message)


def test_a_missing_texture_and_a_folded_polygon_are_named(refused):
    columns = [("float", name, [0.5] * 8) for name in "uv"]
    missing = ply("ascii", TRIANGLES, columns=columns, texture=True)
    refused("a.ply", missing, "TextureFile 't.png' .*does not exist")
    folded = ply("binary_little_endian", [[0, 3, 1, 2], *QUADS[1:]])
    refused("a.ply", folded, "a polygon that is not convex, face 0")


SQUARE = np.array([[0.0, 0, 0], [2, 0, 0], [2, 2, 0], [0, 2, 0]])
DART = np.array([[2.0, 0, 1], [0.5, 0.5, 1], [0, 2, 1], [0, 0, 1]])
ROUND = np.array([[np.cos(angle), np.sin(angle), 0] for angle in np.arange(12) * np.pi / 6])


def off(faces, vertices=BOX.vertices):
    rows = [" ".join(map(str, row)) for row in vertices.tolist()]
    rows += [" ".join(map(str, [len(face), *face])) for face in faces]
    return f"OFF\n{len(vertices)} {len(faces)} 0\n" + "\n".join(rows) + "\n"


def test_fans_start_at_first_corners():
    expected = [[0, 1, 2], [3, 4, 5], [3, 5, 6], [3, 6, 7], [8, 9, 10], [8, 10, 11]]
    assert fans(ROUND, np.arange(12), np.array([3, 5, 4])).tolist() == expected
    with pytest.raises(ValueError, match="face 1 with fewer than 3 corners"):
        fans(ROUND, np.arange(5), np.array([3, 2]))


@pytest.mark.parametrize("other", [DART, SQUARE[[0, 2, 1, 3]]], ids=["dart", "bow tie"])
def test_a_fan_outside_its_polygon_is_refused(other):
    corners, counts = np.arange(8), np.array([4, 4])
    assert len(fans(np.vstack([SQUARE, SQUARE]), corners, counts)) == 4
    with pytest.raises(FoldedPolygonError, match="not convex, face 1"):
        fans(np.vstack([SQUARE, other]), corners, counts)
    # A face with a missing vertex is not checked here.
    assert len(fans(np.vstack([SQUARE, other]), corners + 1, counts)) == 4


def test_off_polygons_and_dialects(write, volume):
    text = off(MIXED)
    for dialect in (
        text, off(BOX.faces.tolist()), off(QUADS), export_off(BOX),
        text.replace("\n", "\r\n"), text.replace("OFF\n", "OFF"),
        "# a box\n\n" + text.replace("9 0\n", "9 0 # counts\n\n"),
        text.replace("3 2 3 7", "3 2 3 7 255 0 0"),
    ):  # fmt: skip
        loaded = read_mesh(write("a.off", dialect), "mm")
        assert volume(loaded) == pytest.approx(6e-6)
        assert len(loaded.faces) == 12


def test_a_prism_of_hexagons_in_an_off_file(write, volume):
    ring = ROUND[::2]
    sides = [[i, (i + 1) % 6, 6 + (i + 1) % 6, 6 + i] for i in range(6)]
    faces = [[5, 4, 3, 2, 1, 0], *sides, [6, 7, 8, 9, 10, 11]]
    vertices = np.concatenate([ring, ring + np.array([0, 0, 2])])
    loaded = read_mesh(write("a.off", off(faces, vertices)), "cm")
    assert volume(loaded) == pytest.approx(3 * np.sqrt(3) * 1e-6)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("8 6", "8 5", "14 lines, but the header states 8 .* 5 faces"),
        ("8 6", "8 7", "14 lines, but the header states 8 .* 7 faces"),
        ("4 0 1 3 2", "2 0 1", "face 0 with fewer than 3 corners"),
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


def coloured(form, kind, values, normals=False):
    """A box whose vertices have colours of a kind, and normals."""
    values = values if kind == "float" else values.astype(int)
    columns = [*zip([kind] * 3, ("red", "green", "blue"), values.T.tolist(), strict=True)]
    directions = zip(["float"] * 3, ("nx", "ny", "nz"), BOX.vertices.T.tolist(), strict=True)
    return ply(form, TRIANGLES, columns=[*columns, *(directions if normals else ())])


SHADES = np.arange(24).reshape(8, 3) * 10


@pytest.mark.parametrize("form", FORMATS)
@pytest.mark.parametrize(
    ("kind", "scale"), [("uchar", 1), ("ushort", 1), ("ushort", 257), ("float", 1 / 255)]
)
def test_vertices_keep_colours_and_normals(form, kind, scale, write):
    mesh = read_mesh(write("box.ply", coloured(form, kind, SHADES * scale, normals=True)), "mm")
    np.testing.assert_array_equal(mesh.colours, SHADES)
    np.testing.assert_allclose(mesh.normals, BOX.vertices)
    assert mesh.texture is None


@pytest.mark.parametrize(
    ("kind", "shade", "expected"),
    [
        ("uchar", (102, 102, 102), None),  # programs write a uniform grey by default
        ("uchar", (230, 175, 40), [230, 175, 40]),
        ("float", (1 + 1e-4, -1e-4, 0.5), [255, 0, 128]),  # rounded beyond its range
    ],
)
def test_a_uniform_grey_is_no_colour_and_rounding_errors_are_clipped(kind, shade, expected, write):
    content = coloured("ascii", kind, np.tile(shade, (8, 1)))
    colours = read_mesh(write("box.ply", content), "mm").colours
    assert (None if colours is None else colours[3].tolist()) == expected


@pytest.mark.parametrize(
    ("kind", "shade", "most"), [("uchar", 256, "255"), ("float", 1.5, "1"), ("float", -0.1, "1")]
)
def test_a_colour_out_of_range_is_refused(kind, shade, most, refused):
    values = np.where(np.arange(24).reshape(8, 3) == 16, shade, 0)
    content = coloured("ascii", kind, values)
    refused("box.ply", content, f"a vertex colour that is not from 0 to {most}")
