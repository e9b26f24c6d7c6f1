"""What trimesh makes of the files that are checked before it reads, or that it does not read."""

from __future__ import annotations

import re
import struct
from pathlib import Path

import pytest
import trimesh
from trimesh.exchange.ply import export_ply
from trimesh.exchange.stl import export_stl_ascii

from dopepp.core.errors import UserError
from dopepp.parts import read_mesh

BOX = trimesh.creation.box((10.0, 20.0, 30.0))
QUADS = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]


def write(folder: Path, name: str, content: str | bytes) -> Path:
    path = folder / name
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    return path


def obj(faces: str, before: str = "") -> str:
    return f"{before}v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nvt 0 0\nvt 1 0\n{faces}"


HEXAGON = "v 2 0 0\nv 1 2 0\nv -1 2 0\nv -2 0 0\nv -1 -2 0\nv 1 -2 0\nvt 0 0\n"


def ply_faces(*faces: list[int], form: str = "<", lists: str = "B{}i") -> bytes:
    header = export_ply(BOX).split(b"end_header")[0]
    header = re.sub(rb"element face \d+", b"element face %d" % len(faces), header)
    rows = [struct.pack(form + lists.format(len(face)), len(face), *face) for face in faces]
    return header + b"end_header\n" + BOX.vertices.astype("<f4").tobytes() + b"".join(rows)


OFF = "OFF\n8 6 0\n" + "".join(f"{x} {y} {z}\n" for x, y, z in BOX.vertices.tolist())
OFF += "".join(f"4 {' '.join(map(str, face))}\n" for face in QUADS)
TEXT_PLY = export_ply(BOX, encoding="ascii")
PENTAGON_AND_TRIANGLE = [*QUADS[:2], [0, 4, 5, 1, 0], [2, 3, 7]]
"""As long together as two quads."""

WRONG: dict[str, tuple[str | bytes, int, int | str]] = {
    # A file, the triangles that trimesh finds in it (-1: refused), and ours or why not.
    "cut.ply": (TEXT_PLY[: TEXT_PLY.rindex(b"\n3 ")], 11, "less data|buffer is smaller"),
    "count.ply": (TEXT_PLY.replace(b"\n3 7", b"\n2 7"), 12, "fewer than 3|bytes more"),
    "fraction.ply": (TEXT_PLY.replace(b"3 1 3 0", b"3 1 3 0.5"), 12, "no integer"),
    "mixed.ply": (ply_faces(*QUADS[:3], [2, 3, 7], [2, 7, 6], *QUADS[4:]), -1, 12),
    "agree.ply": (ply_faces(*PENTAGON_AND_TRIANGLE), 8, 7),
    "line_ends.ply": (TEXT_PLY.replace(b"\n", b"\r"), -1, 12),
    "cut.obj": (obj("f 1 2 3\nf 1 3\n"), 1, "line 8 'f 1 3' .*3 corners"),
    "zero.obj": (obj("f 0 2 3\n"), 1, "index 0 among 4"),
    "outside.obj": (obj("f 1 2 3\nf 1 2 5\n"), -1, "index 5 among 4"),
    "tab.obj": (obj("f 1 2 3\nf\t1 3 4\n"), 1, 2),
    "relative.obj": (obj("f -4 -3 -2\n") + "v 9 9 9\nf 1 3 4\n", 2, 2),
    "hexagon.obj": (HEXAGON + "f 1/1 2/1 3/1\nf 1 2 3 4 5 6\n", 2, 5),
    "library.obj": (obj("usemtl m\nf 1/1 2/2 3/1\n", "mtllib gone.mtl\n"), 1, "does not exist"),
    "cut.stl": (export_stl_ascii(BOX) + export_stl_ascii(BOX)[:900], 12, "begun and 12 ended"),
    "cut.off": (OFF.rsplit("\n", 2)[0], 10, "13 lines"),
    "pentagon.off": (OFF.replace("4 1 5 7 3", "5 1 5 7 3 1"), -1, 12),
    "short.off": (OFF.replace("4 0 1 3 2", "4 0 1 3"), 11, "face 0 of 4 corners"),
}


@pytest.mark.parametrize("name", WRONG)
def test_what_trimesh_makes_of_it(tmp_path: Path, name: str) -> None:
    """Where one of these fails, trimesh has learned it and a check or a reader here can go."""
    content, theirs, ours = WRONG[name]
    path = write(tmp_path, name, content)
    try:
        num_theirs = len(trimesh.load_mesh(path, process=False).faces)
    except Exception:
        num_theirs = -1
    assert num_theirs == theirs
    if isinstance(ours, str):
        with pytest.raises(UserError, match=ours):
            read_mesh(path, "mm")
    else:
        assert len(read_mesh(path, "cm").faces) == ours


def test_trimesh_reads_garbage_where_the_sizes_of_polygons_agree(tmp_path: Path) -> None:
    path = write(tmp_path, "a.ply", ply_faces(*PENTAGON_AND_TRIANGLE))
    assert trimesh.load_mesh(path, process=False).faces.max() > 8
    assert read_mesh(path, "mm").faces.max() < 8


def test_trimesh_takes_relative_indices_from_the_end_of_an_obj_file(tmp_path: Path) -> None:
    path = write(tmp_path, "a.obj", WRONG["relative.obj"][0])
    theirs = trimesh.load_mesh(path, process=False)
    assert theirs.vertices[theirs.faces[0]].tolist() == [[1, 0, 0], [1, 1, 0], [0, 1, 0]]
    ours = read_mesh(path, "m")
    assert ours.vertices[ours.faces[0]].tolist() == [[0, 0, 0], [1, 0, 0], [1, 1, 0]]


def test_trimesh_splits_vertices_where_normals_differ(tmp_path: Path) -> None:
    box = BOX.copy()
    normals = box.face_normals.tolist()
    text = "".join(f"v {x} {y} {z}\n" for x, y, z in box.vertices.tolist())
    text += "".join(f"vn {x} {y} {z}\n" for x, y, z in normals)
    for number, face in enumerate((box.faces + 1).tolist(), start=1):
        text += "f " + " ".join(f"{corner}//{number}" for corner in face) + "\n"
    path = write(tmp_path, "a.obj", text)
    assert len(trimesh.load_mesh(path, process=False).vertices) == 36
    assert len(read_mesh(path, "mm").vertices) == 8
