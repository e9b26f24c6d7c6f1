"""Codes and light: sRGB decoding, and the camera's tone curve from radiance to sRGB."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

_codes = np.arange(256) / 255.0
SRGB_TO_LINEAR: Final[NDArray[np.float32]] = np.where(
    _codes <= 0.04045, _codes / 12.92, ((_codes + 0.055) / 1.055) ** 2.4
).astype(np.float32)
"""sRGB code 0–255 to linear light in [0, 1]."""

CODE_STEPS: Final = 4096
"""Steps of the tables that encode light, per unit of light."""


def _encoded(linear: NDArray[np.float64]) -> NDArray[np.float32]:
    codes = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    return np.asarray(255 * codes, np.float32)


LINEAR_TO_SRGB: Final = _encoded(np.arange(CODE_STEPS + 1) / CODE_STEPS)
"""Linear light in steps of 1/4096 to an sRGB value of 0–255, the inverse of SRGB_TO_LINEAR."""

TONE_LIMIT: Final = 4.0
"""Radiance at which the tone curve ends, white to 1/1000."""

_SHOULDER: Final = 0.5
_radiance = np.arange(int(TONE_LIMIT) * CODE_STEPS + 1) / CODE_STEPS
# Linear up to the shoulder; above, it bends smoothly towards 1, as a camera's curve does, so that
# bright white parts keep their shading.
TONE_CURVE: Final = _encoded(
    np.where(
        _radiance <= _SHOULDER,
        _radiance,
        1 - (1 - _SHOULDER) * np.exp((_SHOULDER - _radiance) / (1 - _SHOULDER)),
    )
)
"""Radiance in steps of 1/4096 to an sRGB value of 0–255."""
