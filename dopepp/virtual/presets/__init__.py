"""Presets: named, typed distributions of random scenes.

A preset is a YAML file, shipped in ``conf/virtual/preset`` or written by a user. :func:`preset_of`
changes fields by values of a config; in code, use :func:`dataclasses.replace`, or
:meth:`Preset.resized` and :meth:`Preset.reframed` for the size. To add a preset, add a file.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, Final

import numpy as np
from numpy.random import Generator

from dopepp.core.errors import UserError
from dopepp.core.files import CONF
from dopepp.core.validation import Checked, Pair, Range, Span, parse, short_repr
from dopepp.core.yaml import read_yaml
from dopepp.drawing.pictures import Size
from dopepp.geometry.camera import (
    CameraMatrix,
    camera_matrix,
    check_camera,
    crop_camera,
    resize_camera,
)
from dopepp.virtual.body import Distractors
from dopepp.virtual.presets.looks import Lighting, Materials
from dopepp.virtual.presets.placement import FreeTurning, OffsetPlacement, Placement, Turning
from dopepp.virtual.presets.table import Table
from dopepp.virtual.sensor import Sensors

Side = Annotated[int, Range(8, 16384, "pixels")]
Intrinsics = Annotated[tuple[float, float, float, float], Range(-1e6, 1e6, "pixels")]

_FOLDER: Final = CONF / "virtual" / "preset"
_NAMES: Final = tuple(sorted(path.stem for path in _FOLDER.glob("*.yaml")))


@dataclass(frozen=True)
class Preset(Checked):
    """A distribution of scenes.

    Attributes:
        name: Name in messages and records.
        width, height: Image size, pixels.
        horizontal_fov_deg: Horizontal field of view of a camera with square pixels and a centred
            principal point; ignored if ``intrinsics_px`` is given.
        intrinsics_px: fx, fy, cx, cy of an explicit camera, pixels of this image size.
        turning: Distribution of the targets' orientation; like the placement, unused on a table.
        table: The supporting plane; None for floating objects.
        targets_per_image: Number of targets, each a random part; further targets that do not fit
            are left out. On images without targets, a network learns to detect nothing.
        min_visible_fraction: Smallest visible fraction of every target.
        centroid_inside: Whether the image must contain every target's cuboid centre.
        window: (width, height) in pixels of the rendered part of the image, around a random point;
            None renders the whole image.
        depths: Smallest and largest depth of the targets' cuboid centres, metres; None for any.
        clutter: Smallest and largest number of pieces of other images pasted on the background.
        background_contrast: Smallest and largest factor on the background's contrast.

    Raises:
        UserError: The camera is implausible, or a pile is combined with ``min_visible_fraction``,
            ``centroid_inside`` or ``depths``.
    """

    name: str
    width: Side
    height: Side
    horizontal_fov_deg: Annotated[float, Range(5.0, 150.0, "degrees")] = 60.0
    intrinsics_px: Intrinsics | None = None
    turning: Turning = field(default_factory=FreeTurning)
    placement: Placement = field(default_factory=OffsetPlacement)
    table: Table | None = None
    targets_per_image: Annotated[tuple[int, int], Span(0, 100, "a count")] = (1, 1)
    min_visible_fraction: Annotated[float, Range(0.0, 0.95, "share")] = 0.5
    centroid_inside: bool = True
    lighting: Lighting = field(default_factory=Lighting)
    materials: Materials = field(default_factory=Materials)
    distractors: Distractors = field(default_factory=Distractors)
    sensors: Sensors = field(default_factory=Sensors)
    window: tuple[Side, Side] | None = None
    depths: Annotated[Pair, Span(0.0, 1000.0, "metres")] | None = None
    clutter: Annotated[tuple[int, int], Span(0, 1000, "a count")] = (0, 0)
    background_contrast: Annotated[Pair, Span(0.0, 10.0, "factor")] = (1.0, 1.0)

    def __post_init__(self) -> None:
        super().__post_init__()
        check_camera(self.K, (self.width, self.height), f"preset {self.name}")
        has_pile = self.table is not None and self.table.pile is not None
        if has_pile and (self.min_visible_fraction or self.centroid_inside or self.depths):
            raise UserError(
                f"min_visible_fraction={self.min_visible_fraction:g}, "
                f"centroid_inside={self.centroid_inside} and depths={self.depths} of a pile",
                "min_visible_fraction=0, centroid_inside=false and depths=null with table.pile",
                "leave these fields out: physics decides what is visible",
            )

    @property
    def K(self) -> CameraMatrix:  # noqa: N802 (the field's name of the matrix)
        """Camera matrix of the whole image, pixels."""
        if self.intrinsics_px is not None:
            return camera_matrix(*self.intrinsics_px)
        focal = self.width / 2 / math.tan(math.radians(self.horizontal_fov_deg) / 2)
        # Pixel centres are integers, so the image's middle is at (width − 1)/2.
        return camera_matrix(focal, focal, (self.width - 1) / 2, (self.height - 1) / 2)

    def draw_camera(self, rng: Generator) -> tuple[CameraMatrix, Size]:
        """Return K and (width, height), pixels, of the image or, with ``window``, of a random crop.

        A window is centred on a uniformly sampled point, then shifted into the image. A window
        larger than the image is centred on the image.
        """
        K, size = self.K, (self.width, self.height)
        if self.window is None:
            return K, size
        spare = np.array(size) - self.window
        corner = rng.uniform(0, 1, 2) * size - np.array(self.window) / 2
        corner = np.floor(np.where(spare > 0, np.clip(corner, 0, spare), spare / 2))
        return crop_camera(K, *corner), self.window

    def resized(self, width: int, height: int) -> Preset:
        """Return the preset for another image size; a different aspect ratio stretches images."""
        K = resize_camera(self.K, width / self.width, height / self.height)
        return self._with_camera(K, width, height, width / self.width)

    def reframed(self, width: int, height: int) -> Preset:
        """Return the preset for another image size, with the pixels' aspect ratio kept.

        The field of view along the shorter side stays. Along the longer side the image is cropped
        or extended equally at both ends.
        """
        side, new_side = min(self.width, self.height), min(width, height)
        scale = new_side / side
        K = resize_camera(self.K, scale, scale)
        K[0, 2] += (width * side - new_side * self.width) / (2 * side)
        K[1, 2] += (height * side - new_side * self.height) / (2 * side)
        return self._with_camera(K, width, height, scale)

    def _with_camera(self, K: CameraMatrix, width: int, height: int, scale: float) -> Preset:
        """Return the preset for another camera, with the sensor's blurs multiplied by ``scale``."""
        sensors, intrinsics = self.sensors.resized(scale), intrinsics_of(K)
        return replace(self, width=width, height=height, sensors=sensors, intrinsics_px=intrinsics)


def intrinsics_of(K: CameraMatrix) -> tuple[float, float, float, float]:
    """Return fx, fy, cx and cy of a camera matrix, pixels."""
    return float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2])


class _Presets(Mapping[str, Preset]):
    """The shipped presets by name; a preset's file is read on access."""

    def __getitem__(self, name: str) -> Preset:
        if name not in _NAMES:
            raise KeyError(name)
        return preset_of(name)

    def __contains__(self, name: object) -> bool:
        return name in _NAMES

    def __iter__(self) -> Iterator[str]:
        return iter(_NAMES)

    def __len__(self) -> int:
        return len(_NAMES)


PRESETS: Final[Mapping[str, Preset]] = _Presets()  # Shipped presets by name


def preset_of(name: str, changes: object = None, where: str = "") -> Preset:
    """Return a preset with some fields changed.

    Args:
        name: Shipped preset, or a user's YAML file whose ``base`` names the preset to change.
        changes: Values by field. A mapping changes some fields of a group, e.g.
            ``{"horizontal_fov_deg": 70, "materials": {"metal_share": 0.2}}``. A group that the
            preset lacks (``table`` of ``paper``) or a group of another ``kind`` starts from its
            defaults; None removes a group.
        where: Option that holds the changes, for messages.

    Raises:
        UserError: A preset or field is unknown, or a value has the wrong type or range.
    """
    base, changes = resolve_base(name, changes)
    return parse(Preset, _merge({"name": base, **_read_shipped(base)}, changes), where)


def resolve_base(name: str, changes: object = None) -> tuple[str, object]:
    """Return the shipped base preset of ``name``, and the file's and caller's changes to it.

    Raises:
        UserError: The preset does not exist, or the file is not a mapping with a ``base``.
    """
    path = Path(name)
    if path.suffix != ".yaml":
        if name not in _NAMES:
            allowed = f"{', '.join(_NAMES)}, or a FILE.yaml"
            fix = "set the preset to one of these names, or to the path of a file"
            raise UserError(f"preset {name!r}", allowed, fix)
        return name, changes or {}
    fields: Any = read_yaml(path)
    base = fields.pop("base", None) if isinstance(fields, dict) else None
    if base not in _NAMES:
        fix = "set base to the name of the preset that the file changes"
        raise UserError(f"{path} with base={short_repr(base)}", ", ".join(_NAMES), fix)
    return base, _merge({"name": path.stem, **fields}, changes or {})


def _read_shipped(name: str) -> Any:
    """Return the fields of a shipped preset, including the fields of its base."""
    fields: Any = read_yaml(_FOLDER / f"{name}.yaml")
    base = fields.pop("base", None)
    return fields if base is None else _merge(_read_shipped(base), fields)


def _merge(values: Any, changes: Any) -> Any:
    """Return ``values`` with nested changes; a mapping of another ``kind`` is replaced whole."""
    if not isinstance(values, dict) or not isinstance(changes, dict):
        return changes
    if changes.get("kind", values.get("kind")) != values.get("kind"):
        return changes
    changed = {key: _merge(values.get(key), value) for key, value in changes.items()}
    return {**values, **changed}
