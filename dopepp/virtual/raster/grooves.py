"""Layer lines and brushed metal: grooves tilt the normal, or widen the highlight when too fine.

A groove's profile is a sine of the distance along the axis, mixed with noise for irregular ones.
Averaged over a pixel, a sine keeps sinc(w) of its amplitude, w being the grooves per pixel; the
slope variance that the average takes away goes into the roughness (as in Olano and Baker, "LEAN
mapping", 2010), so grooves never alias and a distant print still has a broad highlight.
"""

from __future__ import annotations

import math

from dopepp.compiled import Array, compiled
from dopepp.virtual.raster.noise import streak_noise


@compiled(fastmath=True)
def _kept_share(grooves_per_px: float) -> float:
    """Return the share of a sine's amplitude that survives averaging over a pixel."""
    if grooves_per_px >= 1.0:
        return 0.0
    angle = math.pi * grooves_per_px
    return math.sin(angle) / angle if angle > 1e-3 else 1.0


@compiled(fastmath=True)
def tilt_normals(
    noise: Array,
    position: Array,
    axis: Array,
    phase_origin: float,
    focal: Array,
    pitch: float,
    slope: float,
    irregularity: float,
    normal: Array,
    alpha: Array,
) -> None:
    """Tilt the normals of grooved points, or widen their highlight where grooves are fine.

    Args:
        noise: :data:`~dopepp.virtual.raster.noise.NOISE`.
        position: Points in the camera frame, metres, shape (3, n).
        axis: Unit vector across the grooves, camera frame.
        phase_origin: ``axis · origin`` of the object's frame, metres.
        focal: (fx, fy), pixels.
        pitch: Metres from groove to groove.
        slope: Largest slope of the flanks.
        irregularity: 0 for sines, 1 for noise.
        normal: Unit normals towards the camera, shape (3, n), updated in place.
        alpha: GGX width, the square of the roughness, shape (n,), updated in place.
    """
    ax, ay, az = axis
    for p in range(position.shape[1]):
        nx, ny, nz = normal[0, p], normal[1, p], normal[2, p]
        px, py, pz = position[0, p], position[1, p], position[2, p]
        along = ax * nx + ay * ny + az * nz
        # The axis within the surface; its length is the sine between axis and normal.
        tx, ty, tz = ax - along * nx, ay - along * ny, az - along * nz
        # One pixel to the right moves the point by z (r_x − r (n·r_x)/(n·r)), r = P/z.
        facing = min(nx * px + ny * py + nz * pz, -1e-3 * pz) / pz
        shift = (ax * px + ay * py + az * pz) / (pz * facing)
        right = pz / focal[0] * (ax - shift * nx)
        down = pz / focal[1] * (ay - shift * ny)
        kept = _kept_share(math.sqrt(right * right + down * down) / pitch)
        if kept > 0.0:
            phase = (ax * px + ay * py + az * pz - phase_origin) / pitch
            wave = (1.0 - irregularity) * math.sin(2.0 * math.pi * phase)
            if irregularity > 0.0:
                wave += irregularity * streak_noise(noise, 2.0 * phase)
            tilt = slope * kept * wave
            nx, ny, nz = nx - tilt * tx, ny - tilt * ty, nz - tilt * tz
            norm = 1.0 / math.sqrt(nx * nx + ny * ny + nz * nz)
            normal[0, p], normal[1, p], normal[2, p] = norm * nx, norm * ny, norm * nz
        # A sine of amplitude s has the slope variance s²/2 along one axis, so s²/4 on average
        # over both, and a Beckmann or GGX lobe of width α has α²/2.
        lost = slope * slope * (tx * tx + ty * ty + tz * tz) * (1.0 - kept * kept)
        alpha[p] = min(math.sqrt(alpha[p] * alpha[p] + 0.5 * lost), 1.0)
