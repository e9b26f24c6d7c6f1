"""What every source of pictures hands out, and the camera behind it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

from dopepp.core.errors import UserError
from dopepp.drawing.pictures import Picture
from dopepp.geometry.camera import CameraMatrix
from dopepp.geometry.camera_file import Camera, Crop, read_camera
from dopepp.geometry.camera_formats import Size

if TYPE_CHECKING:
    from dopepp.inference.picture import Depth32


@dataclass(frozen=True, eq=False)
class Frame:
    """One picture of a source."""

    image: Picture  # RGB, as the camera took it
    name: str  # the picture's file, or the source where that has many
    # Its place in the source, counted from 0; where all pictures' files are named by numbers
    # alone, as BOP's are, that number
    number: int
    # Seconds: of a video since its start, of a camera or a bag since 1970; None of a picture
    time: float | None = None


class Source(Protocol):
    """Where pictures come from.

    Attributes:
        name: For messages, and for what is written about it; without passwords.
        stem: What a file about it is called, without suffix.
        count: How many frames it has; None where nobody knows.
        rate: Frames a second, of a sequence in time; None of single pictures.
    """

    @property
    def name(self) -> str: ...  # noqa: D102

    @property
    def stem(self) -> str: ...  # noqa: D102

    @property
    def count(self) -> int | None: ...  # noqa: D102

    @property
    def rate(self) -> float | None: ...  # noqa: D102

    @property
    def camera(self) -> Camera | None:
        """The camera that the source itself knows."""

    def frames(self, stride: int = 1) -> Iterator[Frame]:
        """Yield every so manieth frame, in order."""


@dataclass(frozen=True, eq=False)
class Lens:
    """A camera, and what was made of its pictures."""

    camera: Camera  # the one that took them
    K_size: Size | None = None  # (width, height) that K belongs to, where the pictures were resized
    # What of the calibrated picture they are, where they were cut out of it
    crop: Crop | None = None

    def seen(self, picture: Picture) -> tuple[Picture, CameraMatrix]:
        """Return a picture without distortion and its K; a UserError where K is of another."""
        size = (picture.shape[1], picture.shape[0])
        camera = self.camera.for_picture(size, self.K_size, self.crop)
        return camera.undistorted(picture), camera.K

    def depth(self, path: Path, scale: float, K: CameraMatrix) -> Depth32:
        """Read a depth image, metres, and return it without distortion."""
        from dopepp.inference.picture import read_depth, undistorted_depth

        metres, lens = read_depth(path, scale), self.camera.coefficients
        return metres if lens is None else undistorted_depth(metres, K, lens)


def given_camera(K: CameraMatrix | None, camera: Camera | Path | str | None) -> Camera | None:
    """Return the camera that one of two arguments gives; None where neither does.

    A :class:`UserError`: both are given; or as from :func:`read_camera`.
    """
    if K is not None and camera is not None:
        raise UserError("--K and --camera", "one of the two", "leave one of them out")
    if K is not None:
        return Camera(None, K, (), "--K")
    if isinstance(camera, Path | str):
        return read_camera(camera)
    return camera


def one_camera(
    K: CameraMatrix | None, camera: Camera | Path | str | None, source: Source
) -> Camera:
    """Return the camera that one of two arguments gives, or else the source's own.

    A :class:`UserError`: as from :func:`given_camera`, or there is none at all.
    """
    known = given_camera(K, camera) or source.camera
    if known is None:
        raise UserError(
            f"neither --K nor --camera for {source.name}", "one of the two",
            "pass --K fx fy cx cy (pixels of this picture) or --camera FILE",
        )  # fmt: skip
    return known
