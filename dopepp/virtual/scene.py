"""A scene: objects, materials, lights, background and sensor of one image; the rendered image."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from typing import Final

import cv2
import numpy as np
from jaxtyping import Float, Float32, Int16

from dopepp.drawing.pictures import RGBImage
from dopepp.geometry.camera import CameraMatrix, Transform, project_keypoints, transform
from dopepp.geometry.rotation import RotationMatrix, Vector
from dopepp.parts.part import Part
from dopepp.virtual.sensor import Sensor
from dopepp.virtual.surface import Surface

NEAR: Final = 0.01  # metres; nothing closer to the camera is drawn

Triple = tuple[float, float, float]  # a hashable vector or colour


def triple(values: Iterable[float]) -> Triple:
    """Convert three numbers to a tuple of floats."""
    first, second, third = (float(value) for value in values)
    return first, second, third


@dataclass(frozen=True)
class Grooves:
    """Fine parallel grooves that tilt normals: layer lines of 3D prints, brushed metal."""

    axis: Triple = (0.0, 0.0, 1.0)  # Unit vector across the grooves, object frame
    # Distance between grooves, metres; grooves finer than a pixel widen the highlight.
    pitch: float = 0.0002
    slope: float = 0.3  # Largest slope of a groove's flanks, the tangent of the normal's tilt
    # 0 for even grooves (layer lines), 1 for random depths and widths (brushing).
    irregularity: float = 0.0


NOISE_LIMITS: Final = (0.05, 2.0)  # limits of the noise factor on a material's albedo


@dataclass(frozen=True)
class Material:
    """Reflectance of a surface (Lambert plus GGX, metallic workflow)."""

    # Linear albedo in [0, 1] per channel; multiplies the texture or vertex colours.
    colour: Triple = (0.6, 0.6, 0.6)
    roughness: float = 0.6  # GGX roughness in (0, 1]; 1 is chalk
    # Reflectance at normal incidence of the dielectric part, 0.04 for plastics.
    specular: float = 0.04
    # 1 for a metal, which has no diffuse reflection and a specular one in its colour.
    metallic: float = 0.0
    noise: float = 0.0  # Relative amplitude of the albedo's noise, clipped to :data:`NOISE_LIMITS`
    noise_pitch: float = 0.005  # Distance between the lattice points of the noise, metres
    grooves: Grooves | None = None


@dataclass(frozen=True)
class Light:
    """A point light."""

    position: Triple  # Camera frame, metres
    # Linear RGB that a white surface facing the light shows at ``reach``.
    intensity: Triple = (0.8, 0.8, 0.8)
    # Distance at which a surface has this intensity, metres (inverse-square law).
    reach: float = 1.0


@dataclass(frozen=True)
class Panel:
    """A distant lamp tube or window with soft edges, which metals mirror.

    The radiance in a unit direction with the components a across, b along and c towards the panel
    is ``intensity`` · exp(−½ (a²/width² + b²/length²)), times ½ + 2c limited to 0 … 1.
    """

    middle: Triple  # Unit vector to the panel's middle, camera frame
    along: Triple  # Unit vector of its longer side, perpendicular to ``middle``
    width: float  # Standard deviation across the panel, as the sine of an angle
    length: float  # Standard deviation along the panel, likewise
    # Linear RGB radiance of the middle; a white surface under uniform light has 1.
    intensity: Triple

    @property
    def across(self) -> Vector:
        """Unit vector across the panel."""
        return np.cross(self.along, self.middle)

    @property
    def light(self) -> Vector:
        """Light on a white surface that faces the panel, linear RGB."""
        return 2 * self.width * self.length * np.array(self.intensity)


@dataclass(frozen=True)
class Ambient:
    """Ambient light: linear RGB of the upper hemisphere ``above`` and the lower ``below``.

    ``up`` is a unit vector to the upper hemisphere, camera frame. ``panels`` add to the light.
    """

    up: Triple = (0.0, -1.0, 0.0)
    above: Triple = (0.25, 0.25, 0.25)
    below: Triple = (0.12, 0.12, 0.12)
    panels: tuple[Panel, ...] = ()

    def light_on(self, normal: Vector) -> Vector:
        """Return the light on a white surface with a unit normal and a free sky, linear RGB."""
        above = 0.5 + 0.5 * float(np.dot(normal, self.up))
        light = above * np.array(self.above) + (1 - above) * np.array(self.below)
        for panel in self.panels:
            light += max(float(np.dot(normal, panel.middle)), 0.0) * panel.light
        return light

    def rotated(self, R: RotationMatrix) -> Ambient:
        """Return the light in another camera's frame."""
        panels = (
            replace(panel, middle=triple(R @ panel.middle), along=triple(R @ panel.along))
            for panel in self.panels
        )
        return replace(self, up=triple(R @ self.up), panels=tuple(panels))


@dataclass(frozen=True)
class Plane:
    """An unbounded supporting plane, the table.

    The scene's background image shows the plane; renderers add the shadows of objects.
    """

    normal: Triple  # Unit normal on the camera's side, camera frame
    offset: float  # ``normal · x`` of the plane's points, metres; negative, as the camera is above

    def inverse_depth_row(self, K: CameraMatrix) -> Vector:
        """Return (a, b, c): the plane's point at pixel (u, v) has depth 1/(a u + b v + c) m."""
        return np.asarray(np.linalg.solve(K.T, np.array(self.normal, np.float64)) / self.offset)


@dataclass(frozen=True, eq=False)
class SceneObject:
    """A surface with its pose and material; ``part`` is None for a distractor."""

    surface: Surface
    T_cam_obj: Transform
    material: Material = field(default_factory=Material)
    part: Part | None = None

    @property
    def centre(self) -> Vector:
        """Centre of the bounding box, camera frame, metres."""
        return transform(self.T_cam_obj, self.surface.centre)

    @property
    def is_target(self) -> bool:
        """Whether the network must detect the object."""
        return self.part is not None

    @property
    def label(self) -> str:
        """The part's name, or ``distractor``."""
        return "distractor" if self.part is None else self.part.name


@dataclass(frozen=True, eq=False)
class Scene:
    """Objects, lights, background and camera of one image."""

    K: CameraMatrix
    background: RGBImage
    objects: tuple[SceneObject, ...] = ()
    lights: tuple[Light, ...] = ()
    ambient: Ambient = field(default_factory=Ambient)
    plane: Plane | None = None
    sensor: Sensor = field(default_factory=Sensor)
    # Transform to this camera from the world frame, which is the camera frame of the sampled scene
    # (see :meth:`seen_from`).
    T_cam_world: Transform = field(default_factory=lambda: np.eye(4))

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) of the image, pixels."""
        return self.background.shape[1], self.background.shape[0]

    @property
    def targets(self) -> tuple[int, ...]:
        """Indices of the objects that the network must detect."""
        return tuple(i for i, item in enumerate(self.objects) if item.is_target)

    def seen_from(self, T_new_cam: Transform) -> Scene:
        """Return the static scene as seen by another camera with the same lens and sensor.

        The background is warped by the plane's homography or, without a plane, by rotation only.
        Pixels outside the old image are filled by reflection at its border. ``T_new_cam`` maps this
        camera's frame into the other's, metres.
        """
        R, shift = T_new_cam[:3, :3], T_new_cam[:3, 3]
        homography, plane = R, self.plane
        if plane is not None:
            normal = R @ plane.normal
            homography = R + np.outer(shift, plane.normal) / plane.offset
            plane = Plane(triple(normal), plane.offset + float(normal @ shift))
        homography = self.K @ homography @ np.linalg.inv(self.K)
        background = cv2.warpPerspective(
            self.background, homography, self.size, borderMode=cv2.BORDER_REFLECT_101
        )
        objects = (replace(item, T_cam_obj=T_new_cam @ item.T_cam_obj) for item in self.objects)
        lights = (
            replace(light, position=triple(R @ light.position + shift)) for light in self.lights
        )
        return replace(
            self,
            background=background,
            objects=tuple(objects),
            lights=tuple(lights),
            ambient=self.ambient.rotated(R),
            plane=plane,
            T_cam_world=T_new_cam @ self.T_cam_world,
        )

    def keypoints(self, index: int) -> Float[np.ndarray, "9 2"]:
        """Return a target's projected corners and centroid, pixels; distractors have none."""
        item = self.objects[index]
        if item.part is None:
            raise ValueError(f"object {index} is a distractor without keypoints")
        return project_keypoints(item.part.cuboid, item.T_cam_obj, self.K)


@dataclass(frozen=True, eq=False)
class Rendered:
    """An image and its ground truth.

    Attributes:
        depth: Metres along z at pixel centres, float32; 0 on the background.
        instances: Index into ``scene.objects`` at pixel centres, −1 on plane and background.
        visible_fractions: Visible share of each object's silhouette on an unbounded canvas.
    """

    image: RGBImage
    depth: Float32[np.ndarray, "height width"]
    instances: Int16[np.ndarray, "height width"]
    visible_fractions: Float[np.ndarray, "objects"]
    scene: Scene
