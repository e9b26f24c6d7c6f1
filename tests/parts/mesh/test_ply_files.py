from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from dopepp.core.errors import UserError
from dopepp.parts import read_mesh
from dopepp.parts.mesh.ply import read_ply

BOX = trimesh.creation.box((10.0, 20.0, 30.0))
TRIANGLES = BOX.faces.tolist()
QUADS = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
MIXED = [*QUADS[:3], [2, 3, 7], [2, 7, 6], *QUADS[4:]]
CODES = {"uchar": "B", "int": "i", "uint": "I", "ushort": "H", "int32": "i", "uint8": "B"}
FORMATS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}


def ply(
    form: str,
    faces: list[list[int]],
    *,
    extra: bool = False,
    uv: tuple[str, str] | None = None,
    types: tuple[str, str] = ("uchar", "int"),
    promised: tuple[int, int] | None = None,
    count: int | None = None,
    newline: str = "\n",
) -> bytes:
    """Write a box, with further columns and a further table before, between and behind."""
    order = FORMATS[form]
    num_vertices, num_faces = promised or (8, len(faces))
    header = ["ply", f"format {form} 1.0", "comment by hand", "obj_info none"]
    header += ["comment TextureFile t.png"] if uv else []
    header += ["element camera 1", "property list uchar float view"] if extra else []
    header += [f"element vertex {num_vertices}"] + [f"property float {axis}" for axis in "xyz"]
    header += ["property uchar red", "property double quality"] if extra else []
    header += [f"property float {name}" for name in uv or ()]
    header += [f"element face {num_faces}", f"property list {types[0]} {types[1]} vertex_indices"]
    header += ["property list uchar float weights", "property uchar flags"] if extra else []
    header += ["end_header"]
    rows: list[tuple[str, tuple[float, ...]]] = [("B2f", (2, 0.5, 0.25))] if extra else []
    for number, vertex in enumerate(BOX.vertices):
        values = (
            *vertex.tolist(),
            *((7, 1.5) if extra else ()),
            *((number / 8, 0.25) if uv else ()),
        )
        rows.append(("3f" + ("Bd" if extra else "") + ("2f" if uv else ""), values))
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


def read(folder: Path, content: bytes) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
    (folder / "a.ply").write_bytes(content)
    loaded = read_mesh(folder / "a.ply", "mm")
    return loaded.vertices, loaded.faces, loaded.uv


@pytest.mark.parametrize("form", FORMATS)
@pytest.mark.parametrize("faces", [TRIANGLES, QUADS, MIXED], ids=["triangles", "quads", "mixed"])
@pytest.mark.parametrize("extra", [False, True])
@pytest.mark.parametrize("types", [("uchar", "int"), ("uint8", "int32"), ("uint", "ushort")])
def test_every_dialect_gives_the_box(
    tmp_path: Path, form: str, faces: list[list[int]], extra: bool, types: tuple[str, str]
) -> None:
    vertices, triangles, uv = read(tmp_path, ply(form, faces, extra=extra, types=types))
    assert uv is None
    solid = trimesh.Trimesh(vertices, triangles, process=False)
    assert solid.is_volume
    assert solid.volume == pytest.approx(6e-6)
    assert len(triangles) == 12


@pytest.mark.parametrize("newline", ["\n", "\r\n", "\r"])
@pytest.mark.parametrize("form", FORMATS)
def test_line_ends_of_every_system(tmp_path: Path, form: str, newline: str) -> None:
    assert len(read(tmp_path, ply(form, MIXED, newline=newline))[1]) == 12


@pytest.mark.parametrize("form", FORMATS)
@pytest.mark.parametrize("names", [("s", "t"), ("u", "v"), ("texture_u", "texture_v")])
def test_texture_coordinates_by_any_name(tmp_path: Path, form: str, names: tuple[str, str]) -> None:
    Image.new("RGB", (4, 4)).save(tmp_path / "t.png")
    _, _, uv = read(tmp_path, ply(form, TRIANGLES, uv=names, extra=True))
    assert uv is not None
    np.testing.assert_allclose(uv, np.stack([np.arange(8) / 8, np.full(8, 0.25)], axis=1))


@pytest.mark.parametrize("encoding", ["ascii", "binary_little_endian"])
def test_agrees_with_trimesh(tmp_path: Path, encoding: str) -> None:
    ball = trimesh.creation.icosphere(subdivisions=3)
    ball.visual.vertex_colors = np.arange(4 * len(ball.vertices)).reshape(-1, 4) % 256
    ball.export(tmp_path / "a.ply", encoding=encoding.replace("binary_little_endian", "binary"))
    expected = trimesh.load(tmp_path / "a.ply", process=False)
    vertices, faces, *_ = read_ply(tmp_path / "a.ply")
    np.testing.assert_allclose(vertices, expected.vertices, rtol=1e-7)
    np.testing.assert_array_equal(faces, expected.faces)


@pytest.mark.parametrize("form", FORMATS)
@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"promised": (7, 12)}, "export the mesh again"),
        ({"promised": (10**12, 12)}, "less data than 1000000000000 rows of element vertex"),
        ({"promised": (8, 10**12)}, "less data than 1000000000000 rows of element face"),
        ({"promised": (8, 11)}, "more than its header promises"),
        ({"promised": (8, 13)}, "less data|buffer is smaller"),
        ({"promised": (-1, 12)}, "element vertex with -1 rows"),
        ({"promised": (0, 0)}, "more than its header promises"),
        ({"types": ("int", "int"), "count": -3}, "a list of -3"),
        ({"types": ("uint", "int"), "count": 2**31}, "a list of 2147483648"),
        ({"count": 200}, "less data than 12 rows"),
        ({"count": 2}, "face 0 of fewer than 3|bytes more"),
    ],
)
def test_a_header_or_a_list_that_lies_is_refused(
    tmp_path: Path, form: str, options: dict[str, object], message: str
) -> None:
    with pytest.raises(UserError, match=message) as caught:
        read(tmp_path, ply(form, TRIANGLES, **options))  # type: ignore[arg-type]
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ((b"format ascii 1.0", b""), "where one of binary_little_endian"),
        ((b"format ascii", b"format text"), "where one of binary_little_endian"),
        ((b"property float z", b"property float w"), "no vertex table with x, y, z"),
        ((b"property float z", b"property float y"), "element vertex with 8 rows"),
        ((b"vertex_indices", b"corners"), "no face table with vertex_indices"),
        ((b"property float x", b"property half x"), "KeyError"),
        ((b"end_header", b"header_end"), "no PLY header"),
        ((b"ply\n", b"obj\n"), "no PLY header"),
        ((b"-5.0", b"nan"), "not a finite number"),
        ((b"-5.0", b"five"), "export the mesh again"),
        ((b"3 1 3 0", b"3 1 3 0.5"), "no integer"),
        ((b"3 1 3 0", b"3.5 1 3 0"), "a list of 3.5 values"),
        ((b"3 1 3 0", b"3 1 3 -1"), "a face index outside"),
        ((b"3 1 3 0", b"3 1 3 8"), "a face index outside"),
    ],
)
def test_damage_is_named(tmp_path: Path, change: tuple[bytes, bytes], message: str) -> None:
    content = ply("ascii", TRIANGLES)
    assert change[0] in content
    with pytest.raises(UserError, match=message):
        read(tmp_path, content.replace(change[0], change[1], 1))


def test_a_folded_polygon_is_named(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="a polygon that is not convex, face 0"):
        read(tmp_path, ply("binary_little_endian", [[0, 3, 1, 2], *QUADS[1:]]))


@settings(deadline=None, max_examples=150)
@given(st.data())
def test_a_changed_byte_gives_a_mesh_or_one_line(
    tmp_path_factory: pytest.TempPathFactory, data: st.DataObject
) -> None:
    form = data.draw(st.sampled_from(sorted(FORMATS)))
    content = bytearray(ply(form, MIXED, extra=True))
    for _ in range(data.draw(st.integers(1, 3))):
        content[data.draw(st.integers(0, len(content) - 1))] = data.draw(st.integers(0, 255))
    folder = tmp_path_factory.mktemp("any")
    try:
        vertices, faces, _ = read(folder, bytes(content))
    except UserError:
        return
    assert np.isfinite(vertices).all()
    assert faces.max() < len(vertices)
