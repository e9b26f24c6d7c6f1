"""Interface of frame sources, and the camera of their images."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from dopepp.core.errors import UserError
from dopepp.drawing.pictures import RGBImage
from dopepp.geometry.camera import CameraMatrix
from dopepp.geometry.camera_file import Camera, Crop, read_camera
from dopepp.geometry.camera_formats import Size
from dopepp.inference.input_image import Depth32, read_depth_image, undistort_depth


@dataclass(frozen=True, eq=False)
class CameraFrame:
    """One image of a frame source, with its name, number and time."""

    image: RGBImage  # RGB, with the lens distortion of the camera
    name: str  # image file, or name of a source of many frames
    number: int  # index in the source, or the file's number if all file names are numbers (BOP)
    time: float | None = None  # seconds since a video's start or since 1970; None for an image


class FrameSource(ABC):
    """Sequence of camera frames."""

    name: str  # for messages and output files, without passwords and tokens
    stem: str  # file name without suffix for outputs about this source
    count: int | None = None  # number of frames; None if unknown
    rate: float | None = None  # frames per second; None for separate images
    paths: Sequence[Path] = ()  # files with the images
    is_rectified: bool = False  # whether the images have no lens distortion
    is_live: bool = False  # whether frames are lost while nobody reads them

    @property
    def camera(self) -> Camera | None:
        """Camera that the source itself describes, if any."""
        return None

    @abstractmethod
    def frames(self, stride: int = 1) -> Iterator[CameraFrame]:
        """Yield every ``stride``-th frame, in order."""


@dataclass(frozen=True, eq=False)
class Lens:
    """Camera of a source whose images may have been resized or cropped after calibration."""

    camera: Camera
    K_size: Size | None = None  # (width, height) that K belongs to, if images were resized
    crop: Crop | None = None  # region of the calibrated image, if images were cropped

    @property
    def is_cropped(self) -> bool:
        """Whether the images may be crops; see :meth:`PoseEstimator.predict`."""
        return self.crop is not None or self.camera.cropped

    def undistort(self, image: RGBImage) -> tuple[RGBImage, CameraMatrix]:
        """Return the image without lens distortion, and its K.

        Raises:
            UserError: K belongs to an image of another size.
        """
        size = (image.shape[1], image.shape[0])
        camera = self.camera.for_picture(size, self.K_size, self.crop)
        return camera.undistorted(image), camera.K

    def read_depth(self, path: Path, scale: float, K: CameraMatrix) -> Depth32:
        """Read a depth image of ``scale`` metres per unit in metres; remove the lens distortion."""
        metres, coefficients = read_depth_image(path, scale), self.camera.coefficients
        return metres if coefficients is None else undistort_depth(metres, K, coefficients)


def given_camera(K: CameraMatrix | None, camera: Camera | Path | str | None) -> Camera | None:
    """Return the camera that the user specified by K or by a camera (file), if any.

    Raises:
        UserError: Both K and a camera are specified, or the camera file cannot be read.
    """
    if K is not None and camera is not None:
        raise UserError("both --K and --camera", "only one of them", "leave out --K or --camera")
    if K is not None:
        return Camera(None, K, (), "--K")
    return read_camera(camera) if isinstance(camera, Path | str) else camera


def check_distortion(given: Camera | None, is_rectified: bool, name: str) -> None:
    """Raise a UserError if the camera given for rectified images has distortion coefficients."""
    if is_rectified and given is not None and given.distortion:
        problem = f"{given.source} with distortion coefficients for the rectified images {name}"
        fix = "leave out --camera if there is a camera_info, or pass --K or the raw images"
        raise UserError(problem, "a camera without distortion", fix)


def choose_camera(
    K: CameraMatrix | None, camera: Camera | Path | str | None, source: FrameSource
) -> Camera:
    """Return the camera that the user specified, or else the camera that the source describes.

    Raises:
        UserError: As for :func:`given_camera` and :func:`check_distortion`, or neither user nor
            source specifies a camera.
    """
    given = given_camera(K, camera)
    check_distortion(given, source.is_rectified, source.name)
    chosen = given or source.camera
    if chosen is None:
        fix = "pass --K fx fy cx cy (pixels of this image) or --camera FILE; in Python, K or camera"
        raise UserError(f"neither --K nor --camera for {source.name}", "--K or --camera", fix)
    return chosen
