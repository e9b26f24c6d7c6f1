"""The camera sensor: exposure, blur, noise and compression of an ideal image; sRGB, tone curve.

To add an effect, write a function, add its parameter to :class:`Sensor` and its probability and
range to :class:`Sensors`, and call it in :func:`capture` (order: exposure, lens, chip, file).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cache
from statistics import NormalDist
from typing import Annotated, Final

import cv2
import numpy as np
from jaxtyping import Float, Float32, UInt8
from numpy.random import Generator
from numpy.typing import NDArray

from dopepp.core.compiled import Array, compiled
from dopepp.core.validation import Checked, Pair, Range, Span
from dopepp.drawing.pictures import RGBImage

Probability = Annotated[float, Range(0.0, 1.0, "probability")]

_NOISE_VALUES: Final = 65536  # length of the table of normal values; a power of two
_NOISE_RUN: Final = 1024  # values read in a row; then the hash chooses another start and sign


@dataclass(frozen=True)
class Sensor:
    """A camera's effects, applied to the whole image after rendering."""

    exposure_ev: float = 0.0  # Exposure in stops; 1 doubles the light
    blur_px: float = 0.0  # Standard deviation of the defocus blur, pixels
    # Displacement (x, y) of the image during the exposure, pixels.
    motion_px: tuple[float, float] = (0.0, 0.0)
    read_noise: float = 0.0  # Standard deviation of signal-independent noise, grey levels of 255
    # Standard deviation of signal-dependent noise at white, grey levels. It grows with the square
    # root of the signal.
    shot_noise: float = 0.0
    jpeg_quality: int | None = None  # JPEG quality, 1 to 100; None for no compression
    noise_seed: int = 0


@dataclass(frozen=True)
class Sensors(Checked):
    """Probabilities and ranges of the camera effects in :class:`Sensor`.

    Attributes:
        exposure_probability: Probability of an exposure other than 0.
        exposure_ev: Exposure in stops; 1 doubles the light.
        blur_probability: Probability of defocus blur.
        blur_px: Standard deviation of the blur, pixels; scales with the preset's image size.
        motion_probability: Probability of motion blur.
        motion_px: Displacement during the exposure, pixels; scales with the preset's image size.
        noise_probability: Probability of noise.
        read_noise: Standard deviation of signal-independent noise, grey levels.
        shot_noise: Standard deviation of signal-dependent noise at white, grey levels.
        jpeg_probability: Probability of JPEG compression.
        jpeg_quality: JPEG quality, 1 to 100.
    """

    exposure_probability: Probability = 0.5
    exposure_ev: Annotated[Pair, Span(-8.0, 8.0, "stops")] = (-0.4, 0.4)
    blur_probability: Probability = 0.2
    blur_px: Annotated[Pair, Span(0.0, 50.0, "pixels")] = (0.3, 1.0)
    motion_probability: Probability = 0.1
    motion_px: Annotated[Pair, Span(0.0, 200.0, "pixels")] = (1.0, 5.0)
    noise_probability: Probability = 0.5
    read_noise: Annotated[Pair, Span(0.0, 127.0, "grey levels")] = (0.5, 2.0)
    shot_noise: Annotated[Pair, Span(0.0, 127.0, "grey levels")] = (0.5, 3.0)
    jpeg_probability: Probability = 0.15
    jpeg_quality: Annotated[tuple[int, int], Span(1, 100, "JPEG quality")] = (70, 95)

    def resized(self, scale: float) -> Sensors:
        """Return the distribution for scaled images, with both blurs multiplied by ``scale``."""
        blur, motion = ((scale * low, scale * high) for low, high in (self.blur_px, self.motion_px))
        return replace(self, blur_px=blur, motion_px=motion)

    def draw(self, rng: Generator) -> Sensor:
        """Sample a sensor's settings."""
        steps = ("exposure", "blur", "motion", "noise", "jpeg")
        on = rng.random(5) < [getattr(self, f"{step}_probability") for step in steps]
        direction, length = rng.uniform(0, 2 * np.pi), rng.uniform(*self.motion_px)
        motion = (float(length * np.cos(direction)), float(length * np.sin(direction)))
        # All numbers are sampled, used or not, so that a probability changes no other effect.
        exposure, blur = rng.uniform(*self.exposure_ev), rng.uniform(*self.blur_px)
        read, shot = rng.uniform(*self.read_noise), rng.uniform(*self.shot_noise)
        quality = int(rng.integers(self.jpeg_quality[0], self.jpeg_quality[1] + 1))
        return Sensor(
            exposure_ev=exposure if on[0] else 0.0,
            blur_px=blur if on[1] else 0.0,
            motion_px=motion if on[2] else (0.0, 0.0),
            read_noise=read if on[3] else 0.0,
            shot_noise=shot if on[3] else 0.0,
            jpeg_quality=quality if on[4] else None,
            noise_seed=int(rng.integers(2**32)),
        )


def capture(image: RGBImage, sensor: Sensor) -> RGBImage:
    """Apply a sensor's effects to an ideal image; the default sensor has none.

    Exposure works on linear light; blurs work on sRGB and spread highlights less than a lens does.
    """
    if sensor.exposure_ev:
        image = np.asarray(cv2.LUT(image, _exposure_curve(sensor.exposure_ev)))
    if sensor.blur_px >= 0.1:  # narrower blur does not change 8-bit images
        image = defocus(image, sensor.blur_px)
    if any(sensor.motion_px):
        image = motion_blur(image, sensor.motion_px)
    if sensor.read_noise or sensor.shot_noise:
        image = add_noise(image, sensor.read_noise, sensor.shot_noise, sensor.noise_seed)
    if sensor.jpeg_quality is not None:
        image = compress(image, sensor.jpeg_quality)
    return image


def defocus(image: RGBImage, sigma_px: float) -> RGBImage:
    """Blur an image with a Gaussian of standard deviation ``sigma_px``."""
    return np.asarray(cv2.GaussianBlur(image, (0, 0), sigma_px))


def motion_blur(image: RGBImage, motion_px: tuple[float, float]) -> RGBImage:
    """Average the image along a displacement (x, y) in pixels, centred on each pixel."""
    kernel = _line_kernel(*motion_px)
    return np.asarray(cv2.filter2D(image, -1, kernel, borderType=cv2.BORDER_REFLECT_101))


def add_noise(image: RGBImage, read: float, shot: float, seed: int) -> RGBImage:
    """Add Gaussian noise, independent per pixel and channel.

    ``read`` and ``shot`` are as in :class:`Sensor`; ``seed`` (0 to 2³² − 1) fixes the noise.
    """
    noisy = np.empty(image.shape, np.uint8)
    values = np.ascontiguousarray(image).reshape(-1)
    read_variance, shot_variance = np.float32(read**2), np.float32(shot**2 / 255)
    _add_noise(values, read_variance, shot_variance, _normal_values(), seed, noisy.reshape(-1))
    return noisy


def compress(image: RGBImage, quality: int) -> RGBImage:
    """Compress to JPEG (quality 1 to 100) and back."""
    # The codec expects B, G, R.
    bgr = cv2.cvtColor(image, cv2.COLOR_RGB2BGR)
    _, encoded = cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, quality])
    return np.asarray(cv2.cvtColor(cv2.imdecode(encoded, cv2.IMREAD_COLOR), cv2.COLOR_BGR2RGB))


def _exposure_curve(exposure_ev: float) -> UInt8[np.ndarray, "256"]:
    """Return the sRGB code for each code 0–255 with its light times 2^EV, clipped at white."""
    light = np.clip(decode_srgb(np.arange(256) / 255) * 2.0**exposure_ev, 0.0, 1.0)
    return np.asarray(np.rint(255 * encode_srgb(light)), np.uint8)


def _line_kernel(x: float, y: float) -> Float32[np.ndarray, "side side"]:
    """Return the kernel of motion by (x, y) pixels: a line whose points spread over four cells."""
    half = math.ceil(max(abs(x), abs(y)) / 2)
    kernel = np.zeros((2 * half + 2, 2 * half + 2))
    # Four points per pixel make the line even; an odd number keeps a point in the middle.
    steps = 2 * math.ceil(2 * math.hypot(x, y)) + 1
    points = half + ((np.arange(steps) + 0.5) / steps - 0.5)[:, None] * (x, y)
    corner = points.astype(np.int64)
    near = points - corner
    for right, down in ((0, 0), (1, 0), (0, 1), (1, 1)):
        share = np.abs(1 - right - near[:, 0]) * np.abs(1 - down - near[:, 1])
        np.add.at(kernel, (corner[:, 1] + down, corner[:, 0] + right), share)
    # Drop the empty last row and column to centre the kernel.
    return np.asarray(kernel[:-1, :-1] / kernel.sum(), np.float32)


@cache
def _normal_values() -> Float32[np.ndarray, "values"]:
    """Return shuffled quantiles of the standard normal distribution, the first ones repeated."""
    # The start is repeated at the end, so that a run may start anywhere.
    normal = NormalDist()
    quantiles = [normal.inv_cdf((k + 0.5) / _NOISE_VALUES) for k in range(_NOISE_VALUES)]
    values = np.array(quantiles, np.float32)
    _shuffle(values)
    return np.concatenate([values, values[:_NOISE_RUN]])


@compiled()
def _shuffle(values: Array) -> None:
    """Shuffle in place (Fisher and Yates) by :func:`_mix_bits`, identically on all platforms."""
    for i in range(values.shape[0] - 1, 0, -1):
        k = _mix_bits(np.uint32(i)) % np.uint32(i + 1)
        values[i], values[k] = values[k], values[i]


@compiled(fastmath=True)
def _add_noise(
    image: Array, read: np.float32, shot: np.float32, table: Array, seed: int, noisy: Array
) -> None:
    """Add read noise (variance in squared grey levels) and shot noise (variance per grey level).

    ``image`` and ``noisy`` are flat uint8. The table has a power of two plus ``_NOISE_RUN`` values.
    """
    count, mask = image.shape[0], np.uint32(table.shape[0] - _NOISE_RUN - 1)
    start = _mix_bits(np.uint32(seed) ^ np.uint32(0x9E3779B9))
    least, most, half = np.float32(0), np.float32(255), np.float32(0.5)
    for run in range((count + _NOISE_RUN - 1) // _NOISE_RUN):
        h = _mix_bits(np.uint32(np.uint32(run) + start))
        first, last = run * _NOISE_RUN, min((run + 1) * _NOISE_RUN, count)
        sign = np.float32(1) if h & np.uint32(1) else np.float32(-1)
        normal = table[np.int64((h >> np.uint32(8)) & mask) :]
        for i in range(last - first):
            value = np.float32(image[first + i])
            value += sign * normal[i] * np.sqrt(read + shot * value) + half
            noisy[first + i] = np.uint8(np.int32(min(max(value, least), most)))


@compiled(inline="always")
def _mix_bits(h: np.uint32) -> np.uint32:
    """Mix 32 bits by xor-shifts and odd multipliers (a bijection)."""
    h = np.uint32(h ^ (h >> np.uint32(16)))
    h = np.uint32(h * np.uint32(0x7FEB352D))
    h = np.uint32(h ^ (h >> np.uint32(15)))
    h = np.uint32(h * np.uint32(0x846CA68B))
    return np.uint32(h ^ (h >> np.uint32(16)))


def decode_srgb(code: Float[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
    """Return the linear light of sRGB values, both 1 for white (IEC 61966-2-1)."""
    return np.where(code <= 0.04045, code / 12.92, ((code + 0.055) / 1.055) ** 2.4)


def encode_srgb(light: Float[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
    """Return the sRGB values of linear light, both 1 for white."""
    return np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)


SRGB_TO_LINEAR: Final[NDArray[np.float32]] = decode_srgb(np.arange(256) / 255).astype(np.float32)
"""sRGB code 0–255 to linear light in [0, 1]."""

CODE_STEPS: Final = 4096  # entries of the encoding tables per unit of light

LINEAR_TO_SRGB: Final[NDArray[np.float32]] = (
    255 * encode_srgb(np.arange(CODE_STEPS + 1) / CODE_STEPS)
).astype(np.float32)
"""Linear light in steps of 1/4096 to an sRGB value of 0–255, the inverse of SRGB_TO_LINEAR."""

TONE_LIMIT: Final = 4.0  # radiance at which the tone curve ends, white to 1/1000
_SHOULDER: Final = 0.5
_radiance = np.arange(int(TONE_LIMIT) * CODE_STEPS + 1) / CODE_STEPS
# Linear up to the shoulder, then smoothly towards 1 like a camera's curve, so that bright white
# parts keep their shading.
_shown = np.where(
    _radiance <= _SHOULDER,
    _radiance,
    1 - (1 - _SHOULDER) * np.exp((_SHOULDER - _radiance) / (1 - _SHOULDER)),
)
TONE_CURVE: Final[NDArray[np.float32]] = (255 * encode_srgb(_shown)).astype(np.float32)
"""Radiance in steps of 1/4096 to an sRGB value of 0–255."""
