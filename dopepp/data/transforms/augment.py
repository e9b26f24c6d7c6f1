"""Augment light, colour, focus, sensor noise and compression; poses are unchanged.

Lens, sensor and file effects come from the virtual camera (:mod:`dopepp.virtual.sensor`). To add a
change, write a function of an image, add a field for its range and call it in
:meth:`Photometric.__call__`, in the order of a camera: light and colour, lens, sensor, file.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated

import cv2
import numpy as np
from jaxtyping import Float
from numpy.random import Generator

from dopepp.core.validation import Checked, Pair, Range, Share, Span
from dopepp.drawing.pictures import RGBImage
from dopepp.virtual.sensor import add_noise, compress, defocus

# BT.601 luma weights: grey keeps its brightness when saturation or hue changes.
_LUMA = np.array([0.299, 0.587, 0.114])
# RGB to YIQ, in which a hue change is a rotation of the (I, Q) plane.
_YIQ = np.array([_LUMA, [0.5959, -0.2746, -0.3213], [0.2115, -0.5227, 0.3112]])
_RGB = np.linalg.inv(_YIQ)


_Change = Annotated[float, Range(0, math.inf)]
_Changes = Annotated[Pair, Span(0, math.inf)]


@dataclass(frozen=True)
class Photometric(Checked):
    """Random photometric changes of an image; amounts are sampled uniformly within the limits.

    Attributes:
        brightness: Largest offset of all channels in either direction, as a share of 255.
        contrast: Largest relative change of the contrast about mid-grey.
        saturation: Largest relative change of the chroma.
        hue: Largest hue rotation, radians.
        colour_gain: Largest relative change of each colour channel (white balance).
        blur_sigma: Range of the standard deviation of the Gaussian blur, pixels.
        noise_sigma: Range of the noise's standard deviation, grey levels.
        jpeg_quality: Range of the JPEG quality, 1 (worst) to 100.
    """

    brightness: _Change = 0.2
    contrast: _Change = 0.3
    saturation: _Change = 0.3
    hue: _Change = 0.15
    colour_gain: _Change = 0.1
    blur_probability: Share = 0.2
    blur_sigma: _Changes = (0.3, 1.2)
    noise_probability: Share = 0.3
    noise_sigma: _Changes = (1.0, 8.0)
    jpeg_probability: Share = 0.1
    jpeg_quality: _Changes = (40, 95)

    def __call__(self, image: RGBImage, rng: Generator) -> RGBImage:
        """Return an augmented copy of an RGB image."""
        image = cv2.transform(image, self._colour_matrix(rng))
        if rng.random() < self.blur_probability:
            image = defocus(image, rng.uniform(*self.blur_sigma))
        if rng.random() < self.noise_probability:
            image = add_noise(image, rng.uniform(*self.noise_sigma), 0.0, int(rng.integers(2**32)))
        if rng.random() < self.jpeg_probability:
            image = compress(image, round(rng.uniform(*self.jpeg_quality)))
        return np.asarray(image)

    def _colour_matrix(self, rng: Generator) -> Float[np.ndarray, "3 4"]:
        """Sample all colour changes as one affine map of RGB, so that pixels are rounded once."""
        angle = rng.uniform(-self.hue, self.hue)
        chroma = 1 + rng.uniform(-self.saturation, self.saturation)
        rotation = np.eye(3)
        cos, sin = chroma * np.cos(angle), chroma * np.sin(angle)
        rotation[1:, 1:] = [[cos, -sin], [sin, cos]]
        gain = 1 + rng.uniform(-self.colour_gain, self.colour_gain, 3)
        contrast = 1 + rng.uniform(-self.contrast, self.contrast)
        linear = contrast * gain[:, None] * (_RGB @ rotation @ _YIQ)
        offset = 127.5 * (1 - contrast) + 255 * rng.uniform(-self.brightness, self.brightness)
        return np.column_stack([linear, np.full(3, offset)])
