"""GLB files, glTF in one file: checked to be whole and harmless, then read by trimesh.

What trimesh passes over without a word is refused: compressed, quantised and sparse data, triangle
fans, textures that are moved. Lines, points, colours, normals, skins and animations are left out:
a part's look is its shape and its texture.
"""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any, Final

import numpy as np
from jaxtyping import UInt8

from dopepp.drawing.pictures import whole_picture
from dopepp.errors import UserError
from dopepp.parts.library import MAX_PIECES, read_scene
from dopepp.parts.measure import RawMesh

MAX_HEADER_BYTES: Final = 10_000_000
"""Of the JSON: Python takes twenty times as much memory."""

MAX_VALUES: Final = 30_000_000
"""Numbers and vectors that primitives use: each gets a copy, of an array that others use too."""

_FLOAT: Final = 5126
_TRIANGLES: Final = 4
_FAN: Final = 6
"""glTF's numbers of a type and of two modes; lower modes are points and lines."""


def read_glb(path: Path) -> RawMesh:
    """Read what a GLB file's scene shows, in metres, with its one texture.

    Raises:
        UserError: It needs other files, or its faces have several textures.
        ValueError: It is cut short, damaged or too large, or has what is not read.
    """
    header, binary = _chunks(path.read_bytes())
    files = [entry for kind in ("buffers", "images") for entry in header.get(kind, ())]
    if outside := [entry["uri"] for entry in files if "uri" in entry]:
        raise UserError(
            f"mesh {path} that needs the file {str(outside[0])[:60]!r}",
            "a GLB file with its arrays and textures inside",
            "export the mesh again as one binary file",
        )
    primitives = [p for mesh in header.get("meshes", ()) for p in mesh["primitives"]]
    _check(header, primitives, len(binary))
    drawn = [p for p in primitives if p.get("mode", _TRIANGLES) >= _TRIANGLES]
    pictures = {_picture(header, primitive) for primitive in drawn}
    if len(pictures) > 1:
        raise UserError(
            f"mesh {path} with faces of {len(pictures)} textures",
            "one texture for all faces, or none",
            "bake them into one texture, or remove them",
        )
    picture = next(iter(pictures), None)
    texture = None if picture is None else _texture(header, binary, picture)
    # trimesh would open pictures of any kind; for texture coordinates it needs but a material.
    header |= {"images": [], "materials": [{} for _ in header.get("materials", ())]}
    mesh, _ = read_scene(_packed(header, binary), "glb")
    return mesh._replace(uv=None if texture is None else mesh.uv, texture=texture, unit="m")


def _chunks(data: bytes) -> tuple[dict[str, Any], bytes]:
    """Return the JSON and the binary chunk, without which trimesh takes a file as well."""
    magic, version, length, size, kind = struct.unpack_from("<4sIII4s", data)
    if (magic, version, kind, length) != (b"glTF", 2, b"JSON", len(data)):
        raise ValueError(f"{len(data)} bytes, not the {length} of a GLB file of version 2")
    if size > MAX_HEADER_BYTES:
        raise ValueError(f"{size} bytes of JSON, over {MAX_HEADER_BYTES}")
    start = 20 + size + 8
    size, kind = struct.unpack_from("<I4s", data, start - 8)
    if kind != b"BIN\0" or start + size > len(data):
        raise ValueError(f"no binary chunk, or one of less than its {size} bytes")
    return json.loads(data[20 : start - 8]), data[start : start + size]


def _packed(header: dict[str, Any], binary: bytes) -> bytes:
    """Make a GLB file."""
    text = json.dumps(header).encode()
    chunks = struct.pack("<I4s", len(text), b"JSON") + text
    chunks += struct.pack("<I4s", len(binary), b"BIN\0") + binary
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


def _check(header: dict[str, Any], primitives: list[dict[str, Any]], num_bytes: int) -> None:
    """Refuse what trimesh leaves out, and what takes it far more memory or time than the file."""
    required = [name for name in header.get("extensionsRequired", ()) if "_materials_" not in name]
    if required:
        raise ValueError(f"the extension {required[0]}, which is not read")
    if any(primitive.get("mode") == _FAN for primitive in primitives):
        raise ValueError("a fan of triangles, which is not read")
    accessors = header.get("accessors", ())
    if any("bufferView" not in array or "sparse" in array for array in accessors):
        raise ValueError("an array that is compressed, sparse or left out")
    sizes = [view["byteLength"] for view in header.get("bufferViews", ())]
    counts = [array["count"] for array in accessors]
    used = [i for p in primitives for i in (*p["attributes"].values(), p.get("indices"))]
    num_values = sum(counts[i] for i in used if i is not None)
    # An item is a byte at least; views of the same bytes, and arrays of the same items, are rare.
    too_many = max(sum(sizes) // 2, sum(counts)) > num_bytes or num_values > MAX_VALUES
    if min(sizes + counts, default=0) < 0 or too_many:
        raise ValueError(f"arrays of more than its {num_bytes} bytes, or over {MAX_VALUES} values")
    nodes = header.get("nodes", ())
    if max(len(nodes), len(primitives)) > MAX_PIECES:
        raise ValueError(f"{len(nodes)} nodes and {len(primitives)} primitives, over {MAX_PIECES}")
    children = [child for node in nodes for child in node.get("children", ())]
    for scene in header.get("scenes", ())[header.get("scene", 0) :][:1]:
        children += scene.get("nodes", ())
    if len(set(children)) < len(children):
        raise ValueError("a node in two places")


def _picture(header: dict[str, Any], primitive: dict[str, Any]) -> int | None:
    """Return which picture gives a primitive its colours, None for one without."""
    material = header["materials"][primitive["material"]] if "material" in primitive else {}
    info = material.get("pbrMetallicRoughness", {}).get("baseColorTexture")
    if info is None:
        return None
    array = primitive["attributes"].get("TEXCOORD_0")
    if array is None or header["accessors"][array]["componentType"] != _FLOAT:
        raise ValueError("a texture, and faces without texture coordinates that are floats")
    if info.get("texCoord") or "KHR_texture_transform" in info.get("extensions", {}):
        raise ValueError("a texture with a transform, or with the second texture coordinates")
    return int(header["textures"][info["index"]]["source"])


def _texture(
    header: dict[str, Any], binary: bytes, picture: int
) -> UInt8[np.ndarray, "height width 3"]:
    view = header["bufferViews"][header["images"][picture]["bufferView"]]
    start = view.get("byteOffset", 0)
    try:
        image = whole_picture(binary[start : start + view["byteLength"]])
    except ValueError as error:
        raise ValueError(f"a texture that cannot be read: {error}") from error
    return np.asarray(image.convert("RGB"))
