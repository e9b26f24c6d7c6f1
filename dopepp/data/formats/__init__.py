"""Code that several layouts use: instances, shares of a data set, and resumable writers.

Writers finalize items chunk by chunk. An item's last file marks the item as complete. Files that a
chunk's items share (``scene_gt.json``, a tar shard) are assembled from items staged in a hidden
folder. To add a format, see ``docs/how-to/adding-a-data-format.md``.
"""

from __future__ import annotations

import fcntl
import hashlib
import json
import math
import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, Final, Protocol, runtime_checkable

import numpy as np

from dopepp.core.errors import UserError
from dopepp.core.files import write_file
from dopepp.core.json import MAX_BYTES, read_json
from dopepp.data.sample import Instance, Sample, hull_areas
from dopepp.drawing.pictures import Mask, Shape
from dopepp.geometry.camera import CameraMatrix, Transform, project, project_keypoints, transform
from dopepp.parts.part import Part

STAGING: Final = ".items"  # folder of staged items; readers skip hidden names

RECORD_FILE: Final = "_dopepp_render.json"
"""A render job's record. The underscore marks a settings file, so NDDS readers skip it."""

ESTIMATED: Final = (
    "estimated: mask pixels, or the hull's pixels inside the image, over the hull of the points"
)

_ATTEMPTS: Final = 100


@runtime_checkable
class FileSource(Protocol):
    """Source that lists its files, so that a cache on disk is not reused for changed files."""

    def files(self) -> Iterable[Path]:
        """Return the annotations, images and masks of the samples; some files may not exist."""


def hash_files(paths: Iterable[Path], root: Path) -> str:
    """Return the SHA-256 (hex) of the files' paths relative to ``root``, sizes and times.

    The times are those of the last change. The code of this package, which reads the files, is
    also hashed. Missing files are left out.
    """
    digest, package = hashlib.sha256(), Path(__file__).parent
    for path in sorted(package.rglob("*.py")):
        digest.update(path.read_bytes())
    for path in paths:
        with suppress(FileNotFoundError):
            entry, name = path.stat(), os.path.relpath(path, root)
            digest.update(f"{name} {entry.st_size} {entry.st_mtime_ns}\n".encode())
    return digest.hexdigest()


class Writer(Protocol):
    """Writer of samples into a folder; each process makes a writer from (folder, parts).

    A file exists completely or not at all. The bytes of an item depend on (index, sample) only.
    """

    name: str
    """Name of the layout: ``bop``, ``ndds`` or ``webdataset``."""

    chunk_size: int
    """Items ``chunk·chunk_size … (chunk + 1)·chunk_size − 1`` are finalized together."""

    def prepare(self) -> None:
        """Write the files that all items share, idempotently; reject a folder of other data."""

    def write(self, index: int, sample: Sample) -> None:
        """Write an item completely; no crash after the call can damage it."""

    def written(self, chunk: int) -> set[int]:
        """Return the indices of the chunk's complete items, finalized or not."""

    def finalize(self, chunk: int, indices: Sequence[int]) -> None:
        """Assemble the files that the chunk's items share: idempotent, atomic, process-safe.

        A finalized chunk may be finalized again after later items have been added to it.
        """


def share_slice(num_items: int, part_of: tuple[float, float], name: str) -> slice:
    """Return the slice of ``num_items`` items between two ascending fractions in [0, 1].

    Equal bounds are rounded equally, so adjacent shares neither overlap nor leave a gap.

    Raises:
        UserError: The share has no item.
    """
    first, last = part_of
    part = slice(round(first * num_items), round(last * num_items))
    if part.start == part.stop:
        problem = f"{name}: no image in the fraction {first:.3g} – {last:.3g} of {num_items} images"
        fix = "set data.image_sets to a separate folder for each split"
        raise UserError(problem, "a folder with more images", fix)
    return part


def make_instance(
    part: Part,
    T_cam_obj: Transform,
    K: CameraMatrix,
    visible_fraction: float,
    mask: Mask | None,
    shape: Shape,
) -> Instance:
    """Return the instance of a part at a pose, on an image of ``shape``.

    A visible fraction of NaN is estimated: the number of mask pixels (without a mask, the hull's
    area inside the image) divided by the area of the convex hull of the projected ADD points. The
    estimate is too small for a concave object.
    """
    if math.isnan(visible_fraction):
        inside, whole = hull_areas(project(transform(T_cam_obj, part.points), K), shape)
        visible = inside if mask is None else float(np.count_nonzero(mask))
        visible_fraction = min(1.0, visible / whole) if whole > 0 else 0.0
    keypoints = project_keypoints(part.cuboid, T_cam_obj, K)
    return Instance(part.name, T_cam_obj, keypoints, visible_fraction, mask)


def read_object(path: Path, max_bytes: int = MAX_BYTES) -> dict[str, Any]:
    """Read the JSON object that a writer will extend; return an empty one if the file is missing.

    Raises:
        UserError: The file is not a JSON object.
    """
    content = read_json(path, max_bytes) if path.exists() else {}
    if not isinstance(content, dict):
        fix = "restore the file from backup, or choose another folder"
        raise UserError(f"{path}, which is no JSON object", "a file of `dopepp render`", fix)
    return content


def encode_by_key(content: Mapping[str, object]) -> bytes:
    """Encode a JSON object as text with one line per key."""
    lines = [f"  {json.dumps(key)}: {json.dumps(value)}" for key, value in content.items()]
    return ("{\n" + ",\n".join(lines) + "\n}\n").encode()


def stage_item(path: Path, content: bytes) -> None:
    """Write an item to a file in a staging folder that other processes may remove meanwhile."""
    # A folder removed before its use is not found; a folder removed within ``mkdir`` "exists".
    for _ in range(_ATTEMPTS - 1):
        with suppress(FileNotFoundError, FileExistsError):
            return write_file(path, content)
    return write_file(path, content)


def staged_items(staging: Path, suffix: str) -> list[Path]:
    """Return the staged files ``NUMBER*SUFFIX`` in order; none if the folder is missing."""
    with suppress(FileNotFoundError):
        return sorted(staging.glob(f"[0-9]*{suffix}"))
    return []


@contextmanager
def locked(path: Path) -> Iterator[None]:
    """Lock a file against other processes; the system releases the lock of a killed process."""
    with path.open("r+b") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        yield
