from __future__ import annotations

import os
import struct
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image
from trimesh.exchange.ply import export_ply
from trimesh.exchange.stl import export_stl, export_stl_ascii

from dopepp.core.errors import UserError
from dopepp.parts import load_part, read_mesh

BOX = trimesh.creation.box((10.0, 20.0, 30.0))
BINARY = export_stl(BOX)


def with_vertex(value: float) -> trimesh.Trimesh:
    box = BOX.copy()
    box.vertices = np.where(np.arange(24).reshape(8, 3) == 7, value, box.vertices)
    return box


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("name", ["a.stl", "text.stl", "a.ply", "text.ply", "a.obj"])
def test_a_coordinate_that_is_no_number_is_named(tmp_path: Path, name: str, value: float) -> None:
    box = with_vertex(value)
    content = {
        "a.stl": lambda: export_stl(box),
        "text.stl": lambda: export_stl_ascii(box).encode(),
        "a.ply": lambda: export_ply(box),
        "text.ply": lambda: export_ply(box, encoding="ascii"),
        "a.obj": lambda: trimesh.exchange.obj.export_obj(box).encode(),
    }[name]
    with np.errstate(invalid="ignore"):  # trimesh's own normals
        (tmp_path / name).write_bytes(content())
    # Value 7 of the box is its third vertex's y; an STL file has no vertices, but triangles.
    corners = box.vertices[box.faces].reshape(-1, 9)
    triangle = int(np.flatnonzero(~np.isfinite(corners).all(axis=1))[0])
    corner = int(np.flatnonzero(~np.isfinite(corners[triangle]))[0]) // 3
    place = {
        "stl": f"finite number, triangle {triangle + 1}, vertex {corner + 1};",
        "ply": "finite number, vertex 3;",
        "obj": "damaged line .*finite number",
    }[name[-3:]]
    with pytest.raises(UserError, match=rf"{name} with .*{place}") as caught:
        read_mesh(tmp_path / name, "mm")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("count", [0, 1, 11, 13, 10**9, 2**32 - 1])
def test_a_binary_stl_that_lies_about_its_triangles(tmp_path: Path, count: int) -> None:
    lie = BINARY[:80] + struct.pack("<I", count) + BINARY[84:]
    (tmp_path / "a.stl").write_bytes(lie)
    with pytest.raises(UserError, match=rf"684 bytes where its header promises {count} triangles"):
        read_mesh(tmp_path / "a.stl", "mm")


def test_a_binary_stl_may_begin_like_text(tmp_path: Path) -> None:
    (tmp_path / "a.stl").write_bytes(b"solid part".ljust(80) + BINARY[80:])
    assert len(read_mesh(tmp_path / "a.stl", "mm").faces) == 12


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("text.stl", export_ply(BOX)),
        ("binary.ply", BINARY),
        ("obj.stl", trimesh.exchange.obj.export_obj(BOX).encode()),
        ("stl.obj", BINARY),
        ("nothing.stl", b""),
        ("nothing.ply", b""),
        ("nothing.obj", b""),
        ("header.stl", BINARY[:84]),
        ("empty.stl", bytes(84)),
    ],
)
def test_another_format_under_a_suffix_is_refused(
    tmp_path: Path, name: str, content: bytes
) -> None:
    (tmp_path / name).write_bytes(content)
    with pytest.raises(UserError, match=name) as caught:
        read_mesh(tmp_path / name, "mm")
    assert "\n" not in str(caught.value)


def test_what_is_no_file_is_refused(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe.stl")
    (tmp_path / "link.stl").symlink_to(tmp_path / "gone.stl")
    for name in ("pipe.stl", "link.stl", "gone.stl", "x" * 300 + ".stl"):
        with pytest.raises(UserError, match="no such file"):
            read_mesh(tmp_path / name, "mm")


def test_a_text_stl_may_be_laid_out_in_any_way(tmp_path: Path) -> None:
    text = export_stl_ascii(BOX)
    for number, dialect in enumerate([
        text.upper(),
        text.replace("\n", "\r\n"),
        text.replace("facet normal", "facet \t normal").replace("vertex", "  vertex "),
        "\n" + text.replace("endsolid", "endsolid of a facet"),
    ]):  # fmt: skip
        (tmp_path / f"{number}.stl").write_text(dialect, newline="")
        assert len(read_mesh(tmp_path / f"{number}.stl", "mm").faces) == 12


def test_inches_are_exact_and_the_wrong_unit_is_guessed_right(tmp_path: Path) -> None:
    (tmp_path / "a.stl").write_bytes(BINARY)
    np.testing.assert_array_equal(
        np.ptp(read_mesh(tmp_path / "a.stl", "inch").vertices, axis=0),
        2 * (np.array([5.0, 10.0, 15.0]) * 0.0254),
    )
    with pytest.raises(UserError, match=r"diameter of 37\.42 m, .*unit=m; .* fix: .*unit=mm"):
        load_part(tmp_path / "a.stl", "m")


def test_a_small_file_with_a_huge_texture_takes_no_memory(tmp_path: Path) -> None:
    Image.new("1", (50_000, 1000)).save(tmp_path / "t.png")
    (tmp_path / "a.mtl").write_text("newmtl m\nmap_Kd t.png\n")
    (tmp_path / "a.obj").write_text(
        "mtllib a.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nusemtl m\nf 1/1 2/1 3/1\n"
    )
    with pytest.raises(UserError, match=r"50000×1000 pixels; .*8192×8192"):
        read_mesh(tmp_path / "a.obj", "mm")


def test_a_huge_material_file_is_not_read(tmp_path: Path) -> None:
    with (tmp_path / "a.mtl").open("wb") as file:
        file.truncate(10**10)
    (tmp_path / "a.obj").write_text("mtllib a.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    with pytest.raises(UserError, match=r"a\.mtl of 10000 MB; allowed: up to 10 MB"):
        read_mesh(tmp_path / "a.obj", "mm")


def test_a_huge_mesh_file_is_not_read(tmp_path: Path) -> None:
    with (tmp_path / "a.stl").open("wb") as file:
        file.truncate(10**10)
    with pytest.raises(UserError, match=r"a\.stl with 10000 MB; .*under 250 MB; .*reduce"):
        read_mesh(tmp_path / "a.stl", "mm")


_LOAD = """
import sys
from pathlib import Path
from dopepp.parts import load_part
part = load_part(sys.argv[1], "mm")
# Not ru_maxrss, which a child inherits from a large parent.
status = dict(line.split(":") for line in Path("/proc/self/status").read_text().splitlines())
print(len(part.mesh.faces), status["VmHWM"].split()[0])
"""


def write_torus(path: Path, sections: int) -> None:
    """Write a binary STL file of 2 · sections² triangles."""
    angle = np.linspace(0, 2 * np.pi, sections, endpoint=False)
    around, along = np.meshgrid(angle, angle)
    radius = 40 + 15 * np.cos(along)
    rows = (radius * np.cos(around), radius * np.sin(around), 15 * np.sin(along))
    grid = np.stack(rows, axis=-1).astype("<f4")
    right, up = np.roll(grid, -1, axis=1), np.roll(grid, -1, axis=0)
    across = np.roll(up, -1, axis=1)
    triangles = np.concatenate([
        np.stack([grid, right, across], axis=2).reshape(-1, 9),
        np.stack([grid, across, up], axis=2).reshape(-1, 9),
    ])  # fmt: skip
    records = np.zeros(
        len(triangles), [("normal", "<f4", 3), ("corners", "<f4", 9), ("end", "<u2")]
    )
    records["corners"] = triangles
    path.write_bytes(bytes(80) + struct.pack("<I", len(records)) + records.tobytes())


@pytest.mark.parametrize(
    ("sections", "most_mb"), [(320, 400), pytest.param(1000, 1200, marks=pytest.mark.slow)]
)
def test_millions_of_faces_are_decimated_in_bounded_memory(
    tmp_path: Path, sections: int, most_mb: int
) -> None:
    write_torus(tmp_path / "torus.stl", sections)
    command = [sys.executable, "-c", _LOAD, str(tmp_path / "torus.stl")]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    num_faces, kilobytes = map(int, done.stdout.split())
    assert 100_000 < num_faces <= 200_000
    assert kilobytes < 1000 * most_mb
    assert done.stderr.count("\n") == 1
    assert f"{2 * sections**2} triangles decimated to {num_faces}" in done.stderr


@settings(deadline=None, max_examples=100)
@given(st.data())
def test_a_changed_byte_gives_a_mesh_or_one_line(
    tmp_path_factory: pytest.TempPathFactory, data: st.DataObject
) -> None:
    text = export_stl_ascii(BOX).encode()
    obj = trimesh.exchange.obj.export_obj(BOX).encode()
    suffix, good = data.draw(st.sampled_from([("stl", BINARY), ("stl", text), ("obj", obj)]))
    content = bytearray(good)
    for _ in range(data.draw(st.integers(1, 3))):
        content[data.draw(st.integers(0, len(content) - 1))] = data.draw(st.integers(0, 255))
    path = tmp_path_factory.mktemp("any") / f"a.{suffix}"
    path.write_bytes(content)
    try:
        loaded = read_mesh(path, "mm")
    except UserError:
        return
    assert np.isfinite(loaded.vertices).all()
    assert loaded.faces.max() < len(loaded.vertices)
