"""All mesh formats: units, refused files, limits on size, and repairs of the mesh."""

import logging
import os
import re
import struct
import subprocess
import sys
from functools import partial

import numpy as np
import pytest
import trimesh
from trimesh.exchange.obj import export_obj
from trimesh.exchange.off import export_off
from trimesh.exchange.ply import export_ply
from trimesh.exchange.stl import export_stl, export_stl_ascii

from dopepp.core.errors import UserError
from dopepp.parts import load_part, read_mesh

BOX = trimesh.creation.box((10.0, 20.0, 30.0))
FILES = {
    "binary.stl": export_stl(BOX),
    "text.STL": export_stl_ascii(BOX).encode(),
    "binary.ply": export_ply(BOX),
    "text.ply": export_ply(BOX, encoding="ascii"),
    "box.obj": export_obj(BOX).encode(),
    "box.off": export_off(BOX).encode(),
    "box.glb": BOX.export(file_type="glb"),
    "box.3mf": BOX.export(file_type="3mf"),
}
SQUARE = "v 0 0 0\nv 100 0 0\nv 100 100 0\nv 0 100 0\n"
NOISE = np.random.default_rng(0).bytes(3000)


@pytest.mark.parametrize("name", FILES)
@pytest.mark.parametrize(
    ("unit", "metres"), [("mm", 1e-3), ("cm", 1e-2), ("m", 1), ("inch", 0.0254)]
)
def test_every_format_and_unit_gives_the_same_box(write, name, unit, metres, volume):
    loaded = read_mesh(write(name, FILES[name]), unit)
    size = np.ptp(loaded.vertices, axis=0)
    np.testing.assert_allclose(size, metres * np.array([10, 20, 30]), rtol=1e-7)
    assert loaded.vertices.shape == (8, 3)
    assert (loaded.vertices.dtype, loaded.faces.dtype) == (np.float64, np.int32)
    assert loaded.uv is loaded.texture is None
    assert volume(loaded) == pytest.approx(6000 * metres**3, rel=1e-6)


@pytest.mark.parametrize("name", sorted({*FILES} - {"box.glb", "box.3mf"}))
def test_millimetres_are_assumed_with_a_warning(write, name, caplog):
    path = write(name, FILES[name])
    with caplog.at_level(logging.WARNING):
        stated = read_mesh(path, "mm")
        assert not caplog.records
        assumed = read_mesh(path)
    assert len(caplog.records) == 1
    assert f"{path} states no unit: assuming mm" in caplog.text
    np.testing.assert_array_equal(assumed.vertices, stated.vertices)


@pytest.mark.parametrize("name", FILES)
def test_a_truncated_file_is_refused(refused, name):
    content = FILES[name].rstrip(b"\n")
    for length in [0, *np.linspace(1, len(content) - 2, 25).astype(int)]:
        if name == "box.obj" and re.search(rb"^f \S+ \S+ \S+$", content[:length], re.MULTILINE):
            continue  # a shorter OBJ file that is whole in itself
        refused(name, content[:length], f"{name} with .* export the mesh again")


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("text.stl", export_ply(BOX)),
        ("binary.ply", FILES["binary.stl"]),
        ("obj.stl", FILES["box.obj"]),
        ("stl.obj", FILES["binary.stl"]),
        ("header.stl", FILES["binary.stl"][:84]),
        ("empty.stl", bytes(84)),
        *[(f"nothing.{suffix}", b"") for suffix in ("stl", "ply", "obj")],
        *[(f"noise.{suffix}", NOISE) for suffix in ("stl", "obj", "ply", "off", "glb", "3mf")],
    ],
)
def test_a_file_of_another_format_is_refused(refused, name, content):
    refused(name, content, name)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("name", ["a.stl", "text.stl", "a.ply", "text.ply", "a.obj"])
def test_a_coordinate_that_is_not_finite_is_named(refused, name, value):
    box = BOX.copy()
    # Value 7 of the box is its third vertex's y.
    box.vertices = np.where(np.arange(24).reshape(8, 3) == 7, value, box.vertices)
    with np.errstate(invalid="ignore"):  # trimesh's own normals
        content = {
            "a.stl": export_stl, "text.stl": export_stl_ascii, "a.ply": export_ply,
            "text.ply": partial(export_ply, encoding="ascii"), "a.obj": export_obj,
        }[name](box)  # fmt: skip
    # An STL file has no vertices, but triangles.
    corners = box.vertices[box.faces].reshape(-1, 3)
    corner = int(np.flatnonzero(~np.isfinite(corners).all(axis=1))[0])
    place = {
        "stl": f"finite number, triangle {corner // 3 + 1}, vertex {corner % 3 + 1};",
        "ply": "finite number, vertex 3;",
        "obj": "damaged line .*finite number",
    }[name[-3:]]
    refused(name, content, rf"{name} with .*{place}")


def test_a_wrong_path_or_unit_is_refused(tmp_path, write):
    path = write("box.stl", FILES["binary.stl"])
    suffixes = r"files ending in \.stl, \.obj, \.ply, \.glb, "
    with pytest.raises(UserError, match=rf"box\.step; allowed: {suffixes}"):
        read_mesh(tmp_path / "box.step")
    with pytest.raises(UserError, match=r"unit='feet' .*; allowed: mm, cm, m, inch"):
        read_mesh(path, "feet")
    (tmp_path / "folder.stl").mkdir()
    os.mkfifo(tmp_path / "pipe.stl")
    (tmp_path / "link.stl").symlink_to(tmp_path / "gone.stl")
    for name in ("pipe.stl", "link.stl", "gone.stl", "x" * 300 + ".stl", "folder.stl"):
        with pytest.raises(UserError, match="no such file"):
            read_mesh(tmp_path / name, "mm")


def test_flat_triangles_are_dropped_and_counted(write, caplog):
    text = SQUARE + "v 50 0 0\nv 7 7 7\nf 1 2 3 4\nf 1 2 5\nf 1 1 2\nf 6 6 6\n"
    with caplog.at_level(logging.INFO):
        loaded = read_mesh(write("m.obj", text), "mm")
    assert "dropped 3 triangles without area" in caplog.text
    # The two vertices that only flat triangles used are gone.
    assert (len(loaded.faces), len(loaded.vertices)) == (2, 4)
    np.testing.assert_allclose(np.ptp(loaded.vertices, axis=0), [0.1, 0.1, 0])


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("m.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\n", "3 vertices and 0 faces"),
        ("m.obj", "", "0 vertices and 0 faces"),
        ("m.obj", SQUARE + "f 1 1 2\nf 3 3 3\n", "2 faces, none with an area"),
        ("m.obj", "v 0 0 0\nv 1 0 0\nv 2 0 0\nf 1 2 3\n", "1 faces, none with an area"),
        ("m.stl", "solid a\nendsolid a\n", "0 vertices and 0 faces"),
    ],
)
def test_a_file_without_a_surface_is_refused(refused, name, content, message):
    refused(name, content, message)


def test_load_part_by_name_and_by_path(write, caplog):
    assert load_part("servoholder").name == "servoholder"
    assert load_part("pivconnector", "inch") is load_part("pivconnector")  # unit is for files
    path = write("My_Box.stl", FILES["binary.stl"])
    assert load_part(path).name == "My_Box"
    assert "assuming mm" in caplog.text
    assert load_part(str(path), "cm").diameter == pytest.approx(np.sqrt(0.14))
    for wrong, unit, message in (
        ("servo", None, r"unknown part 'servo'; allowed: servoholder, pivconnector, .*\.stl/\.obj"),
        (path.with_name("gone.stl"), None, "no such file"),
        (path, "m", r"'My_Box' with a diameter of 37\.42 m, .*unit=m; .* fix: .*unit=mm"),
    ):
        with pytest.raises(UserError, match=message):
            load_part(wrong, unit)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("a.stl", r"a\.stl with 10000 MB; .*under 250 MB; .*reduce its triangles"),
        ("a.mtl", r"a\.mtl of 10000 MB; allowed: up to 10 MB"),
    ],
)
def test_a_huge_file_is_not_read(tmp_path, write, name, message):
    mesh = write("a.obj", "mtllib a.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    with (tmp_path / name).open("wb") as file:
        file.truncate(10**10)
    with pytest.raises(UserError, match=message):
        read_mesh(mesh if name == "a.mtl" else tmp_path / name, "mm")


_LOAD = """
import sys
from pathlib import Path
from dopepp.parts import load_part
part = load_part(sys.argv[1], "mm")
# Not ru_maxrss, which a child inherits from a large parent.
status = dict(line.split(":") for line in Path("/proc/self/status").read_text().splitlines())
print(len(part.mesh.faces), status["VmHWM"].split()[0])
"""


def write_torus(path, sections):
    """Write a binary STL file of 2 · sections² triangles."""
    angle = np.linspace(0, 2 * np.pi, sections, endpoint=False)
    around, along = np.meshgrid(angle, angle)
    radius = 40 + 15 * np.cos(along)
    rows = (radius * np.cos(around), radius * np.sin(around), 15 * np.sin(along))
    grid = np.stack(rows, axis=-1).astype("<f4")
    right, up = np.roll(grid, -1, axis=1), np.roll(grid, -1, axis=0)
    across = np.roll(up, -1, axis=1)
    halves = ((grid, right, across), (grid, across, up))
    triangles = np.concatenate([np.stack(half, axis=2).reshape(-1, 9) for half in halves])
    fields = [("normal", "<f4", 3), ("corners", "<f4", 9), ("end", "<u2")]
    records = np.zeros(len(triangles), fields)
    records["corners"] = triangles
    path.write_bytes(bytes(80) + struct.pack("<I", len(records)) + records.tobytes())


@pytest.mark.parametrize(
    ("sections", "most_mb"), [(320, 400), pytest.param(1000, 1200, marks=pytest.mark.slow)]
)
def test_millions_of_faces_are_decimated_in_bounded_memory(tmp_path, sections, most_mb):
    write_torus(tmp_path / "torus.stl", sections)
    command = [sys.executable, "-c", _LOAD, str(tmp_path / "torus.stl")]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    num_faces, kilobytes = map(int, done.stdout.split())
    assert 100_000 < num_faces <= 200_000
    assert kilobytes < 1000 * most_mb
    assert done.stderr.count("\n") == 1
    assert f"{2 * sections**2} triangles decimated to {num_faces}" in done.stderr
