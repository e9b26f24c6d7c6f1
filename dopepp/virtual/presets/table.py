"""The table: views of a supporting plane, resting orientations of parts, the plane's image."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import cv2
import numpy as np
from jaxtyping import Float
from numpy.random import Generator

from dopepp.core.validation import Checked, Pair, Range, Share, Span
from dopepp.drawing.pictures import Mask, RGBImage, Size
from dopepp.geometry.camera import CameraMatrix, Transform, make_transform
from dopepp.geometry.rotation import rotation_to_z, rotation_vector_to_matrix
from dopepp.virtual.backgrounds import Backgrounds
from dopepp.virtual.body import Hull
from dopepp.virtual.presets.placement import Angle, looking_down
from dopepp.virtual.scene import Plane, triple


@dataclass(frozen=True)
class Pile(Checked):
    """Heaps of objects dropped in a physics simulation (extra ``robot``), with any visibility.

    Attributes:
        piles: Number of different heaps in every 10,000 images; heaps are cached on disk.
        mixed_share: Probability that a heap has all kinds of targets; other heaps have one kind.
        bin_share: Probability that a heap lies in a bin and not on the open table.
        room: Side of the square bin or drop area, divided by the objects' mean size (cube root of
            the bounding box's volume) and by the square root of their number.
        wall_height: Height of the bin's walls, in diameters of the largest target.
        aside: Largest distance of the optical axis from the heap's middle, in heap radii.
    """

    piles: Annotated[int, Range(1, 10_000, "a count")] = 200
    mixed_share: Share = 0.5
    bin_share: Share = 0.5
    room: Annotated[Pair, Span(0.1, 10.0, "factor")] = (1.0, 2.2)
    wall_height: Annotated[Pair, Span(0.05, 5.0, "diameters of the largest target")] = (0.3, 1.0)
    aside: Share = 0.4

    def number(self, index: int) -> int:
        """Return the heap's index for an image's index; blocks of 10,000 images share no heap."""
        return index // 10_000 * self.piles + index % self.piles


@dataclass(frozen=True)
class Table(Checked):
    """A supporting plane in front of a robot's camera.

    Attributes:
        distance: Distance from the camera to the plane along the optical axis, metres.
        elevation_deg: Angle between the plane and the optical axis; 90 looks straight down.
        roll_deg: Largest rotation of the camera about its optical axis to either side.
        tilted_share: Probability that an object leans by ``tilt_deg`` instead of resting on a face.
        tilt_deg: Angle by which leaning objects are tilted.
        heaped: Whether objects are lowered onto a heap instead of lying side by side.
        heap_radius: Radius within which a heap's objects are lowered, diameters of the largest
            target.
        pile: Heaps dropped in a physics simulation, instead of single objects; None for no physics.
        picture_width: Width on the plane that one background image covers, camera distances;
            outside, the image is mirrored.
    """

    distance: Annotated[Pair, Span(0.02, 100.0, "metres")] = (0.25, 0.60)
    elevation_deg: Annotated[Pair, Span(10.0, 90.0, "degrees")] = (30.0, 85.0)
    roll_deg: Angle = 20.0
    tilted_share: Share = 0.2
    tilt_deg: Annotated[Pair, Span(0.0, 90.0, "degrees")] = (5.0, 30.0)
    heaped: bool = False
    heap_radius: Annotated[Pair, Span(0.0, 10.0, "diameters of the largest target")] = (0.3, 0.8)
    pile: Pile | None = None
    picture_width: Annotated[Pair, Span(0.1, 20.0, "camera distances")] = (1.2, 2.4)

    def draw_view(self, rng: Generator) -> Transform:
        """Sample T_cam_table: the table's origin lies on the optical axis, its z points up."""
        distance = rng.uniform(*self.distance)
        elevation = np.radians(rng.uniform(*self.elevation_deg))
        roll = np.radians(rng.uniform(-self.roll_deg, self.roll_deg))
        rolled = rotation_vector_to_matrix(np.array([0.0, 0.0, roll]))
        rotation = rolled @ looking_down(elevation)
        return make_transform(rotation, np.array([0.0, 0.0, distance]))

    def draw_turning(self, rng: Generator, hull: Hull) -> tuple[Float[np.ndarray, "3 3"], float]:
        """Sample an object's orientation: resting on a stable face of ``hull``, or leaning.

        Returns:
            Rotation from the object to the table frame, and the height of the object's lowest point
            relative to its origin, metres.
        """
        normals, shares = hull.rests
        down = normals[int(np.searchsorted(np.cumsum(shares)[:-1], rng.random(), side="right"))]
        turn, is_tilted = rng.uniform(0, 2 * np.pi), rng.random() < self.tilted_share
        azimuth, tilt = rng.uniform(0, 2 * np.pi), np.radians(rng.uniform(*self.tilt_deg))
        right, across, up = rotation_to_z(down)
        level = np.stack([right, -across, -up])
        rotation = rotation_vector_to_matrix(np.array([0.0, 0.0, turn])) @ level
        if is_tilted:
            axis = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
            rotation = rotation_vector_to_matrix(tilt * axis) @ rotation
        return np.asarray(rotation), float((hull.vertices @ rotation[2]).min())

    def draw_image(
        self,
        rng: Generator,
        backgrounds: Backgrounds,
        K: CameraMatrix,
        size: Size,
        T_cam_table: Transform,
    ) -> TableImage:
        """Sample the plane's image and, if the plane's end is in view, the image beyond the end."""
        width, height = size
        image = backgrounds.draw(rng, width, height)
        metres = rng.uniform(*self.picture_width) * T_cam_table[2, 3]
        middle = rng.uniform(0.35, 0.65, 2) * size  # pixel at the table's origin
        angle, scale = rng.uniform(0, 2 * np.pi), width / metres
        cosine, sine = scale * np.cos(angle), scale * np.sin(angle)
        image_table = np.array([[cosine, -sine, middle[0]], [sine, cosine, middle[1]], [0, 0, 1]])
        end = 8 * float(T_cam_table[2, 3])
        in_view = _beyond(end, K, size, T_cam_table) is not None
        surroundings = backgrounds.draw(rng, width, height) if in_view else None
        return TableImage(image, image_table, end, surroundings)


@dataclass(frozen=True, eq=False)
class TableImage:
    """The image on the plane, and the surroundings beyond the plane's end."""

    image: RGBImage
    # Homography from (x, y) in the table frame, metres, to the image's pixels.
    image_table: Float[np.ndarray, "3 3"]
    end: float  # Depth at which the plane ends, metres
    surroundings: RGBImage | None  # Camera image beyond the end; None if the end is out of view

    def project(self, K: CameraMatrix, size: Size, T_cam_table: Transform) -> RGBImage:
        """Return the camera image of the empty plane."""
        # A point (x, y, 0) of the plane projects to K [r1 r2 t] (x, y, 1).
        image_camera = self.image_table @ np.linalg.inv(K @ T_cam_table[:3, [0, 1, 3]])
        flags, border = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP, cv2.BORDER_REFLECT_101
        image = cv2.warpPerspective(self.image, image_camera, size, flags=flags, borderMode=border)
        beyond = _beyond(self.end, K, size, T_cam_table)
        if beyond is None or self.surroundings is None:
            return np.asarray(image)
        return np.where(beyond[..., None], self.surroundings, image)


def plane_of(T_cam_table: Transform) -> Plane:
    """Return the plane z = 0 of the table's frame, in the camera frame."""
    return Plane(triple(T_cam_table[:3, 2]), float(T_cam_table[:3, 2] @ T_cam_table[:3, 3]))


def _beyond(end: float, K: CameraMatrix, size: Size, T_cam_table: Transform) -> Mask | None:
    """Return the mask of pixels where the plane is deeper than ``end`` metres; None if empty."""
    width, height = size
    slope = plane_of(T_cam_table).inverse_depth_row(K)
    across, down = slope[0] * np.arange(width), slope[1] * np.arange(height) + slope[2]
    if across.min() + down.min() >= 1 / end:
        return None
    return np.asarray(across + down[:, None] < 1 / end)
