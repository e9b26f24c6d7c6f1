"""Case: a picture, its camera and who looks at it, with what comes of that, and its quality."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cached_property
from typing import Final

import cv2
import numpy as np
from jaxtyping import Float, Float32

from dopepp.drawing.pictures import Picture
from dopepp.geometry.camera import CameraMatrix, Letterbox, focal_length
from dopepp.geometry.cuboid import NUM_KEYPOINTS
from dopepp.inference.estimator import PoseEstimator
from dopepp.inference.picture import letterboxes
from dopepp.parts.part import Part
from dopepp.parts.size import Seen, widest
from dopepp.recovery.detection import Detection

NEARER, FARTHER = 2.0, 4.0  # factors on the distances where nothing is found at these

BELIEVED: Final = (0.4, 6)
"""Mean belief and number of keypoints of a part that is found elsewhere; ghosts have less."""

LEAST_PX: Final = 24  # side of a picture that tells how sharp it is

NARROWEST: Final = 0.5  # pixels: narrower edges are not told apart
FEWEST: Final = 8  # edges without which a picture does not tell how sharp it is

STRONG: Final = 0.3
"""Share of the strongest gradient: weaker edges are shading, noise, and out of focus."""

WHITE: Final = 250  # grey level from which on a pixel is taken for clipped, if all its channels are


class Case:
    """A picture, its camera and who looks at it, with what comes of that.

    Args:
        estimator: Who looks.
        image: RGB, without distortion.
        K: Its camera matrix, pixels.
        parts: The estimator's, with meshes where there are any.
        distances: Nearest and farthest, metres; None for those of training.
        cropped: As :meth:`PoseEstimator.predict` takes it.
    """

    def __init__(
        self,
        estimator: PoseEstimator,
        image: Picture,
        K: CameraMatrix,
        parts: Sequence[Part],
        distances: tuple[float, float] | None = None,
        cropped: bool = False,
    ) -> None:
        self.estimator, self.image, self.K = estimator, image, K
        self.parts, self.distances, self.cropped = parts, distances, cropped

    @cached_property
    def expected(self) -> Detection | None:
        """The best part that is found where it is looked for."""
        return self._best(self.distances)

    @cached_property
    def elsewhere(self) -> Detection | None:
        """The best one that is found nearer or farther, where there is none."""
        known = self.estimator.checkpoint.seen.values()
        if self.expected is not None or not known:
            return None
        usual = widest([*known])[2:]
        near, far = zip(usual, self.distances or usual, strict=True)
        one = self._best((min(near) / NEARER, max(far) * FARTHER))
        belief, keypoints = BELIEVED
        if one is None or one.belief < belief or num_keypoints(one) < keypoints:
            return None
        return one if np.isfinite(one.keypoints).all() else None

    @property
    def found(self) -> Detection | None:
        """The best part that is found at all."""
        return self.expected or self.elsewhere

    @cached_property
    def part(self) -> Part:
        """The part in question: the one that is found, else the checkpoint's first."""
        known = {part.name: part for part in self.estimator.parts}
        return known[self.found.object] if self.found else self.estimator.parts[0]

    @property
    def seen(self) -> Seen | None:
        """How training had the part; None where the images that it measured did not show it."""
        return self.estimator.checkpoint.seen.get(self.part.name)

    @property
    def length_px(self) -> float:
        """Diameter of the found part in the picture, pixels."""
        assert self.found is not None
        return self.part.diameter * focal_length(self.K) / float(self.found.T_cam_obj[2, 3])

    @cached_property
    def box(self) -> Letterbox:
        """The size in which the network sees the found part best, or the picture."""
        boxes = letterboxes(self.estimator.checkpoint, self.K, self.image, self.distances)
        if self.found is None or self.seen is None:
            return boxes[-1]
        usual = math.sqrt(self.seen.smallest_px * self.seen.largest_px)
        return min(boxes, key=lambda one: abs(math.log(self.length_px * one.scale_x / usual)))

    @cached_property
    def closer(self) -> Detection | None:
        """What is found, with the agreement of its outline; None where there is no mesh."""
        if self.found is None or any(part.mesh is None for part in self.parts):
            return None
        if self.estimator.refiner is not None:
            return self.found
        estimator = self.estimator.refining("region", self.parts)
        return estimator.refined([self.found], self.image, self.K)[0]

    def around(self) -> Picture:
        """Return the found part's surroundings in :attr:`box`, or all of the picture."""
        picture = self.box.image(self.image)
        if self.found is None:
            return picture
        points = self.box.points(self.found.keypoints[np.isfinite(self.found.keypoints[:, 0])])
        size = (picture.shape[1], picture.shape[0])
        low = np.clip(np.floor(points.min(axis=0)), 0, size).astype(int)
        high = np.clip(np.ceil(points.max(axis=0)) + 1, 0, size).astype(int)
        cut = picture[low[1] : high[1], low[0] : high[0]]
        return cut if min(cut.shape[:2]) >= LEAST_PX else picture

    def strongest_beliefs(self) -> Float[np.ndarray, "9"]:
        """Return the strongest belief of each keypoint of the part, in the sizes looked at."""
        estimator = self.estimator
        number = [part.name for part in estimator.parts].index(self.part.name)
        own = slice(number * NUM_KEYPOINTS, (number + 1) * NUM_KEYPOINTS)
        strongest = np.zeros(NUM_KEYPOINTS)
        for view in estimator.views(self.image, self.K, self.distances):
            belief, _ = estimator.maps(view.pixels)
            strongest = np.maximum(strongest, belief[own].flatten(1).amax(1).cpu().numpy())
        return strongest

    def _best(self, distances: tuple[float, float] | None) -> Detection | None:
        found = self.estimator.predict(
            self.image, self.K, distances=distances, cropped=self.cropped
        )
        return found[0] if found else None


def num_keypoints(one: Detection) -> int:
    """Return how many keypoints the maps have of a part."""
    return int(np.isfinite(one.peaks[:, 0]).sum())


def edge_width(picture: Picture) -> float | None:
    """Return the blur's standard deviation at the strongest edges, pixels; None without edges.

    A step blurred by σ has a gradient proportional to 1/√(σ² + s²) once it is blurred by s as well,
    so the ratio for s and 2s tells σ (Zhuo and Sim 2011); s is a pixel. Where edges are close to
    each other or noise is strong, the width is too small by up to a third; motion along an edge
    does not show.
    """
    grey = cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY).astype(np.float32)
    fine, coarse = _gradient(grey, 1.0), _gradient(grey, 2.0)
    least = max(STRONG * float(np.percentile(fine, 99.5)), 2 * _noise(grey), 1.0)
    edges = (fine >= cv2.dilate(fine, np.ones((3, 3)))) & (fine > least)
    if np.count_nonzero(edges) < FEWEST:
        return None
    # 1 for a blur without end, 4 for none.
    ratio = float(np.clip((fine[edges].sum() / coarse[edges].sum()) ** 2, 1.001, 4.0))
    return max(NARROWEST, math.sqrt((4 - ratio) / (ratio - 1)))


def highlights(picture: Picture) -> float:
    """Return the grey level, of 255, that one pixel of a hundred exceeds."""
    return float(np.percentile(cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY), 99))


def clipped(picture: Picture) -> float:
    """Return the share of pixels that are white without detail."""
    return float((picture.min(axis=2) >= WHITE).mean())


def _gradient(
    grey: Float32[np.ndarray, "height width"], sigma_px: float
) -> Float32[np.ndarray, "height width"]:
    """Return the gradient of a blurred picture, grey levels a pixel."""
    soft = cv2.GaussianBlur(grey, (0, 0), sigma_px)
    # Scharr's filter weighs 16 on each side, two pixels apart.
    x, y = (cv2.Scharr(soft, cv2.CV_32F, *axis, scale=1 / 32) for axis in ((1, 0), (0, 1)))
    return np.asarray(np.hypot(x, y))


def _noise(grey: Float32[np.ndarray, "height width"]) -> float:
    """Return the noise's standard deviation, grey levels (Immerkær 1996, with the median)."""
    kernel = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]], np.float32)
    return float(np.median(np.abs(cv2.filter2D(grey, -1, kernel)))) / 0.6745 / 6
