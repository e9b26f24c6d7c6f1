"""Named, typed descriptions of random scenes; every range has its unit in its name or docstring.

To change one, use :func:`dataclasses.replace` (:meth:`Preset.resized` and :meth:`Preset.reframed`
for the size), or :func:`customised_preset` with plain values, as a config gives them. To add one,
put a :class:`Preset` into :data:`PRESETS`.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Mapping
from dataclasses import dataclass, field, is_dataclass, replace
from types import NoneType, UnionType
from typing import Any, Final, TypeVar, get_args, get_origin, get_type_hints

import numpy as np
from numpy.random import Generator

from dopepp.core.checks import check_number, check_range
from dopepp.core.errors import UserError
from dopepp.drawing.pictures import Size
from dopepp.geometry.camera import (
    CameraMatrix,
    camera_matrix,
    check_camera,
    crop_camera,
    resize_camera,
)
from dopepp.virtual.presets.distractors import Distractors
from dopepp.virtual.presets.looks import Lighting, Materials
from dopepp.virtual.presets.placement import (
    DistancePlacement,
    FacingTurning,
    FillPlacement,
    FreeTurning,
    OffsetPlacement,
    Placement,
    Turning,
    UprightTurning,
)
from dopepp.virtual.presets.table import Table
from dopepp.virtual.sensor import Sensors

T = TypeVar("T")


@dataclass(frozen=True)
class Preset:
    """A distribution of scenes.

    Attributes:
        horizontal_fov_deg: Horizontal field of view, degrees, of a camera with square pixels that
            looks through the image's middle; ignored where ``intrinsics_px`` is given.
        intrinsics_px: fx, fy, cx, cy of an explicit camera, pixels of this image size.
        turning: Distribution of the targets' orientation; of no use on a table.
        table: The plane that everything lies on; None for objects in mid-air.
        targets_per_image: Smallest and largest number of targets, each a random part; one after
            the first that finds no place is left out. Images without any are for learning and
            testing silence.
        min_visible_fraction: Smallest visible fraction of every target; scenes are drawn again,
            a bounded number of times, to keep it.
        centroid_inside: Whether the image of every target's cuboid centre must lie inside the
            frame.
        materials: Distribution of what targets and distractors are made of.
        window: Width and height of the part of the picture that is rendered, around a random point
            of it, pixels; None renders all of it.
        depths: Smallest and largest depth of the targets' cuboids' centres, metres; None for any.
        clutter: Smallest and largest number of flat pieces of other pictures that the background
            is littered with.
        background_contrast: Smallest and largest factor on the background's contrast.
    """

    name: str
    width: int
    height: int
    horizontal_fov_deg: float = 60.0
    intrinsics_px: tuple[float, float, float, float] | None = None
    turning: Turning = field(default_factory=FreeTurning)
    placement: Placement = field(default_factory=OffsetPlacement)
    table: Table | None = None
    targets_per_image: tuple[int, int] = (1, 1)
    min_visible_fraction: float = 0.5
    centroid_inside: bool = True
    lighting: Lighting = field(default_factory=Lighting)
    materials: Materials = field(default_factory=Materials)
    distractors: Distractors = field(default_factory=Distractors)
    sensors: Sensors = field(default_factory=Sensors)
    # Without these, what describes a preset is as it was before there were any.
    window: tuple[int, int] | None = field(default=None, repr=False)
    depths: tuple[float, float] | None = field(default=None, repr=False)
    clutter: tuple[int, int] = field(default=(0, 0), repr=False)
    background_contrast: tuple[float, float] = field(default=(1.0, 1.0), repr=False)

    def __post_init__(self) -> None:
        check_range("targets_per_image", self.targets_per_image, 0, 100, "a count", of=self)
        check_range("clutter", self.clutter, 0, 1000, "a count", of=self)
        check_range("background_contrast", self.background_contrast, 0.0, 10.0, "factor", of=self)
        for name in ("width", "height"):
            check_number(name, getattr(self, name), 8, 16384, "pixels", of=self)
        for side in self.window or ():
            check_number("window", side, 8, 16384, "pixels", of=self)
        if self.depths is not None:
            check_range("depths", self.depths, 0.0, 1000.0, "metres", of=self)
        check_number("min_visible_fraction", self.min_visible_fraction, 0.0, 0.95, "share", of=self)
        check_number("horizontal_fov_deg", self.horizontal_fov_deg, 5.0, 150.0, "degrees", of=self)
        check_camera(self.K, (self.width, self.height), f"preset {self.name}")

    @property
    def K(self) -> CameraMatrix:  # noqa: N802 (the field's name of the matrix)
        """Camera matrix, pixels."""
        if self.intrinsics_px is not None:
            return camera_matrix(*self.intrinsics_px)
        focal = self.width / 2 / math.tan(math.radians(self.horizontal_fov_deg) / 2)
        # Pixel centres are integers, so the image's middle is at (width − 1)/2.
        return camera_matrix(focal, focal, (self.width - 1) / 2, (self.height - 1) / 2)

    def draw_camera(self, rng: Generator) -> tuple[CameraMatrix, Size]:
        """Return K and (width, height) of what is rendered: all of the picture, or a window of it.

        A window lies around a point that is uniform over the picture, moved into it; where it is
        larger than the picture, it is in its middle. Its principal point may be outside of it.
        """
        K, size = self.K, (self.width, self.height)
        if self.window is None:
            return K, size
        spare = np.array(size) - self.window
        corner = rng.uniform(0, 1, 2) * size - np.array(self.window) / 2
        corner = np.floor(np.where(spare > 0, np.clip(corner, 0, spare), spare / 2))
        return crop_camera(K, *corner), self.window

    def resized(self, width: int, height: int) -> Preset:
        """Return the same scenes in another image size: the camera follows the resize rule.

        A changed aspect ratio stretches the image, so fx and fy differ, as they do when a picture
        is resized.
        """
        K = resize_camera(self.K, width / self.width, height / self.height)
        return self._seen_by(K, width, height, width / self.width)

    def reframed(self, width: int, height: int) -> Preset:
        """Return the same scenes in a picture of another size and shape, with pixels as square.

        The field of view along the shorter side stays; along the longer one the picture is cut or
        shows more, alike at both ends. Of the same shape, it is :meth:`resized`.
        """
        side, new_side = min(self.width, self.height), min(width, height)
        scale = new_side / side
        K = resize_camera(self.K, scale, scale)
        K[0, 2] += (width * side - new_side * self.width) / (2 * side)
        K[1, 2] += (height * side - new_side * self.height) / (2 * side)
        return self._seen_by(K, width, height, scale)

    def _seen_by(self, K: CameraMatrix, width: int, height: int, scale: float) -> Preset:
        """Return the same scenes in another camera, with pixels ``scale`` times as fine."""
        return replace(
            self, width=width, height=height, sensors=self.sensors.resized(scale),
            intrinsics_px=(float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2])),
        )  # fmt: skip


_MILD_LIGHT: Final = Lighting((1, 2), temperature_k=(5000.0, 8000.0))
_MILD_MATERIALS: Final = Materials(metal_share=0.05, layer_slope=(0.05, 0.3))
_GOOD_CAMERA: Final = Sensors(
    exposure_ev=(-0.2, 0.2), blur_px=(0.2, 0.5), motion_px=(0.5, 1.5),
    read_noise=(0.3, 1.0), shot_noise=(0.3, 1.5), jpeg_quality=(85, 95),
)  # fmt: skip

PRESETS: dict[str, Preset] = {
    preset.name: preset
    for preset in (
        # Paper section 2.1: 640×480, camera 20 cm from the origin, ±10 cm along and ±15 cm across
        # the optical axis, free rotation, random light, random background. The field of view is
        # not in the paper: 90° is an inference, the one at which ±15 cm just spans the image's
        # height (30 cm of 40 cm × 30 cm) at 20 cm. Nearer, the sides of this box are out of the
        # picture (at 10 cm it shows ±10 cm × ±7.5 cm; all of it would take 127°), so no camera of
        # this view can have the part uniform in all three. It is uniform across the axis and over
        # rotations; the depth is drawn again, for one scene of five, until the part is seen: mean
        # 21.9 cm, a third of the parts nearer than 20 cm (benchmarks/placement.py).
        Preset("paper", 640, 480, horizontal_fov_deg=90.0, distractors=Distractors((0, 0))),
        # A task that two cores learn in minutes: one face, a limited range of poses, a good camera.
        Preset(
            "quickstart", 128, 128, turning=FacingTurning(), placement=FillPlacement(),
            min_visible_fraction=0.7,
            lighting=_MILD_LIGHT, materials=_MILD_MATERIALS, sensors=_GOOD_CAMERA,
            distractors=Distractors(lookalike_share=0.15),
        ),
        # The quickstart's light, materials and camera, all poses that show the part's face.
        Preset(
            "wide", 128, 128, turning=FacingTurning(in_plane_deg=180.0, tilt_deg=60.0),
            placement=DistancePlacement(0.12, 0.25, margin=0.2), distractors=Distractors((0, 4)),
            lighting=_MILD_LIGHT, materials=_MILD_MATERIALS, sensors=_GOOD_CAMERA,
        ),
        # Textured household objects as YCB-Video's first camera sees them (scenes 0000 to 0059).
        Preset(
            "ycb", 640, 480, intrinsics_px=(1066.778, 1067.487, 312.9869, 241.3109),
            placement=DistancePlacement(), distractors=Distractors((0, 3)),
        ),
        # Objects that stand upright among others and hide each other, seen from above, as LM, LM-O,
        # HB and a scanned part's own turntable show them.
        Preset(
            "upright", 640, 480, turning=UprightTurning(), placement=DistancePlacement(0.5, 1.5),
            targets_per_image=(1, 4), min_visible_fraction=0.2,
            distractors=Distractors((0, 4), image_share=(0.05, 0.3)),
        ),
        # Parts that lie on a table beside others, as a robot's wrist camera sees them.
        Preset(
            "table", 640, 480, table=Table(), targets_per_image=(1, 3),
            distractors=Distractors((0, 8), image_share=(0.06, 0.25), lookalike_share=0.4),
        ),
        # A heap of parts that hide each other.
        Preset(
            "bin", 640, 480,
            table=Table(distance=(0.3, 0.6), elevation_deg=(45.0, 90.0), tilted_share=0.6,
                        heaped=True),
            targets_per_image=(3, 10), min_visible_fraction=0.15,
            materials=Materials(alike_share=0.8),
            distractors=Distractors((0, 2), image_share=(0.06, 0.2)),
        ),
    )
}  # fmt: skip
"""The scenes to choose from, by name."""


def customised_preset(name: str, changes: Mapping[str, Any]) -> Preset:
    """Return a preset by name, with nested fields replaced.

    ``changes`` give a value by field or, for a field that is itself a group of fields, a mapping,
    e.g. ``{"horizontal_fov_deg": 70, "materials": {"metal_share": 0.2}}``. A group that the preset
    lacks (``table`` of ``paper``) starts from its defaults; None takes it away. A UserError: the
    name or a field is unknown, or a value is of the wrong kind or outside of what the field allows.
    """
    if name not in PRESETS:
        raise UserError(f"preset {name!r}", ", ".join(PRESETS), "choose one of them")
    return _changed(PRESETS[name], changes, f"preset {name}")


def _changed(described: T, changes: Any, where: str) -> T:
    """Replace fields of a dataclass, going down into those that are dataclasses."""
    if not isinstance(changes, Mapping):
        raise UserError(f"{changes!r} for {where}", "a mapping of fields to values", "nest it")
    hints = get_type_hints(type(described))
    values = {}
    for key, value in changes.items():
        if key not in hints:
            allowed = ", ".join(hints) or "no field"
            raise UserError(f"{key!r} in {where}", allowed, "correct the field's name")
        values[key] = _converted(value, hints[key], getattr(described, key), f"{key} of {where}")
    return replace(described, **values)  # type: ignore[type-var]


def _converted(value: Any, hint: Any, old: Any, where: str) -> Any:
    """Return a plain value as what a field's annotation asks for."""
    # A group's other fields stay as they are in ``old``; ``where`` names the field in messages.
    if get_origin(hint) is UnionType:
        if value is None:
            return None
        (hint,) = (choice for choice in get_args(hint) if choice is not NoneType)
        if old is None and isinstance(hint, type) and is_dataclass(hint):
            old = hint()
    if is_dataclass(old):
        return _changed(old, value, where)
    if get_origin(hint) is tuple:
        kinds = get_args(hint)
        if isinstance(value, (list, tuple)) and len(value) == len(kinds):
            return tuple(_scalar(v, kind, where) for v, kind in zip(value, kinds, strict=True))
        raise UserError(
            f"{value!r} for {where}", f"a list of {len(kinds)} numbers", "change the value"
        )
    return _scalar(value, hint, where)


def _scalar(value: Any, kind: type, where: str) -> Any:
    """Return a number or text of a kind; a whole number will do for any number."""
    if kind is float and isinstance(value, (int, float)) and not isinstance(value, bool):
        if abs(value) <= sys.float_info.max:  # neither NaN nor infinite nor an endless integer
            return float(value)
    elif type(value) is kind:
        return value
    names = {float: "a finite number", int: "a whole number", bool: "true or false", str: "a text"}
    raise UserError(f"{value!r} for {where}", names[kind], "change the value")
