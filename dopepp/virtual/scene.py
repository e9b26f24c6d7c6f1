"""A scene: what stands before the camera, under which light, on which background."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float, UInt8

from dopepp.geometry.camera import project_keypoints
from dopepp.geometry.cuboid import NUM_KEYPOINTS
from dopepp.parts.part import Part
from dopepp.virtual.surface import Surface

NEAR = 0.01
"""Metres; nothing closer to the camera is drawn."""


@dataclass(frozen=True)
class Material:
    """How a surface reflects light (Lambert plus GGX).

    Attributes:
        colour: Linear albedo in [0, 1] per channel; a factor on the texture where there is one.
        roughness: GGX roughness in (0, 1]; 1 is chalk.
        specular: Reflectance at normal incidence, 0.04 for plastics.
        noise: Relative amplitude of the albedo's variation over the surface.
        noise_pitch: Size of that variation, metres.
    """

    colour: tuple[float, float, float] = (0.6, 0.6, 0.6)
    roughness: float = 0.6
    specular: float = 0.04
    noise: float = 0.0
    noise_pitch: float = 0.005


@dataclass(frozen=True)
class Light:
    """A point light.

    Attributes:
        position: Camera frame, metres.
        intensity: Linear RGB that a white surface facing the light shows at ``reach``.
        reach: Distance at which the intensity holds, metres; it falls off with the square.
    """

    position: tuple[float, float, float]
    intensity: tuple[float, float, float] = (0.8, 0.8, 0.8)
    reach: float = 1.0


@dataclass(frozen=True)
class Ambient:
    """Light from everywhere: a hemisphere above and one below.

    Attributes:
        up: Unit vector to the upper hemisphere, camera frame.
        above: Linear RGB of the upper hemisphere.
        below: Linear RGB of the lower hemisphere.
    """

    up: tuple[float, float, float] = (0.0, -1.0, 0.0)
    above: tuple[float, float, float] = (0.25, 0.25, 0.25)
    below: tuple[float, float, float] = (0.12, 0.12, 0.12)


@dataclass(frozen=True, eq=False)
class SceneObject:
    """One posed object.

    Attributes:
        surface: Its geometry.
        T_cam_obj: Rigid transform from object to camera frame, metres.
        material: Its reflectance.
        part: The part it is an instance of; None for a distractor.
    """

    surface: Surface
    T_cam_obj: Float[np.ndarray, "4 4"]
    material: Material = field(default_factory=Material)
    part: Part | None = None

    @property
    def is_target(self) -> bool:
        """Whether the network is to find it."""
        return self.part is not None

    @property
    def label(self) -> str:
        """The part's name; ``distractor`` for everything else."""
        return "distractor" if self.part is None else self.part.name


@dataclass(frozen=True, eq=False)
class Scene:
    """Everything one image shows.

    Attributes:
        K: Camera matrix, pixels.
        background: RGB image that fills the frame; its size is the image's size.
        objects: Targets and distractors.
        lights: Point lights, at most a few; the first casts shadows.
        ambient: Light from everywhere else.
    """

    K: Float[np.ndarray, "3 3"]
    background: UInt8[np.ndarray, "height width 3"]
    objects: tuple[SceneObject, ...] = ()
    lights: tuple[Light, ...] = ()
    ambient: Ambient = field(default_factory=Ambient)

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) in pixels."""
        return self.background.shape[1], self.background.shape[0]

    @property
    def targets(self) -> tuple[int, ...]:
        """Indices of the objects that the network is to find."""
        return tuple(i for i, item in enumerate(self.objects) if item.is_target)

    def keypoints(self, index: int) -> Float[np.ndarray, "9 2"]:
        """Return a target's projected cuboid corners and centroid, pixels.

        Raises:
            ValueError: The object is no target.
        """
        item = self.objects[index]
        if item.part is None:
            raise ValueError(f"object {index} is a distractor and has no {NUM_KEYPOINTS} keypoints")
        return project_keypoints(item.part.cuboid, item.T_cam_obj, self.K)
