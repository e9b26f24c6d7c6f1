"""Hostile GLB, 3MF and OFF files: bombs, links, wrong counts and endless assemblies."""

import io
import json
import re
import struct
import zipfile
import zlib
from typing import Any

import numpy as np
import pytest

from dopepp.parts import read_mesh
from tests.security.conftest import bounded, refused

pytestmark = pytest.mark.timeout(60)


CORNERS = np.array([[0, 0, 0], [0.1, 0, 0], [0, 0.1, 0]], "<f4").tobytes()
HALVES = np.array([[0, 0], [1, 0], [0, 1]], "<f4").tobytes()
BINARY = CORNERS + HALVES


def glb(binary: bytes = BINARY, **changes: Any) -> bytes:
    """Return a GLB file of one triangle with changed top-level fields."""
    header: dict[str, Any] = {
        "asset": {"version": "2.0"},
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0, "TEXCOORD_0": 1}}]}],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3"},
            {"bufferView": 1, "componentType": 5126, "count": 3, "type": "VEC2"},
        ],
        "bufferViews": [
            {"buffer": 0, "byteLength": 36},
            {"buffer": 0, "byteOffset": 36, "byteLength": 24},
        ],
        "buffers": [{"byteLength": len(binary)}],
    }
    return packed(json.dumps(header | changes).encode(), binary)


def linked(uri: str) -> bytes:
    """Return a triangle whose corners are in another file."""
    return glb(buffers=[{"byteLength": 60, "uri": uri}])


def packed(text: bytes, binary: bytes, length: int | None = None) -> bytes:
    chunks = struct.pack("<I4s", len(text), b"JSON") + text
    chunks += struct.pack("<I4s", len(binary), b"BIN\0") + binary
    whole = 12 + len(chunks) if length is None else length
    return struct.pack("<4sII", b"glTF", 2, whole) + chunks


def array(**changes: Any) -> list[dict[str, Any]]:
    """Two arrays in the first view."""
    item = {"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3"}
    return [item | changes, item]


def textured(image: bytes) -> bytes:
    """Return a triangle whose texture follows its corners."""
    views = [
        {"buffer": 0, "byteLength": 36},
        {"buffer": 0, "byteOffset": 36, "byteLength": 24},
        {"buffer": 0, "byteOffset": 60, "byteLength": len(image)},
    ]
    attributes = {"POSITION": 0, "TEXCOORD_0": 1}
    return glb(
        BINARY + image,
        bufferViews=views,
        meshes=[{"primitives": [{"attributes": attributes, "material": 0}]}],
        materials=[{"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}],
        textures=[{"source": 0}],
        images=[{"bufferView": 2, "mimeType": "image/png"}],
    )


def png(side: int) -> bytes:
    """Return a PNG file whose header states a larger size."""
    parts = (
        (b"IHDR", struct.pack(">IIBBBBB", side, side, 8, 2, 0, 0, 0)),
        (b"IDAT", zlib.compress(bytes(9))),
        (b"IEND", b""),
    )
    return b"\x89PNG\r\n\x1a\n" + b"".join(
        struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
        for kind, data in parts
    )


MESH = '<mesh><vertices><vertex x="0" y="0" z="0"/><vertex x="9" y="0" z="0"/>'
MESH += '<vertex x="0" y="9" z="0"/></vertices>'
MESH += '<triangles><triangle v1="0" v2="1" v3="2"/></triangles></mesh>'
CORE = "http://schemas.microsoft.com/3dmanufacturing/core/2015/02"


def model(resources: str, build: str = '<item objectid="1"/>', before: str = "") -> bytes:
    text = f'<model unit="millimeter" xmlns="{CORE}"><resources>{resources}</resources>'
    return f'<?xml version="1.0"?>{before}{text}<build>{build}</build></model>'.encode()


def archive(**members: bytes) -> bytes:
    """A 3MF file; ``model`` is its root model."""
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as target:
        for name, data in members.items():
            target.writestr("3D/3dmodel.model" if name == "model" else name, data)
    return file.getvalue()


def one_model(resources: str, build: str = '<item objectid="1"/>', before: str = "") -> bytes:
    """Return a 3MF file that consists of a root model."""
    return archive(model=model(resources, build, before))


def body(number: int, content: str = MESH) -> str:
    return f'<object id="{number}" type="model">{content}</object>'


def assembly(number: int, *parts: int) -> str:
    components = "".join(f'<component objectid="{part}"/>' for part in parts)
    return body(number, f"<components>{components}</components>")


def lying_archive() -> bytes:
    """Return a 3MF file whose directory states an unpacked size of 100 bytes."""
    content = archive(model=model(body(1)) + b" " * 30_000_000)
    size = struct.pack("<I", len(model(body(1))) + 30_000_000)
    assert size in content
    return content.replace(size, struct.pack("<I", 100))


DOUBLED = "".join(assembly(n, n - 1, n - 1) for n in range(2, 40))
CHAIN = "".join(assembly(n, n - 1) for n in range(2, 50_000))
LAUGHS = "".join(f'<!ENTITY a{n} "{f"&a{n - 1};" * 10}">' for n in range(1, 12))
NODES = [{"mesh": 0, "children": [n + 1]} for n in range(400)] + [{"mesh": 0}]
TRIANGLE_OFF = b"OFF\n3 1 0\n0 0 0\n9 0 0\n0 9 0\n3 0 1 2\n"

VIEW = [{"buffer": 0, "byteLength": 1_200_000}]
BARE = {"primitives": [{"attributes": {"POSITION": 0}}]}
LARGE = {"bufferViews": VIEW, "accessors": array(count=99_999)}
LARGE_BINARY = bytes(1_200_000)

SCENES: dict[str, Any] = {  # bytes, or what makes them, where that takes long
    "a.glb|a file elsewhere|needs the file 'file:": linked("file:///etc/passwd"),
    "b.glb|a file in another folder|needs the file '../": linked("../../x.bin"),
    "c.glb|a page of the web|needs the file 'http:": linked("http://localhost/x"),
    "d.glb|a texture elsewhere|needs the file '/etc": glb(images=[{"uri": "/etc/passwd"}]),
    "e.glb|a billion zeros|sparse or missing": glb(
        accessors=[{"componentType": 5126, "count": 10**9, "type": "VEC3"}] * 2
    ),
    "f.glb|a billion corners|arrays of more than": glb(accessors=array(count=10**9)),
    "g.glb|a negative count|arrays of more than": glb(
        accessors=array(count=-(10**9)) + array(count=10**9)
    ),
    "h.glb|a count beyond any number|arrays of more than": packed(
        json.dumps({"accessors": array(count=10**4000)}).encode(), BINARY
    ),
    "i.glb|a megabyte in twenty thousand views|arrays of more than": glb(
        bytes(1_000_000), bufferViews=[{"buffer": 0, "byteLength": 10**6}] * 20_000
    ),
    "j.glb|an array that overlaps itself|arrays of more than": glb(
        bytes(1_000_000),
        bufferViews=[{"buffer": 0, "byteLength": 10**6, "byteStride": 1}],
        accessors=array(count=999_936, type="MAT4") * 9,
    ),
    "k.glb|one array a thousand times|or over 30000000 values": glb(
        LARGE_BINARY, **LARGE, meshes=[BARE] * 1000
    ),
    "l.glb|a million primitives|100000 primitives": glb(
        meshes=[{"primitives": BARE["primitives"] * 100_000}]
    ),
    "m.glb|a million nodes|100000 nodes": glb(nodes=[{"mesh": 0}] * 100_000),
    "n.glb|a node that holds itself|two parents": glb(nodes=[{"mesh": 0, "children": [0]}]),
    "o.glb|two nodes that hold each other|two parents": glb(
        nodes=[{"mesh": 0, "children": [1]}, {"mesh": 0, "children": [0]}]
    ),
    "p.glb|a mesh shown a thousand times|5000000 triangles": glb(
        LARGE_BINARY, **LARGE, meshes=[BARE],
        nodes=[{"mesh": 0}] * 1000, scenes=[{"nodes": list(range(1000))}],
    ),
    "q.glb|a header that nests|Recursion": packed(b"[" * 100_000, BINARY),
    "r.glb|a header of another length|not the 4294967295": packed(b"{}", BINARY, length=2**32 - 1),
    "s.glb|a chunk of gigabytes|bytes of JSON": struct.pack(
        "<4sIII4s", b"glTF", 2, 20, 2**32 - 1, b"JSON"
    ),
    "t.glb|a texture of terapixels|texture that cannot": textured(png(2**31 - 1)),
    "u.glb|a texture that runs|texture that cannot": textured(
        b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 8 8\n"
    ),
    "v.glb|a compressed mesh|KHR_draco": glb(
        accessors=[{"componentType": 5126, "count": 3, "type": "VEC3"}],
        extensionsRequired=["KHR_draco_mesh_compression"],
    ),
    "w.glb|a scene of nothing|0 vertices": glb(scenes=[{"nodes": []}]),
    "a.3mf|a bomb|200 MB of text": lambda: archive(model=model(body(1)), bomb=bytes(200_000_000)),
    "b.3mf|a bomb of a model|200 MB of text": lambda: archive(
        model=model(body(1)) + b" " * 200_000_000
    ),
    "c.3mf|a bomb of elements|40 MB of text": lambda: one_model("<a/>" * 10_000_000),
    "d.3mf|a bomb that lies|BadZipFile": lying_archive,
    "e.3mf|laughs|document type": one_model(
        f'<object id="1" name="&a11;">{MESH}</object>',
        before=f'<!DOCTYPE model [<!ENTITY a0 "ha">{LAUGHS}]>',
    ),
    "f.3mf|a file elsewhere|document type": one_model(
        body(1) + "&x;", before='<!DOCTYPE m [<!ENTITY x SYSTEM "file:///etc/passwd">]>'
    ),
    "g.3mf|a hidden file elsewhere|document type": archive(
        model=model(body(1), before='<!DOCTYPE m SYSTEM "http://localhost/m.dtd">')
        .decode().replace('"1.0"?', '"1.0" encoding="UTF-16"?').encode("utf-16")
    ),
    "h.3mf|an object that holds itself|used before its definition": one_model(assembly(1, 1)),
    "i.3mf|two objects that hold each other|used before its definition": one_model(
        assembly(1, 2, 2) + assembly(2, 1, 1)
    ),
    "j.3mf|one that is doubled forty times|over 1000 objects": one_model(
        body(1) + DOUBLED, '<item objectid="39"/>'
    ),
    "k.3mf|a chain without an end|over 1000 objects": one_model(
        body(1) + CHAIN, '<item objectid="49999"/>' * 500
    ),
    "l.3mf|a thousand objects shown|over 1000 objects": one_model(
        body(1), '<item objectid="1"/>' * 100_000
    ),
    "m.3mf|objects in another file|objects in other files": archive(
        model=model(
            body(2, '<components><component objectid="1" path="/3D/x.model"/></components>'),
            '<item objectid="2"/>',
        ),
        **{"3D/x.model": model(body(1))},
    ),
    "n.3mf|a number of a million digits|finite": one_model(
        body(1, MESH.replace('x="9"', f'x="{"9" * 1_000_000}"'))
    ),
    "o.3mf|elements that nest|depth": one_model("<a>" * 100_000 + "</a>" * 100_000),
    "p.3mf|no model|instead of one": archive(readme=b"hello"),
    "q.3mf|an archive of names|instead of one": archive(
        **{f"../../{n}": b"" for n in range(20_000)}
    ),
    "a.off|a billion vertices|states 1000000000": b"OFF\n1000000000 1 0\n0 0 0\n",
    "b.off|a negative count|states -1": TRIANGLE_OFF.replace(b"3 1 0", b"-1 5 0"),
    "c.off|vertices beyond any number|digits": b"OFF\n" + b"9" * 5000 + b" 1 0\n",
    "d.off|a face of four billion corners|4294967295 corners": TRIANGLE_OFF.replace(
        b"3 0 1 2", b"4294967295 0 1 2"
    ),
    "e.off|a face of a googol of corners|with 2 instead": TRIANGLE_OFF.replace(
        b"3 0 1 2", b"9" * 100 + b" 0 1"
    ),
    "f.off|a number of a million digits|finite": TRIANGLE_OFF.replace(b"9", b"9" * 1_000_000, 1),
    "g.off|binary|utf-8": b"OFF BINARY\n" + struct.pack(">III", 2**31, 2**31, 0),
    "h.off|comments|unpack": b"OFF\n" + b"#\n" * 500_000,
}  # fmt: skip


@pytest.mark.parametrize("name", SCENES)
def test_hostile_scenes(name, tmp_path):
    path = tmp_path / "deep" / name.split("|")[0]
    path.parent.mkdir()
    content = SCENES[name]
    path.write_bytes(content() if callable(content) else content)
    with refused(re.escape(name.split("|")[2])):
        read_mesh(path, "mm")


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("a.glb", glb()),
        ("b.glb", glb(nodes=NODES)),
        ("a.3mf", one_model(body(1))),
        ("b.3mf", one_model(body(1) + assembly(2, *[1] * 30), '<item objectid="2"/>')),
        ("a.off", TRIANGLE_OFF),
    ],
)
def test_the_undamaged_scenes_are_read(name, content, tmp_path):
    (tmp_path / name).write_bytes(content)
    with bounded():
        assert len(read_mesh(tmp_path / name, "mm").faces) in (1, 30, 401)


def test_an_external_texture_of_a_glb_is_not_opened(tmp_path):
    (tmp_path / "secret.png").write_bytes(png(4))
    (tmp_path / "a.glb").write_bytes(glb(images=[{"uri": "secret.png"}]))
    with refused("needs the file 'secret.png'; .* inside"):
        read_mesh(tmp_path / "a.glb")
