"""The same scene from nearer or farther: the camera moves, the world stays (paper Fig. 11).

The camera goes along the ray to the middle of the targets and keeps its orientation and its lens.
So a single part stays at its place in the image and grows about as a picture of it would. Objects,
lamps and the plane keep their places in the world; light from everywhere, and the picture behind
objects in mid-air, are infinitely far away and do not change.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from dopepp.geometry.camera import transform
from dopepp.geometry.cuboid import CENTROID
from dopepp.virtual.scene import NEAR, Light, SceneObject


def approach(objects: Sequence[SceneObject], scale: float) -> Float[np.ndarray, "3"]:
    """Return by how much the world moves in the camera frame, metres.

    Args:
        objects: What is in the scene; without a target the camera stays where it is.
        scale: How many times as large the targets are to appear: the distance from the camera to
            the mean of their cuboids' centres is divided by it. Positive.
    """
    centres = [
        transform(item.T_cam_obj, item.part.cuboid[CENTROID])
        for item in objects
        if item.part is not None
    ]
    if not centres or scale == 1:
        return np.zeros(3)
    return np.asarray((1 / scale - 1) * np.mean(centres, axis=0))


def moved(
    T_cam: Float[np.ndarray, "4 4"], shift: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "4 4"]:
    """Return the pose of something that moves by ``shift`` in the camera frame."""
    T = np.array(T_cam, np.float64)
    T[:3, 3] += shift
    return T


def moved_objects(
    objects: Iterable[SceneObject], shift: Float[np.ndarray, "3"]
) -> tuple[SceneObject, ...]:
    """Return objects after the move, without those that the camera has reached or passed."""
    there = (replace(item, T_cam_obj=moved(item.T_cam_obj, shift)) for item in objects)
    return tuple(
        item for item in there if transform(item.T_cam_obj, item.surface.hull)[:, 2].min() > NEAR
    )


def moved_lights(lights: Iterable[Light], shift: Float[np.ndarray, "3"]) -> tuple[Light, ...]:
    """Return lamps after the move; how strongly they light the scene stays the same."""
    x, y, z = (float(value) for value in shift)
    return tuple(
        replace(
            light, position=(light.position[0] + x, light.position[1] + y, light.position[2] + z)
        )
        for light in lights
    )
