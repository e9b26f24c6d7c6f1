"""Rotations: quaternions are (w, x, y, z), matrices act on column vectors, angles are radians."""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Float

Vector = Float[np.ndarray, "3"]
RotationMatrix = Float[np.ndarray, "3 3"]


def quaternion_to_matrix(quaternion_wxyz: Float[np.ndarray, "4"]) -> RotationMatrix:
    """Convert a quaternion of any non-zero norm to a rotation matrix.

    Raises:
        ValueError: The quaternion is zero or not finite.
    """
    quaternion = np.asarray(quaternion_wxyz, np.float64)
    largest = np.abs(quaternion).max()
    if not np.isfinite(largest) or largest == 0.0:
        raise ValueError(f"a quaternion must be finite and non-zero, got {quaternion.tolist()}")
    quaternion = quaternion / largest  # squares must neither underflow nor overflow
    w, x, y, z = quaternion / np.linalg.norm(quaternion)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def matrix_to_quaternion(rotation: RotationMatrix) -> Float[np.ndarray, "4"]:
    """Convert a rotation matrix to its unit quaternion (w, x, y, z) with w >= 0.

    The quaternion is the leading eigenvector of a symmetric 4×4 matrix (Bar-Itzhack 2000), which
    has no singular case and tolerates slightly non-orthogonal matrices.
    """
    (a, b, c), (d, e, f), (g, h, i) = np.asarray(rotation, np.float64)
    symmetric = np.array(
        [
            [a + e + i, h - f, c - g, d - b],
            [h - f, a - e - i, b + d, c + g],
            [c - g, b + d, e - a - i, f + h],
            [d - b, c + g, f + h, i - a - e],
        ]
    )
    quaternion = np.linalg.eigh(symmetric)[1][:, -1]
    return quaternion if quaternion[0] >= 0 else -quaternion


def rotation_vector_to_matrix(
    vector: Float[np.ndarray, "*batch 3"],
) -> Float[np.ndarray, "*batch 3 3"]:
    """Convert rotation vectors (axis times angle in radians) to matrices by Rodrigues' formula."""
    vector = np.asarray(vector, np.float64)
    x, y, z = vector[..., 0], vector[..., 1], vector[..., 2]
    half = 0.5 * np.sqrt(x * x + y * y + z * z)[..., None, None]
    # sin(x)/x is exact for any small x; (1 − cos)/x² = (sin(x/2)/x)²·2 loses no digits near 0.
    half = np.where(half == 0, np.finfo(np.float64).tiny, half)
    sinc_half = np.sin(half) / half
    skew = np.zeros((*vector.shape, 3))
    skew[..., 2, 1], skew[..., 0, 2], skew[..., 1, 0] = x, y, z
    skew[..., 1, 2], skew[..., 2, 0], skew[..., 0, 1] = -x, -y, -z
    linear = sinc_half * np.cos(half)
    return np.asarray(np.eye(3) + linear * skew + 0.5 * sinc_half**2 * skew @ skew)


def matrix_to_rotation_vector(rotation: RotationMatrix) -> Vector:
    """Return the rotation vector (axis times angle in [0, π] radians) of a rotation matrix."""
    (a, b, c), (d, e, f), (g, h, i) = np.asarray(rotation, np.float64).tolist()
    axial = 0.5 * np.array([h - f, c - g, d - b])
    cosine = 0.5 * (a + e + i - 1.0)
    if cosine > 0.0:  # below 90° the sine determines the angle
        sine = math.hypot(*axial)
        return np.asarray(axial * (math.atan2(sine, cosine) / sine if sine > 0 else 1.0))
    w, *axis = matrix_to_quaternion(rotation)
    size = float(np.linalg.norm(axis))
    # For tiny angles, 2 atan(|v| / w) / |v| is 2 / w.
    factor = 2.0 * np.arctan2(size, w) / size if size > 0 else 2.0 / w
    return np.asarray(factor * np.array(axis))


def rotation_angle(rotation: Float[np.ndarray, "*batch 3 3"]) -> Float[np.ndarray, "*batch"]:
    """Return the angle of each rotation in [0, π], radians.

    ``atan2(|axial vector|, trace − 1)`` keeps full precision near 0 and π, unlike ``arccos``.
    """
    rotation = np.asarray(rotation, np.float64)
    axial = (rotation - np.swapaxes(rotation, -1, -2))[..., [2, 0, 1], [1, 2, 0]]
    trace = np.trace(rotation, axis1=-2, axis2=-1)
    return np.asarray(np.arctan2(np.linalg.norm(axial, axis=-1), trace - 1.0))


def rotation_to_z(axis: Vector) -> RotationMatrix:
    """Return a rotation that maps a unit axis to z; the rotation about z is arbitrary."""
    right = np.cross(np.eye(3)[np.abs(axis).argmin()], axis)
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(axis, right), axis])


def random_rotation(rng: np.random.Generator) -> RotationMatrix:
    """Sample a rotation uniformly over SO(3): a normalised 4-D Gaussian is a uniform quaternion."""
    return quaternion_to_matrix(rng.normal(size=4))


def nearest_rotation(matrices: Float[np.ndarray, "*batch 3 3"]) -> Float[np.ndarray, "*batch 3 3"]:
    """Return the nearest rotations U diag(1, 1, ±1) Vᵀ by the Frobenius norm (Umeyama 1991)."""
    left, _, right = np.linalg.svd(matrices)
    sign = np.sign(np.linalg.det(left) * np.linalg.det(right))
    scales = np.ones_like(matrices[..., 0])
    scales[..., 2] = sign
    return np.asarray((left * scales[..., None, :]) @ right)


def is_rigid(T: Float[np.ndarray, "4 4"], tolerance: float = 1e-3) -> bool:
    """Return whether a matrix is a finite 4×4 rigid transform, with the last row 0, 0, 0, 1.

    ``tolerance`` is the largest allowed absolute entry of R Rᵀ − I for the rotation R.
    """
    return (
        T.shape == (4, 4)
        and bool(np.isfinite(T).all())
        and is_rotation(T[:3, :3], tolerance)
        and T[3].tolist() == [0, 0, 0, 1]
    )


def is_rotation(rotation: RotationMatrix, tolerance: float = 1e-3) -> bool:
    """Return whether a matrix is 3×3, finite, right-handed, and max |R Rᵀ − I| <= ``tolerance``."""
    rotation = np.asarray(rotation, np.float64)
    return bool(
        rotation.shape == (3, 3)
        and np.isfinite(rotation).all()
        and np.abs(rotation @ rotation.T - np.eye(3)).max() <= tolerance
        and np.linalg.det(rotation) > 0
    )
