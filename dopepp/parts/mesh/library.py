"""STL, 3MF and GLB files: checked to be complete and harmless, then read by trimesh.

trimesh reads a truncated file as a smaller mesh, ignores unknown content, and uses as much memory
and time as a file requests (``tests/parts/mesh/test_library.py``,
``tests/security/test_hostile_scenes.py``). GLB files with compressed, quantised or sparse data,
triangle fans or transformed textures are refused, and so is glTF in several files. Only shape and
texture are read.

To add a format of trimesh, check its file first and pass it to :func:`read_scene`.
"""

from __future__ import annotations

import io
import json
import re
import struct
import warnings
import zipfile
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from dopepp.core.errors import UserError
from dopepp.drawing.pictures import as_rgb, whole_image
from dopepp.geometry.camera import Transform
from dopepp.parts.mesh import Vertices, weld
from dopepp.parts.part import RawMesh

MAX_UNPACKED_BYTES: Final = 50_000_000
"""Largest text in a 3MF file: trimesh uses 17 times as much memory."""

MAX_PIECES: Final = 1000  # Most meshes of a part; bounds time
MAX_TRIANGLES: Final = 5_000_000  # sum over all pieces, counted once per instance
UNITS_3MF: Final = {"millimeter": "mm", "centimeter": "cm", "meter": "m", "inch": "inch"}
"""Unit by 3MF's name; 3MF also has feet and micrometres."""

_STL_HEADER: Final = 84
_STL_TRIANGLE: Final = 50
"""Bytes of a binary STL file's header (title and uint32 count) and of each triangle."""

MAX_HEADER_BYTES: Final = 10_000_000  # size of the JSON; Python needs 20 times as much memory
MAX_VALUES: Final = 30_000_000
"""Most numbers and vectors of all primitives, which copy shared arrays."""

_FLOAT: Final = 5126  # glTF's number of float32
_TRIANGLES: Final = 4  # glTF's number of the mode; lower numbers are points and lines


def read_stl(path: Path) -> RawMesh:
    """Read a binary or text STL file, and merge corners at equal positions.

    Raises:
        ValueError: The length disagrees with the number of triangles, or a number is not finite.
    """
    data = path.read_bytes()
    num_triangles = int.from_bytes(data[_STL_HEADER - 4 : _STL_HEADER], "little")
    promised = _STL_HEADER + _STL_TRIANGLE * num_triangles
    # Binary headers may begin with the text format's "solid", so the length decides.
    is_text = len(data) != promised or not num_triangles
    if is_text and b"\0" in data:  # never in text
        stated = f"{num_triangles} triangles, {promised} bytes"
        raise ValueError(f"{len(data)} bytes, but the header states {stated}")
    mesh, _ = read_scene(data, "stl")
    vertices, faces = mesh.vertices, mesh.faces
    # trimesh omits a text file's last solid if it is truncated.
    facets = re.finditer(rb"\bfacet\s+normal\b", data, re.IGNORECASE)
    begun = sum(1 for _ in facets) if is_text else len(faces)
    if begun != len(faces):
        raise ValueError(f"{begun} facets begun and {len(faces)} ended")
    finite = np.isfinite(vertices).all(axis=1)
    if not finite.all():  # reported here, where triangles have their original numbers
        triangle, vertex = divmod(int(np.flatnonzero(~finite[faces.reshape(-1)])[0]), 3)
        location = f"triangle {triangle + 1}, vertex {vertex + 1}"
        raise ValueError(f"a coordinate that is not a finite number, {location}")
    return RawMesh(*weld(vertices, faces))


def read_3mf(path: Path) -> RawMesh:
    """Read the objects placed by the build of a 3MF file, with the unit of the file.

    Raises:
        UserError: The unit is not one of :data:`UNITS_3MF`.
        ValueError: The archive is incomplete or too large, declares a document type, or its build
            uses objects of other files or objects that are defined later.
    """
    size = path.stat().st_size
    _check_size(size)
    with zipfile.ZipFile(path) as archive:
        unpacked = sum(info.file_size for info in archive.infolist())
        # Models unpack to 5 to 15 times their size.
        _check_size(unpacked, max(MAX_UNPACKED_BYTES // 10, 30 * size))
        names = [name for name in archive.namelist() if "3d/3dmodel.model" in name.lower()]
        if len(names) != 1:
            raise ValueError(f"{len(names)} files 3D/3dmodel.model instead of one")
        model = archive.read(names[0])
    if b"<!DOCTYPE" in model.replace(b"\0", b""):  # without NUL bytes, the test also finds UTF-16
        raise ValueError("a document type, which 3MF forbids")
    num_pieces = _count_pieces(model)
    mesh, num_read = read_scene(path.read_bytes(), "3mf")
    if num_read != num_pieces:  # trimesh gives up on large assemblies
        raise ValueError(f"{num_pieces} objects shown, {num_read} read")
    unit = str(mesh.unit).removesuffix("s")  # trimesh calls the default unit "millimeters"
    if unit not in UNITS_3MF:
        problem, allowed = f"mesh {path} in the unit {unit!r}", ", ".join(UNITS_3MF)
        raise UserError(problem, allowed, "export the mesh in millimetres")
    return replace(mesh, unit=UNITS_3MF[unit])


def _count_pieces(model: bytes) -> int:
    """Return the number of mesh instances that the build of a 3MF model places."""
    # trimesh spends hours on objects that contain themselves or are doubled twenty times, and reads
    # all objects of another file instead of the named object.
    from lxml import etree

    pieces: dict[str, int] = {}
    shown = 0
    tags = ("{*}object", "{*}item")
    for _, element in etree.iterparse(io.BytesIO(model), tag=tags, resolve_entities=False):
        users = [element] if element.tag.endswith("item") else element.findall(".//{*}component")
        if any(name.endswith("path") for user in users for name in user.attrib):
            raise ValueError("objects in other files of the archive")
        unknown = [user.get("objectid") for user in users if user.get("objectid") not in pieces]
        if unknown:
            raise ValueError(f"object {unknown[0]!r} used before its definition, or never defined")
        count = sum(pieces[user.get("objectid")] for user in users)
        if element.tag.endswith("item"):
            shown += count
        else:
            pieces[element.attrib["id"]] = count or 1
        if max(len(pieces), shown, count) > MAX_PIECES:
            raise ValueError(f"over {MAX_PIECES} objects")
    return shown


def _check_size(num_bytes: int, max_bytes: int = MAX_UNPACKED_BYTES) -> None:
    """Raise a ``ValueError`` if unpacked data exceed ``max_bytes`` or ``MAX_UNPACKED_BYTES``."""
    if num_bytes > min(max_bytes, MAX_UNPACKED_BYTES):
        raise ValueError(f"{num_bytes / 1e6:.0f} MB of text, over {max_bytes / 1e6:.0f} MB")


def read_glb(path: Path) -> RawMesh:
    """Read the scene of a GLB file, in metres, with at most one texture.

    Raises:
        UserError: The file needs other files, or its faces have several textures.
        ValueError: The file is truncated, damaged, too large, or uses an unsupported feature.
    """
    header, binary = _chunks(path.read_bytes())
    files = [entry for kind in ("buffers", "images") for entry in header.get(kind, ())]
    if outside := [entry["uri"] for entry in files if "uri" in entry]:
        problem = f"mesh {path} that needs the file {str(outside[0])[:60]!r}"
        allowed = "a GLB file with its arrays and textures inside"
        raise UserError(problem, allowed, "export the mesh again as one binary file")
    primitives = [p for mesh in header.get("meshes", ()) for p in mesh["primitives"]]
    _check(header, primitives, len(binary))
    drawn = [p for p in primitives if p.get("mode", _TRIANGLES) >= _TRIANGLES]
    images = {_image_number(header, primitive) for primitive in drawn}
    if len(images) > 1:
        problem = f"mesh {path} with faces of {len(images)} textures"
        fix = "bake them into one texture, or remove them"
        raise UserError(problem, "one texture for all faces, or none", fix)
    number = next(iter(images), None)
    texture = None
    if number is not None:
        view = header["bufferViews"][header["images"][number]["bufferView"]]
        start = view.get("byteOffset", 0)
        try:
            content = binary[start : start + view["byteLength"]]
            texture = np.asarray(as_rgb(whole_image(content), content))
        except ValueError as error:
            raise ValueError(f"a texture that cannot be read: {error}") from error
    # trimesh would open images of any kind; texture coordinates only need a material.
    header |= {"images": [], "materials": [{} for _ in header.get("materials", ())]}
    mesh, _ = read_scene(_packed(header, binary), "glb")
    return replace(mesh, uv=None if texture is None else mesh.uv, texture=texture, unit="m")


def _chunks(data: bytes) -> tuple[dict[str, Any], bytes]:
    """Return JSON header and binary chunk of a GLB file; both are required, unlike in trimesh."""
    magic, version, length, size, kind = struct.unpack_from("<4sIII4s", data)
    if (magic, version, kind, length) != (b"glTF", 2, b"JSON", len(data)):
        raise ValueError(f"{len(data)} bytes, not the {length} of a GLB file of version 2")
    if size > MAX_HEADER_BYTES:
        raise ValueError(f"{size} bytes of JSON, over {MAX_HEADER_BYTES}")
    start = 20 + size + 8
    size, kind = struct.unpack_from("<I4s", data, start - 8)
    if kind != b"BIN\0" or start + size > len(data):
        raise ValueError(f"binary chunk missing or shorter than its stated {size} bytes")
    return json.loads(data[20 : start - 8]), data[start : start + size]


def _packed(header: dict[str, Any], binary: bytes) -> bytes:
    text = json.dumps(header).encode()
    chunks = struct.pack("<I4s", len(text), b"JSON") + text
    chunks += struct.pack("<I4s", len(binary), b"BIN\0") + binary
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


def _check(header: dict[str, Any], primitives: list[dict[str, Any]], num_bytes: int) -> None:
    """Reject glTF features that trimesh ignores, and files that need excessive memory or time."""
    required = [name for name in header.get("extensionsRequired", ()) if "_materials_" not in name]
    if required:
        raise ValueError(f"the extension {required[0]}, which is not read")
    if any(primitive.get("mode") == 6 for primitive in primitives):
        raise ValueError("a fan of triangles, which is not read")
    accessors = header.get("accessors", ())
    if any("bufferView" not in array or "sparse" in array for array in accessors):
        raise ValueError("an array that is compressed, sparse or missing")
    sizes = [view["byteLength"] for view in header.get("bufferViews", ())]
    counts = [array["count"] for array in accessors]
    used = [i for p in primitives for i in (*p["attributes"].values(), p.get("indices"))]
    num_values = sum(counts[i] for i in used if i is not None)
    # An item has at least one byte; overlapping views and arrays are rare.
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
        raise ValueError("a node with two parents")


def _image_number(header: dict[str, Any], primitive: dict[str, Any]) -> int | None:
    """Return the index of the image of a primitive's colour texture, or None without a texture."""
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


def read_scene(data: bytes, kind: str) -> tuple[RawMesh, int]:
    """Read a file's content with trimesh, which cannot access other files without a path.

    ``kind`` is the suffix of the format, without the dot.

    Returns:
        The merged meshes, with trimesh's name of the unit, and the number of meshes.

    Raises:
        ValueError: A face refers to a missing vertex, or there are too many triangles.
        Exception: Any exception of trimesh for a damaged file.
    """
    import trimesh  # imported late, because it is slow

    # Infinite corners are reported later, not by trimesh.
    with warnings.catch_warnings(), np.errstate(invalid="ignore", over="ignore"):
        # numpy stops at a damaged number with a warning only.
        warnings.simplefilter("error", DeprecationWarning)
        scene = trimesh.load_scene(io.BytesIO(data), file_type=kind, process=False)
    vertices, faces = [np.empty((0, 3))], [np.empty((0, 3), np.int64)]
    uvs: list[Any] = []
    start = num_triangles = 0
    for node in scene.graph.nodes_geometry:
        transform, name = scene.graph[node]
        mesh = scene.geometry[name]
        if not hasattr(mesh, "faces"):
            continue  # lines and points
        if len(mesh.faces) and not 0 <= mesh.faces.min() <= mesh.faces.max() < len(mesh.vertices):
            raise ValueError(f"a face index outside of its {len(mesh.vertices)} vertices")
        num_triangles += len(mesh.faces)
        if num_triangles > MAX_TRIANGLES:
            raise ValueError(f"over {MAX_TRIANGLES} triangles")
        vertices.append(_transform_vertices(np.asarray(mesh.vertices), transform))
        faces.append(np.asarray(mesh.faces) + start)
        uvs.append(getattr(mesh.visual, "uv", None))
        start += len(mesh.vertices)
    uv = None if not uvs or any(uv is None for uv in uvs) else np.concatenate(uvs)
    if uv is not None and uv.shape != (start, 2):
        raise ValueError(f"{len(uv)} texture coordinates of {start} vertices")
    unit = scene.metadata.get("units")
    return RawMesh(np.concatenate(vertices), np.concatenate(faces), uv, unit=unit), len(uvs)


def _transform_vertices(vertices: Vertices, transform: Transform) -> Vertices:
    """Apply a transform to vertices, with bit-identical results on every processor."""
    if (transform == np.eye(4)).all():
        return vertices  # a product would spread infinite coordinates as NaN
    # The last digits of a matrix product would depend on the processor.
    rows = zip(vertices.T, transform[:3, :3].T, strict=True)
    return np.asarray(sum(x[:, None] * row for x, row in rows) + transform[:3, 3])
