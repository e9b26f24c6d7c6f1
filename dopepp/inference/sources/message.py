"""ROS messages of cameras, live or recorded, of ROS 1 or 2: pictures as RGB, and their lenses.

They are read by their fields' names, so whichever library has made them does not matter.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import cv2
import numpy as np

from dopepp.core.errors import UserError
from dopepp.drawing.pictures import MAX_PIXELS, Picture, whole_picture
from dopepp.geometry.camera import crop_camera, resize_camera
from dopepp.geometry.camera_file import Camera, Crop, camera_of_fields

RAW: Final = "sensor_msgs/msg/Image"
COMPRESSED: Final = "sensor_msgs/msg/CompressedImage"
CAMERA: Final = "sensor_msgs/msg/CameraInfo"

ENCODINGS: Final[dict[str, tuple[int, int | None]]] = {
    "rgb8": (3, None),
    "bgr8": (3, cv2.COLOR_BGR2RGB),
    "8UC3": (3, cv2.COLOR_BGR2RGB),
    "rgba8": (4, cv2.COLOR_RGBA2RGB),
    "bgra8": (4, cv2.COLOR_BGRA2RGB),
    "mono8": (1, cv2.COLOR_GRAY2RGB),
    "8UC1": (1, cv2.COLOR_GRAY2RGB),
    "bayer_rggb8": (1, cv2.COLOR_BayerRGGB2RGB),
    "bayer_bggr8": (1, cv2.COLOR_BayerBGGR2RGB),
    "bayer_gbrg8": (1, cv2.COLOR_BayerGBRG2RGB),
    "bayer_grbg8": (1, cv2.COLOR_BayerGRBG2RGB),
    "yuv422": (2, cv2.COLOR_YUV2RGB_UYVY),
    "yuv422_yuy2": (2, cv2.COLOR_YUV2RGB_YUY2),
}
"""Bytes a pixel, and how OpenCV makes RGB of them."""


def picture_of(message: Any) -> Picture:
    """Return a message's picture as RGB; a ValueError: it is not what it says, or too large."""
    if hasattr(message, "format"):
        picture = whole_picture(bytes(message.data), ("JPEG", "PNG"))
        return np.ascontiguousarray(np.asarray(picture.convert("RGB")))
    if message.encoding not in ENCODINGS:
        known = ", ".join(ENCODINGS)
        raise ValueError(f"encoding {message.encoding!r:.40}, none of {known}")
    size, code = ENCODINGS[message.encoding]
    height, width, step = message.height, message.width, message.step
    if not 0 < height * width <= MAX_PIXELS or step < size * width:
        raise ValueError(f"{width}×{height} pixels in rows of {step} bytes")
    data = np.frombuffer(message.data, np.uint8)
    rows = data[: height * step].reshape(height, step)[:, : size * width]
    pixels = np.ascontiguousarray(rows.reshape(height, width, size))
    return pixels if code is None else np.asarray(cv2.cvtColor(pixels, code))


def is_rectified(topic: str) -> bool:
    """Tell whether a topic's pictures are without distortion, so that their lens is P's."""
    return topic.removesuffix("/compressed").rpartition("/")[2].startswith("image_rect")


def info_topic(topic: str) -> str:
    """Return where the ``camera_info`` of a topic's pictures is: beside them."""
    return f"{topic.removesuffix('/compressed').rpartition('/')[0]}/camera_info"


@dataclass(frozen=True)
class CameraInfo:
    """What a ``camera_info`` says."""

    # (width, height) of the whole sensor's picture, which K and P belong to, pixels
    size: tuple[int, int]
    model: str  # of the distortion, and
    D: Sequence[float]  # its coefficients
    K: Sequence[float]  # nine numbers, row by row; P: twelve, of pictures without distortion
    P: Sequence[float]
    binning: tuple[int, int] = (1, 1)  # sensor pixels in a picture's pixel, across and down
    roi: Crop | None = None  # what of the sensor is read out; None is all of it
    frame_id: str = ""  # the camera's frame

    def camera(self, source: str, rectified: bool) -> Camera:
        """Return the camera of its pictures.

        ``source`` is where this comes from, for messages; of pictures that are ``rectified`` the
        lens is P's. A :class:`UserError`: it is of no calibrated pinhole camera.
        """
        if not any(self.K):
            raise UserError(
                f"{source} with a K of zeros", "the camera_info of a calibrated camera",
                "calibrate it (`dopepp calibrate camera`) and give the driver the file, or pass it "
                "here: --camera camera.yaml",
            )  # fmt: skip
        fields: dict[str, object] = {"image_width": self.size[0], "image_height": self.size[1]}
        if rectified:
            fields["K"] = np.reshape(self.P, (3, 4))[:, :3].ravel().tolist()
        else:
            fields |= {"K": [*self.K], "D": [*self.D], "distortion_model": self.model}
        whole = camera_of_fields(fields, source)
        if self.roi is None and self.binning == (1, 1):
            return whole
        x, y, width, height = self.roi or (0, 0, *self.size)
        K = crop_camera(whole.K, x, y)
        across, down = self.binning
        K = resize_camera(K, 1 / across, 1 / down)
        return Camera((width // across, height // down), K, whole.distortion, source)


def info_of(message: Any) -> CameraInfo:
    """Return what a ``camera_info`` message says; ROS 1 has capitals where ROS 2 has none."""
    names = dir(message)
    lists = {
        name: [float(one) for one in getattr(message, name if name in names else name.lower())]
        for name in ("D", "K", "P")
    }
    roi = message.roi
    crop = (int(roi.x_offset), int(roi.y_offset), int(roi.width), int(roi.height))
    return CameraInfo(
        (int(message.width), int(message.height)),
        message.distortion_model,
        **lists,
        binning=(max(1, int(message.binning_x)), max(1, int(message.binning_y))),
        roi=crop if crop[2] and crop[3] else None,
        frame_id=message.header.frame_id,
    )
