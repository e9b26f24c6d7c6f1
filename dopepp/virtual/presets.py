"""Named, typed descriptions of random scenes; every range has its unit in its name or docstring.

To change one, use :func:`dataclasses.replace` (and :meth:`Preset.resized` for the image size); to
add one, put a :class:`Preset` into ``PRESETS``.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float

from dopepp.errors import UserError
from dopepp.geometry.camera import camera_matrix, check_camera, resize_camera
from dopepp.virtual.placement import (
    DistancePlacement,
    FacingTurning,
    FillPlacement,
    FreeTurning,
    OffsetPlacement,
    Placement,
    Turning,
)


@dataclass(frozen=True)
class Lighting:
    """Ranges of light; intensities are what a white surface facing the light reflects, 1 clips.

    Attributes:
        num_lights: Smallest and largest number of point lights; the first casts shadows.
        key_intensity: Of the first light.
        fill_intensity: Of the second light.
        ambient_intensity: Of the light from everywhere.
        max_angle_deg: Largest angle between a light's direction and the camera's, as seen from
            the scene; 0 is a flash light on the camera, 90 a light from the side.
        distance: Of a light from the scene, in units of the camera's distance.
        tint: Largest relative deviation of a colour channel from white.
    """

    num_lights: tuple[int, int] = (1, 2)
    key_intensity: tuple[float, float] = (0.45, 1.3)
    fill_intensity: tuple[float, float] = (0.1, 0.4)
    ambient_intensity: tuple[float, float] = (0.08, 0.4)
    max_angle_deg: float = 75.0
    distance: tuple[float, float] = (1.0, 5.0)
    tint: float = 0.12


@dataclass(frozen=True)
class Distractors:
    """Random primitives around the targets.

    Attributes:
        number: Smallest and largest number per image.
        image_share: Smallest and largest diameter of a distractor's image over the image's width.
        depth: Smallest and largest depth in units of the first target's depth.
    """

    number: tuple[int, int] = (0, 2)
    image_share: tuple[float, float] = (0.12, 0.5)
    depth: tuple[float, float] = (0.6, 1.6)


@dataclass(frozen=True)
class Preset:
    """A distribution of scenes.

    Attributes:
        name: Its name.
        width: Image width, pixels.
        height: Image height, pixels.
        horizontal_fov_deg: Horizontal field of view, degrees, of a camera with square pixels that
            looks through the image's middle; ignored where ``intrinsics_px`` is given.
        intrinsics_px: fx, fy, cx, cy of an explicit camera, pixels of this image size.
        turning: Distribution of the targets' orientation.
        placement: Distribution of the targets' position.
        targets_per_image: Smallest and largest number of targets; each is a random part.
        min_visible_fraction: Smallest visible fraction of every target; scenes are drawn again,
            a bounded number of times, to keep it.
        centroid_inside: Whether the image of every target's cuboid centre must lie inside the
            frame.
        lighting: Distribution of light.
        distractors: Distribution of distractors.
    """

    name: str
    width: int
    height: int
    horizontal_fov_deg: float = 60.0
    intrinsics_px: tuple[float, float, float, float] | None = None
    turning: Turning = field(default_factory=FreeTurning)
    placement: Placement = field(default_factory=OffsetPlacement)
    targets_per_image: tuple[int, int] = (1, 1)
    min_visible_fraction: float = 0.5
    centroid_inside: bool = True
    lighting: Lighting = field(default_factory=Lighting)
    distractors: Distractors = field(default_factory=Distractors)

    def __post_init__(self) -> None:
        """Check what a user may have replaced."""
        for name, (low, high), least in (
            ("targets_per_image", self.targets_per_image, 1),
            ("distractors.number", self.distractors.number, 0),
            ("lighting.num_lights", self.lighting.num_lights, 0),
        ):
            if not least <= low <= high:
                raise UserError(
                    f"{name}=({low}, {high}) of preset {self.name}",
                    f"two counts with {least} <= smallest <= largest",
                    f"change {name}",
                )
        if not (self.width >= 8 and self.height >= 8 and 0 <= self.min_visible_fraction <= 0.95):
            raise UserError(
                f"width={self.width}, height={self.height}, min_visible_fraction="
                f"{self.min_visible_fraction} of preset {self.name}",
                "an image of at least 8×8 pixels and a fraction in [0, 0.95]",
                "change the preset's fields",
            )
        if not 5.0 <= self.horizontal_fov_deg <= 150.0:
            raise UserError(
                f"horizontal_fov_deg={self.horizontal_fov_deg} of preset {self.name}",
                "5 to 150 degrees",
                "change horizontal_fov_deg",
            )
        check_camera(self.K, (self.width, self.height), f"preset {self.name}")

    @property
    def K(self) -> Float[np.ndarray, "3 3"]:  # noqa: N802 (the field's name of the matrix)
        """Camera matrix, pixels."""
        if self.intrinsics_px is not None:
            return camera_matrix(*self.intrinsics_px)
        focal = self.width / 2 / math.tan(math.radians(self.horizontal_fov_deg) / 2)
        # Pixel centres are integers, so the image's middle is at (width − 1)/2.
        return camera_matrix(focal, focal, (self.width - 1) / 2, (self.height - 1) / 2)

    def resized(self, width: int, height: int) -> Preset:
        """Return the same scenes in another image size: the camera follows the resize rule.

        A changed aspect ratio stretches the image, so fx and fy differ, as they do when a picture
        is resized.
        """
        K = resize_camera(self.K, width / self.width, height / self.height)
        intrinsics_px = (float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2]))
        return replace(self, width=width, height=height, intrinsics_px=intrinsics_px)


PRESETS: dict[str, Preset] = {
    preset.name: preset
    for preset in (
        # Paper section 2.1: 640×480, camera 20 cm from the origin, ±10 cm along and ±15 cm across
        # the optical axis, free rotation, random light, random background. The field of view is
        # not in the paper: 90° is an inference, the one at which ±15 cm just spans the image's
        # height (30 cm of 40 cm × 30 cm) at 20 cm.
        Preset("paper", 640, 480, horizontal_fov_deg=90.0, distractors=Distractors((0, 0))),
        # A task that two cores learn in minutes: one face, a limited range of poses.
        Preset(
            "quickstart", 128, 128, turning=FacingTurning(), placement=FillPlacement(),
            min_visible_fraction=0.7,
        ),
        # Textured household objects as YCB-Video's first camera sees them (scenes 0000 to 0059).
        Preset(
            "ycb", 640, 480, intrinsics_px=(1066.778, 1067.487, 312.9869, 241.3109),
            placement=DistancePlacement(), distractors=Distractors((0, 3)),
        ),
    )
}  # fmt: skip
"""The scenes to choose from, by name."""
