"""Codes and light: sRGB, and the camera's tone curve from radiance to sRGB."""

from __future__ import annotations

from typing import Final

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray


def decode_srgb(code: Float[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
    """Return the linear light of sRGB values, both 1 for white (IEC 61966-2-1)."""
    return np.where(code <= 0.04045, code / 12.92, ((code + 0.055) / 1.055) ** 2.4)


def encode_srgb(light: Float[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
    """Return the sRGB values of linear light, both 1 for white."""
    return np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)


SRGB_TO_LINEAR: Final[NDArray[np.float32]] = decode_srgb(np.arange(256) / 255).astype(np.float32)
"""sRGB code 0–255 to linear light in [0, 1]."""

CODE_STEPS: Final = 4096
"""Steps of the tables that encode light, per unit of light."""

LINEAR_TO_SRGB: Final[NDArray[np.float32]] = (
    255 * encode_srgb(np.arange(CODE_STEPS + 1) / CODE_STEPS)
).astype(np.float32)
"""Linear light in steps of 1/4096 to an sRGB value of 0–255, the inverse of SRGB_TO_LINEAR."""

TONE_LIMIT: Final = 4.0
"""Radiance at which the tone curve ends, white to 1/1000."""

_SHOULDER: Final = 0.5
_radiance = np.arange(int(TONE_LIMIT) * CODE_STEPS + 1) / CODE_STEPS
# Linear up to the shoulder; above, it bends smoothly towards 1, as a camera's curve does, so that
# bright white parts keep their shading.
_shown = np.where(
    _radiance <= _SHOULDER,
    _radiance,
    1 - (1 - _SHOULDER) * np.exp((_SHOULDER - _radiance) / (1 - _SHOULDER)),
)
TONE_CURVE: Final[NDArray[np.float32]] = (255 * encode_srgb(_shown)).astype(np.float32)
"""Radiance in steps of 1/4096 to an sRGB value of 0–255."""
