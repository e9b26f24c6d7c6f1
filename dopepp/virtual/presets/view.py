"""A camera at work: from a lens, distances and parts to pictures as that camera takes them.

The network sees these pictures scaled down, so that parts have the sizes in pixels that networks
learn well, and learns on windows of them: a part covers a small share of a large picture.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

from dopepp.core.errors import UserError
from dopepp.drawing.pictures import Size
from dopepp.geometry.camera import CameraMatrix, check_camera, focal_length, resize_camera
from dopepp.geometry.camera_file import read_camera
from dopepp.parts.part import Part
from dopepp.virtual.presets import Preset
from dopepp.virtual.presets.placement import WorkingPlacement
from dopepp.virtual.sensor import Sensors

_log = logging.getLogger(__name__)

# Diameters of a part in the network's picture. Networks here fail below the first, and learn with
# parts of 45 to 110 pixels, 70 in the geometric mean; a range of sizes whose ends differ by more
# than the ratio takes much longer to learn.
FEWEST_PX: Final = 25.0
_FINE_PX: Final = 45.0
_USUAL_PX: Final = 70.0
_WIDE_RATIO: Final = 3.5

_ROOM: Final = 1.3  # the shorter side of a window over the diameter of the largest part in it
_MULTIPLE: Final = 32  # both sides of a window are multiples of it, pixels
_MOST_BLUR: Final = 10.0  # in large pictures, at most so many times the blur of small ones
_BEYOND: Final = 1.25  # the depth of a part on a table over that of the point looked at, at most


@dataclass(frozen=True, eq=False)
class View:
    """A camera and the distances at which it sees parts.

    Attributes:
        size: (width, height) of its pictures, pixels.
        K: Its camera matrix, pixels.
        distance: Nearest and farthest distance of a part's middle, along the optical axis, metres.
        source: Where the camera comes from, for messages.

    Raises:
        UserError: K cannot belong to pictures of the size, or the distances are no range.
    """

    size: Size
    K: CameraMatrix
    distance: tuple[float, ...]
    source: str = "camera"

    def __post_init__(self) -> None:
        check_camera(self.K, self.size, self.source)
        allowed = "[nearest, farthest] in metres, from 0.02 to 100"
        if len(self.distance) != 2 or not all(0.02 <= end <= 100 for end in self.distance):
            fix = "give the range in which the camera will see the part"
            raise UserError(f"working_distance={list(self.distance)}", allowed, fix)
        if self.distance[0] > self.distance[1]:
            fix = "write working_distance=[{1:g},{0:g}]".format(*self.distance)
            raise UserError(f"working_distance={list(self.distance)}", allowed, fix)

    def sizes_px(self, parts: Sequence[Part], scale: float = 1.0) -> tuple[float, float]:
        """Return the smallest and the largest diameter of parts in pictures scaled by a factor."""
        diameters = [part.diameter for part in parts]
        near, far = self.distance
        focal = scale * focal_length(self.K)
        return focal * min(diameters) / far, focal * max(diameters) / near

    def check(self, parts: Sequence[Part], scale: float = 1.0) -> None:
        """Refuse parts that are larger than the picture, or too small in it."""
        smallest, largest = self.sizes_px(parts)
        width, height = self.size
        if largest > min(width, height):
            nearest = math.ceil(1000 * self.distance[0] * largest / min(width, height)) / 1000
            raise UserError(
                f"working_distance from {self.distance[0]:g} m, where {_named(parts, max)} has "
                f"{largest:.0f} pixels in pictures of {width}×{height}",
                "parts that fit into the picture, however they are turned",
                f"start at {nearest:g} m",
            )
        if scale * smallest < FEWEST_PX:
            farthest = math.floor(1000 * self.distance[1] * scale * smallest / FEWEST_PX) / 1000
            raise UserError(
                f"working_distance to {self.distance[1]:g} m, where {_named(parts, min)} has "
                f"{scale * smallest:.0f} pixels in the camera's picture scaled by {scale:g}",
                f"at least {FEWEST_PX:g} pixels",
                f"end at {farthest:g} m, or take a longer lens or larger pictures",
            )

    def scale_for(self, parts: Sequence[Part], window: Size | None = None) -> float:
        """Choose by how much the network sees the camera's pictures scaled, at most 1.

        The farthest part has no fewer than 45 pixels where the camera gives so many; the nearest
        fits into a given window.
        """
        smallest, largest = self.sizes_px(parts)
        scale = max(_USUAL_PX / math.sqrt(smallest * largest), _FINE_PX / smallest)
        if window is not None:
            scale = min(scale, min(window) / _ROOM / largest)
        return float(f"{min(scale, 1.0):.3g}")

    def window_for(self, parts: Sequence[Part], scale: float) -> Size:
        """Choose the window's size: a square with room for the largest part."""
        lengths = _ROOM * self.sizes_px(parts, scale)[1], *(scale * side for side in self.size)
        side, width, height = (_MULTIPLE * math.ceil(length / _MULTIPLE) for length in lengths)
        return min(side, width), min(side, height)

    def window(self, preset: Preset, scale: float, size: Size) -> Preset:
        """Return a preset's scenes, whose sensors stay, in windows of what the network sees."""
        return self._seen(preset, scale, preset.sensors, size)

    def whole(self, preset: Preset, scale: float) -> Preset:
        """Return a preset's scenes in this camera's whole pictures; scaled, as blurred as there."""
        return self._seen(preset, 1.0, preset.sensors.resized(min(1 / scale, _MOST_BLUR)), None)

    def _seen(self, preset: Preset, scale: float, sensors: Sensors, window: Size | None) -> Preset:
        K = resize_camera(self.K, scale, scale)
        near, far = self.distance
        table = preset.table and replace(preset.table, distance=(near, far))
        return replace(
            preset, sensors=sensors, window=window, table=table,
            width=round(scale * self.size[0]), height=round(scale * self.size[1]),
            intrinsics_px=(float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2])),
            placement=WorkingPlacement(near, far),
            depths=None if table is None else (near / _BEYOND, far * _BEYOND),
        )  # fmt: skip

    def in_words(
        self, parts: Sequence[Part], scale: float = 1.0, window: Size | None = None
    ) -> list[str]:
        """Describe how large the network sees parts, and what is unfavourable about that."""
        near, far = (1000 * end / (scale * focal_length(self.K)) for end in self.distance)
        smallest, largest = self.sizes_px(parts, scale)
        across, down = (
            math.degrees(2 * math.atan(side / 2 / focal))
            for side, focal in zip(self.size, (self.K[0, 0], self.K[1, 1]), strict=True)
        )
        names = ", ".join(part.name for part in parts)
        lines = [
            f"{self.source}: {self.size[0]}×{self.size[1]} pixels, {across:.0f}° × {down:.0f}°, "
            f"parts at {self.distance[0]:g} – {self.distance[1]:g} m",
            f"{names}: {smallest:.0f} – {largest:.0f} pixels across; a pixel is {near:.2g} mm on "
            f"the part at the nearest and {far:.2g} mm at the farthest",
        ]
        if window is not None:
            lines.insert(
                1,
                f"the network sees its pictures scaled by {scale:g} and learns on windows of "
                f"{window[0]}×{window[1]} pixels",
            )
        if smallest < _FINE_PX:
            lines.append(
                f"that is coarse: with fewer than {_FINE_PX:g} pixels across, less is found; stay "
                f"within {self.distance[1] * smallest / _FINE_PX:.2g} m, or take a longer lens or "
                "larger pictures"
            )
        if largest > _WIDE_RATIO * smallest:
            lines.append(
                f"that is a wide range of sizes (1 : {largest / smallest:.1f}): it takes longer to "
                "learn than a narrower working_distance"
            )
        return lines


def read_lens(path: str | Path) -> tuple[Size, CameraMatrix]:
    """Read a camera's file and return the size of its pictures and K, pixels.

    Raises:
        UserError: The file cannot be read, or does not state the size.
    """
    camera = read_camera(path)
    if camera.size is None:
        raise UserError(
            f"{camera.source}, which does not state the size of its pictures",
            "a camera file with width and height",
            "add them, e.g. image_width and image_height as ROS writes them",
        )
    if camera.distortion:
        _log.info("%s: its distortion is not rendered; undistort where you predict", camera.source)
    return camera.size, camera.K


def _named(parts: Sequence[Part], choose: Callable[..., Part]) -> str:
    """Name the part that is chosen by its diameter."""
    part = choose(parts, key=lambda part: part.diameter)
    return f"{part.name} ({1000 * part.diameter:.0f} mm across)"
