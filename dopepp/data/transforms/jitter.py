"""Camera jitter: the same scene as a camera sees it that is rolled, zoomed and moved a little.

A render is seen many times in a training; each time a little different, a network learns the part
from it and not the picture. Image, camera matrix, poses and keypoints all follow exactly: a camera
that rolls about its optical axis and zooms sees the same rays, at other pixels.
"""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from dopepp.data.sample import Instance, Sample, less_visible
from dopepp.geometry.camera import crop_camera, make_transform
from dopepp.geometry.rotation import rotation_vector_to_matrix


class CameraJitter:
    """Roll, zoom and move the camera's picture at random; what comes into view repeats its border.

    Args:
        roll_deg: Largest turn of the picture about its middle, to either side.
        zoom: Range of the factor on the focal length, logarithmically uniform.
        shift: Largest move in each direction, as a share of the picture's sides.
    """

    def __init__(
        self, roll_deg: float = 20.0, zoom: tuple[float, float] = (0.9, 1.1), shift: float = 0.1
    ) -> None:
        if not (0 <= roll_deg <= 180 and 0 < zoom[0] <= zoom[1] and 0 <= shift < 0.5):
            raise ValueError(
                f"roll_deg={roll_deg}, zoom={zoom}, shift={shift}: a roll in [0, 180], a zoom that "
                "ascends from above 0, a shift in [0, 0.5)"
            )
        self.roll_deg, self.zoom, self.shift = roll_deg, zoom, shift

    def __call__(self, sample: Sample, rng: Generator) -> Sample:
        """Return a sample seen by another camera; the argument is not changed.

        Of the objects, visible fractions become smaller by what leaves the picture
        (:func:`~dopepp.data.sample.less_visible`).
        """
        size = np.array(sample.size)
        middle = (size - 1) / 2
        roll = np.radians(rng.uniform(-self.roll_deg, self.roll_deg))
        turn = rotation_vector_to_matrix(np.array([0, 0, roll]))
        zoom = float(np.exp(rng.uniform(*np.log(self.zoom))))
        goal = middle + rng.uniform(-self.shift, self.shift, 2) * size
        K = np.diag([zoom, zoom, 1.0]) @ sample.K
        # A homography, and an affine one, because the camera rolls about its axis.
        warp = (K @ turn @ np.linalg.inv(sample.K))[:2]
        offset = goal - warp @ [*middle, 1.0]
        warp[:, 2] += offset

        def warped(pixels: NDArray[np.uint8], border: int, how: int) -> NDArray[np.uint8]:
            moved = cv2.warpAffine(pixels, warp, sample.size, flags=how, borderMode=border)
            return np.asarray(moved, np.uint8)

        def seen(one: Instance) -> Instance:
            """Return an object as the other camera sees it."""
            mask = one.mask
            if mask is not None:
                codes = warped(mask.astype(np.uint8), cv2.BORDER_CONSTANT, cv2.INTER_NEAREST)
                mask = codes.astype(bool)
            moved = replace(
                one,
                T_cam_obj=make_transform(turn, np.zeros(3)) @ one.T_cam_obj,
                keypoints=one.keypoints @ warp[:, :2].T + warp[:, 2],
                mask=mask,
            )
            shape = sample.image.shape[:2]
            return less_visible(one, moved, (shape, shape), zoom)

        return replace(
            sample,
            image=warped(sample.image, cv2.BORDER_REPLICATE, cv2.INTER_LINEAR),
            K=crop_camera(K, *-offset),
            instances=[seen(one) for one in sample.instances],
            depth=None,  # no training reads it
        )
