"""Scale and windows of training images for a camera, its working distances and parts.

The network's input is scaled down until parts have sizes in pixels that networks learn well.
Training uses windows, because a part covers a small share of a large image.
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
from dopepp.virtual.presets import Preset, intrinsics_of
from dopepp.virtual.presets.placement import WorkingPlacement
from dopepp.virtual.thinness import thin_width

_log = logging.getLogger(__name__)

# Diameters of a part in the network's image. Networks fail below ``MIN_PX`` and learn well
# from 45 to 110 pixels (geometric mean 70). Ranges wider than ``_WIDE_RATIO`` take much longer to
# learn.
MIN_PX: Final = 25.0
_FINE_PX: Final = 45.0
_USUAL_PX: Final = 70.0
_WIDE_RATIO: Final = 3.5
_THIN_PX: Final = 5.0  # width of thin features, e.g. of rods, at the largest distance

_ROOM: Final = 1.3  # ratio of a window's shorter side to the diameter of the largest part
_MULTIPLE: Final = 32  # both sides of a window are multiples of this number, pixels
_MAX_BLUR: Final = 10.0  # largest factor on the blur in large images
_BEYOND: Final = 1.25  # ratio of a part's largest depth to the depth of the table's origin


@dataclass(frozen=True, eq=False)
class View:
    """A camera and its working distances.

    Attributes:
        size: (width, height) of the camera's images, pixels.
        K: Camera matrix, pixels.
        distance: Nearest and farthest distance of a part's middle, along the optical axis, metres.
        source: Name of the camera or its file, for messages.

    Raises:
        UserError: K does not fit the image size, or the distances are not an ascending pair.
    """

    size: Size
    K: CameraMatrix
    distance: tuple[float, ...]
    source: str = "camera"

    def __post_init__(self) -> None:
        check_camera(self.K, self.size, self.source)
        allowed = "[nearest, farthest] in metres, from 0.02 to 100"
        if len(self.distance) != 2 or not all(0.02 <= end <= 100 for end in self.distance):
            fix = "set the range of distances between camera and part, e.g. [0.3,0.8]"
            raise UserError(f"working_distance={list(self.distance)}", allowed, fix)
        if self.distance[0] > self.distance[1]:
            fix = "write working_distance=[{1:g},{0:g}]".format(*self.distance)
            raise UserError(f"working_distance={list(self.distance)}", allowed, fix)

    @property
    def resolution(self) -> float:
        """Length of a pixel at the geometric mean of the working distances, metres."""
        return math.sqrt(math.prod(self.distance)) / focal_length(self.K)

    def sizes_px(self, parts: Sequence[Part], scale: float = 1.0) -> tuple[float, float]:
        """Return the smallest and largest diameter at any distance, in pixels times ``scale``."""
        diameters = [part.diameter for part in parts]
        near, far = self.distance
        focal = scale * focal_length(self.K)
        return focal * min(diameters) / far, focal * max(diameters) / near

    def check(self, parts: Sequence[Part], scale: float = 1.0) -> None:
        """Check the size of parts in the camera's images and in images scaled by ``scale``.

        Raises:
            UserError: A part exceeds the camera's image, or is scaled to below :data:`MIN_PX`.
        """
        smallest, largest = self.sizes_px(parts)
        width, height = self.size
        if largest > min(width, height):
            nearest = math.ceil(1000 * self.distance[0] * largest / min(width, height)) / 1000
            raise UserError(
                f"working_distance from {self.distance[0]:g} m, where {_named(parts, max)} has "
                f"{largest:.0f} pixels in images of {width}×{height}",
                "parts that fit into the image in any orientation",
                f"start working_distance at {nearest:g}",
            )
        if scale * smallest < MIN_PX:
            farthest = math.floor(1000 * self.distance[1] * scale * smallest / MIN_PX) / 1000
            raise UserError(
                f"working_distance to {self.distance[1]:g} m, where {_named(parts, min)} has "
                f"{scale * smallest:.0f} pixels in the camera's image scaled by {scale:g}",
                f"at least {MIN_PX:g} pixels",
                f"end working_distance at {farthest:g}, or use a longer lens or larger images",
            )

    def scale_for(self, parts: Sequence[Part], window: Size | None = None) -> float:
        """Return the scale (at most 1) of the network's input relative to the camera's images.

        The farthest part spans at least 45 pixels and its thin features 5 pixels, if the camera
        resolves that many; the nearest part fits into ``window``.
        """
        smallest, largest = self.sizes_px(parts)
        scale = max(_USUAL_PX / math.sqrt(smallest * largest), _FINE_PX / smallest)
        widths = (thin_width(part) * part.diameter for part in parts if part.mesh is not None)
        thinnest = min(widths, default=math.inf)
        scale = max(scale, _THIN_PX * self.distance[1] / (focal_length(self.K) * thinnest))
        if window is not None:
            scale = min(scale, min(window) / _ROOM / largest)
        return float(f"{min(scale, 1.0):.3g}")

    def window_for(self, parts: Sequence[Part], scale: float) -> Size:
        """Return the size of a square window that holds the largest part, clipped to the image."""
        lengths = _ROOM * self.sizes_px(parts, scale)[1], *(scale * side for side in self.size)
        side, width, height = (_MULTIPLE * math.ceil(length / _MULTIPLE) for length in lengths)
        return min(side, width), min(side, height)

    def window(self, preset: Preset, scale: float, size: Size | None) -> Preset:
        """Return a preset for this camera's scaled images in windows of ``size`` (None: whole)."""
        near, far = self.distance
        table = preset.table and replace(preset.table, distance=(near, far))
        return replace(
            preset,
            window=size,
            table=table,
            width=round(scale * self.size[0]),
            height=round(scale * self.size[1]),
            intrinsics_px=intrinsics_of(resize_camera(self.K, scale, scale)),
            placement=WorkingPlacement(near, far),
            depths=None if table is None or table.pile else (near / _BEYOND, far * _BEYOND),
        )

    def whole(self, preset: Preset, scale: float) -> Preset:
        """Return a preset for whole, unscaled images, with blurs divided by ``scale``."""
        sensors = preset.sensors.resized(min(1 / scale, _MAX_BLUR))
        return replace(self.window(preset, 1.0, None), sensors=sensors)

    def in_words(
        self, parts: Sequence[Part], scale: float = 1.0, window: Size | None = None
    ) -> list[str]:
        """Return lines of text: camera, sizes of parts in the network's input, and warnings."""
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
                f"the network's input is scaled by {scale:g}, and training uses windows of "
                f"{window[0]}×{window[1]} pixels",
            )
        if smallest < _FINE_PX:
            lines.append(
                f"parts are small: networks miss more parts below {_FINE_PX:g} pixels across; stay "
                f"within {self.distance[1] * smallest / _FINE_PX:.2g} m, or use a longer lens or "
                "larger images"
            )
        if largest > _WIDE_RATIO * smallest:
            lines.append(
                f"the range of sizes is wide (1 : {largest / smallest:.1f}): training takes longer "
                "than for a narrower working_distance"
            )
        return lines


def read_lens(path: str | Path) -> tuple[Size, CameraMatrix]:
    """Read a camera file and return the size of its images and K, pixels.

    Raises:
        UserError: The file cannot be read, or does not state the size.
    """
    camera = read_camera(path)
    if camera.size is None:
        raise UserError(
            f"{camera.source}, which does not state the size of its images",
            "a camera file with width and height",
            "add the size in pixels to the file, e.g. image_width: 640 and image_height: 480",
        )
    if camera.distortion:
        _log.info("%s: its distortion is not rendered; undistort for prediction", camera.source)
    return camera.size, camera.K


def _named(parts: Sequence[Part], choose: Callable[..., Part]) -> str:
    """Return the name and diameter of the part that ``choose`` (min or max) selects by diameter."""
    part = choose(parts, key=lambda part: part.diameter)
    return f"{part.name} ({1000 * part.diameter:.0f} mm across)"
