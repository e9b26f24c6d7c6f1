"""Case: an image to diagnose, its detections, and measures of image quality."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Final

import cv2
import numpy as np
from jaxtyping import Float, Float32

from dopepp.drawing.pictures import RGBImage
from dopepp.geometry.camera import CameraMatrix, Letterbox, focal_length
from dopepp.geometry.cuboid import CENTROID, NUM_KEYPOINTS
from dopepp.inference.estimator import PoseEstimator
from dopepp.inference.network_estimator import NetworkEstimator
from dopepp.parts.part import Part
from dopepp.parts.size import LearnedRange
from dopepp.recovery.detection import Detection

NEARER, FARTHER = 2.0, 4.0  # factors on the expected distances for a further search
MIN_EVIDENCE: Final = (0.4, 6)
"""Smallest mean belief and number of keypoints of a detection outside the expected distances."""

MIN_PX: Final = 24  # smallest side of an image whose sharpness can be measured
NARROWEST: Final = 0.5  # pixels: narrower edges cannot be distinguished
FEWEST: Final = 8  # smallest number of edge pixels for a measurement of sharpness
MIN_GRADIENT: Final = 0.3
"""Share of the strongest gradient above which an edge is measured: weaker edges are shading, noise
or out-of-focus background."""

WHITE: Final = 250  # a pixel is clipped if all its channels reach this level


@dataclass(frozen=True, eq=False)
class Case:
    """An image to diagnose, with its camera and estimator, and the detections that checks use."""

    estimator: PoseEstimator  # estimator to diagnose
    image: RGBImage  # RGB, without distortion
    K: CameraMatrix
    parts: Sequence[Part]  # the estimator's parts, with meshes where available
    # Nearest and farthest depth, metres; None: the training range
    distances: tuple[float, float] | None = None
    cropped: bool = False  # as in :meth:`PoseEstimator.predict`
    # Pixel of each shown part's centre; None if it is unknown which parts are shown
    centres: Sequence[tuple[float, float]] | None = None

    @cached_property
    def reported(self) -> list[Detection]:
        """Detections in the range ``distances``, best score first."""
        return self._detections(self.distances)

    @property
    def expected(self) -> Detection | None:
        """Best detection in the range ``distances``, or None."""
        return self.reported[0] if self.reported else None

    @cached_property
    def unexpected(self) -> list[Detection]:
        """Detections centred more than half a part length (pixels) from each of ``centres``."""
        return [
            detection
            for detection in self.reported
            if not any(
                math.dist(detection.keypoints[CENTROID], centre) <= self._length_px(detection) / 2
                for centre in self.centres or ()
            )
        ]

    @cached_property
    def outside_range(self) -> Detection | None:
        """Best detection outside the range ``distances``; None if a detection is inside."""
        ranges = [self.estimator.depth_range(part.name) for part in self.estimator.parts]
        depths = [limits for limits in ranges if limits is not None]
        if self.expected is not None or not depths:
            return None
        usual = min(near for near, _ in depths), max(far for _, far in depths)
        near, far = zip(usual, self.distances or usual, strict=True)
        detections = self._detections((min(near) / NEARER, max(far) * FARTHER))
        detection = detections[0] if detections else None
        if not isinstance(self.estimator, NetworkEstimator):
            return detection
        belief, keypoints = MIN_EVIDENCE
        if detection is None or not np.isfinite(detection.keypoints).all():
            return None
        is_believed = detection.belief >= belief and num_keypoints(detection) >= keypoints
        return detection if is_believed else None

    @property
    def detection(self) -> Detection | None:
        """Best detection in the range ``distances``, or else outside it."""
        return self.expected or self.outside_range

    @cached_property
    def part(self) -> Part:
        """Part of the best detection, or else the estimator's first part."""
        parts = {part.name: part for part in self.estimator.parts}
        return parts[self.detection.object] if self.detection else self.estimator.parts[0]

    @property
    def seen(self) -> LearnedRange | None:
        """Diameters (pixels) and depths (metres) of the part in training; None if unknown."""
        if not isinstance(self.estimator, NetworkEstimator):
            return None
        return self.estimator.checkpoint.seen.get(self.part.name)

    @property
    def length_px(self) -> float:
        """Diameter of the detected part on the image, pixels."""
        assert self.detection is not None
        return self._length_px(self.detection)

    @cached_property
    def box(self) -> Letterbox:
        """Resizing that shows the part closest to its trained size; for templates, at full size."""
        if not isinstance(self.estimator, NetworkEstimator):
            return Letterbox.scaled(self.image.shape[1::-1], 1.0)
        boxes = [view.box for view in self.estimator.views(self.image, self.K, self.distances)]
        if self.detection is None or self.seen is None:
            return max(boxes, key=lambda box: box.scale_x)
        typical_px = math.sqrt(self.seen.smallest_px * self.seen.largest_px)
        return min(boxes, key=lambda box: abs(math.log(self.length_px * box.scale_x / typical_px)))

    @cached_property
    def refined(self) -> Detection | None:
        """Best detection including its outline agreement; None without a mesh or detection."""
        if self.detection is None or any(part.mesh is None for part in self.parts):
            return None
        if self.estimator.refiner is not None:
            return self.detection
        estimator = self.estimator.refining("region", self.parts)
        return estimator.refined([self.detection], self.image, self.K)[0]

    def around(self) -> RGBImage:
        """Return a crop around the detected part in the size of :attr:`box`, or the whole image."""
        image = self.box.image(self.image)
        if self.detection is None:
            return image
        keypoints = self.detection.keypoints
        points = self.box.points(keypoints[np.isfinite(keypoints[:, 0])])
        size = (image.shape[1], image.shape[0])
        low = np.clip(np.floor(points.min(axis=0)), 0, size).astype(int)
        high = np.clip(np.ceil(points.max(axis=0)) + 1, 0, size).astype(int)
        crop = image[low[1] : high[1], low[0] : high[0]]
        return crop if min(crop.shape[:2]) >= MIN_PX else image

    def strongest_beliefs(self) -> Float[np.ndarray, "9"]:
        """Return the strongest belief of each keypoint of the part in all image sizes."""
        assert isinstance(self.estimator, NetworkEstimator)  # templates have no maps
        number = [part.name for part in self.estimator.parts].index(self.part.name)
        channels = slice(number * NUM_KEYPOINTS, (number + 1) * NUM_KEYPOINTS)
        strongest = np.zeros(NUM_KEYPOINTS)
        for view in self.estimator.views(self.image, self.K, self.distances):
            belief, _ = self.estimator.maps(view.pixels)
            strongest = np.maximum(strongest, belief[channels].flatten(1).amax(1).cpu().numpy())
        return strongest

    def _detections(self, distances: tuple[float, float] | None) -> list[Detection]:
        """Return the detections in a range of distances, metres (default: the training range)."""
        return self.estimator.predict(self.image, self.K, distances=distances, cropped=self.cropped)

    def _length_px(self, detection: Detection) -> float:
        """Return the diameter of a detected part on the image, pixels."""
        (part,) = (part for part in self.estimator.parts if part.name == detection.object)
        return part.diameter * focal_length(self.K) / float(detection.T_cam_obj[2, 3])


def num_keypoints(detection: Detection) -> int:
    """Return the number of a detection's keypoints that have a measured peak."""
    return int(np.isfinite(detection.peaks[:, 0]).sum())


def edge_width(image: RGBImage) -> float | None:
    """Return the standard deviation of the blur at the strongest edges, pixels; None without edges.

    A step blurred by σ, and then by s, has a gradient proportional to 1/√(σ² + s²). The ratio of
    gradients for s and 2s determines σ (Zhuo and Sim 2011); s is a pixel. Close edges and strong
    noise reduce the result by up to a third. Motion along an edge is not measured.
    """
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(np.float32)
    fine, coarse = _gradient(grey, 1.0), _gradient(grey, 2.0)
    least = max(MIN_GRADIENT * float(np.percentile(fine, 99.5)), 2 * _noise(grey), 1.0)
    edges = (fine >= cv2.dilate(fine, np.ones((3, 3)))) & (fine > least)
    if np.count_nonzero(edges) < FEWEST:
        return None
    # 1 for infinite blur, 4 for none.
    ratio = float(np.clip((fine[edges].sum() / coarse[edges].sum()) ** 2, 1.001, 4.0))
    return max(NARROWEST, math.sqrt((4 - ratio) / (ratio - 1)))


def highlights(image: RGBImage) -> float:
    """Return the 99th percentile of the image's grey levels (0 to 255)."""
    return float(np.percentile(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), 99))


def clipped_share(image: RGBImage) -> float:
    """Return the share of pixels whose channels are all at least ``WHITE``."""
    return float((image.min(axis=2) >= WHITE).mean())


def _gradient(
    grey: Float32[np.ndarray, "height width"], sigma_px: float
) -> Float32[np.ndarray, "height width"]:
    """Return the gradient's magnitude in the blurred image, grey levels per pixel."""
    soft = cv2.GaussianBlur(grey, (0, 0), sigma_px)
    # Scharr's filter weighs 16 on each side, two pixels apart.
    x, y = (cv2.Scharr(soft, cv2.CV_32F, *axis, scale=1 / 32) for axis in ((1, 0), (0, 1)))
    return np.asarray(np.hypot(x, y))


def _noise(grey: Float32[np.ndarray, "height width"]) -> float:
    """Return the noise's standard deviation, grey levels (Immerkær 1996, with the median)."""
    kernel = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]], np.float32)
    return float(np.median(np.abs(cv2.filter2D(grey, -1, kernel)))) / 0.6745 / 6
