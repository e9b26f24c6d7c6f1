"""Jitter the camera, to keep the network from memorising images: roll, zoom and shift the image.

Camera matrix, poses and keypoints follow exactly: a camera that rolls about its optical axis and
zooms sees the same rays at other pixels.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated

import cv2
import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from dopepp.core.validation import Checked, Pair, Range, Span
from dopepp.data.sample import Instance, Sample, reduce_visibility
from dopepp.geometry.camera import crop_camera, make_transform
from dopepp.geometry.rotation import rotation_vector_to_matrix


@dataclass(frozen=True)
class CameraJitter(Checked):
    """Random roll, zoom and shift of the camera; pixels from outside the image repeat its border.

    Attributes:
        roll_deg: Largest rotation of the image about its centre, in either direction, degrees.
        zoom: Range of the factor on the focal length, sampled log-uniformly.
        shift: Largest shift in each direction, as a share of the image's width and height.
    """

    roll_deg: Annotated[float, Range(0, 180, "degrees")] = 20.0
    zoom: Annotated[Pair, Span(1e-3, 1e3, "factor")] = (0.9, 1.1)
    shift: Annotated[float, Range(0, 0.49, "share")] = 0.1

    def __call__(self, sample: Sample, rng: Generator) -> Sample:
        """Return the sample as the jittered camera sees it, without depth."""
        size = np.array(sample.size)
        middle = (size - 1) / 2
        roll = np.radians(rng.uniform(-self.roll_deg, self.roll_deg))
        R_roll = rotation_vector_to_matrix(np.array([0, 0, roll]))
        zoom = float(np.exp(rng.uniform(*np.log(self.zoom))))
        target = middle + rng.uniform(-self.shift, self.shift, 2) * size
        K = np.diag([zoom, zoom, 1.0]) @ sample.K
        # The homography is affine, because the camera rolls about its axis.
        warp = (K @ R_roll @ np.linalg.inv(sample.K))[:2]
        offset = target - warp @ [*middle, 1.0]
        warp[:, 2] += offset

        def warp_pixels(pixels: NDArray[np.uint8], border: int, flags: int) -> NDArray[np.uint8]:
            image = cv2.warpAffine(pixels, warp, sample.size, flags=flags, borderMode=border)
            return np.asarray(image, np.uint8)

        def warp_instance(instance: Instance) -> Instance:
            mask = instance.mask
            if mask is not None:
                codes = warp_pixels(mask.astype(np.uint8), cv2.BORDER_CONSTANT, cv2.INTER_NEAREST)
                mask = codes.astype(bool)
            jittered = replace(
                instance,
                T_cam_obj=make_transform(R_roll, np.zeros(3)) @ instance.T_cam_obj,
                keypoints=instance.keypoints @ warp[:, :2].T + warp[:, 2],
                mask=mask,
            )
            shape = sample.image.shape[:2]
            return reduce_visibility(instance, jittered, (shape, shape), zoom)

        return replace(
            sample,
            image=warp_pixels(sample.image, cv2.BORDER_REPLICATE, cv2.INTER_LINEAR),
            K=crop_camera(K, *-offset),
            instances=[warp_instance(instance) for instance in sample.instances],
            depth=None,  # unused in training
        )
