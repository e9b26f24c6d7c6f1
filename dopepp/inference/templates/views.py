"""Templates of a part: the edges that a camera sees from many directions.

A template is drawn once for each direction of view. Its points are rotated, scaled and shifted for
in-plane rotations, distances and positions on the image.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final, NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int

from dopepp.core.compiled import Array, compiled
from dopepp.geometry.camera import CameraMatrix, camera_matrix, make_transform
from dopepp.geometry.rotation import RotationMatrix
from dopepp.inference.refinement.creases import SharpEdges
from dopepp.inference.refinement.outline import OutlineMesh, find_contour, posed

NUM_VIEWS: Final = 600  # directions on the sphere, about 8 degrees apart
NUM_POINTS: Final = 64  # number of points on the edges of a view
NUM_NEIGHBOURS: Final = 6  # number of neighbours of each view
NUM_INNER: Final = 48  # number of points inside a view, far from its edges

DRAWN_PX: Final = 96  # diameter of the part on the drawing of a view
MARGIN_PX: Final = 4  # margin of the drawing
SPACING_PX: Final = 1.5  # distance between the edge points that a template's points are chosen from
INNER_PX: Final = 4.0  # distance of inner points from edges; smaller in narrow views
MAX_INNER: Final = 400  # largest number of pixels from which inner points are chosen
SLACK: Final = 0.02  # overlap of the regions that symmetries map to each other, cosine
NEAREST: Final = 1.1  # smallest distance from which a part is drawn, diameters

Rotations = Float[np.ndarray, "views 3 3"]


class Templates(NamedTuple):
    """Points of all views, relative to the projection of the part's centre.

    The unit of length is the diameter, projected at the depth of the centre.
    """

    rotations: Rotations  # object to camera
    points: Float[np.ndarray, "views points 2"]  # on the outline and on visible creases
    normals: Float[np.ndarray, "views points"]  # direction of the normal, radians; outwards
    is_outline: Bool[np.ndarray, "views points"]  # False for points on creases
    inner: Float[np.ndarray, "views inner 2"]  # inside the outline
    extents: Float[np.ndarray, "views"]  # longer side of the bounding box
    neighbours: Int[np.ndarray, "views neighbours"]  # views from the nearest directions
    # In-plane rotation that aligns each neighbour with the view, radians
    twists: Float[np.ndarray, "views neighbours"]


def view_rotations(
    tilt_deg: float, group: Float[np.ndarray, "symmetries 3 3"] | None = None
) -> Rotations:
    """Return object-to-camera rotations for evenly spread directions of view.

    Args:
        tilt_deg: Largest angle between the part's z axis and the direction to the camera, degrees.
        group: Rotations that leave the part unchanged. Of directions that a rotation maps to each
            other, only the first is used.
    """
    number = np.arange(NUM_VIEWS) + 0.5
    z = 1 - 2 * number / NUM_VIEWS
    radius, angle = np.sqrt(1 - z * z), number * math.pi * (3 - math.sqrt(5))
    directions = np.column_stack([radius * np.cos(angle), radius * np.sin(angle), z])
    lowest = math.cos(math.radians(tilt_deg))
    directions = directions[z >= min(lowest, float(z.max())) - 1e-9]
    if group is not None:
        # Of each orbit, the direction nearest to a reference in general position is kept.
        reference = np.array([0.36, 0.48, 0.8])
        nearness = (directions @ (group @ reference).T).max(axis=1)
        directions = directions[directions @ reference >= nearness - SLACK]
    upright = np.where(np.abs(directions[:, 2:]) < 0.9, [[0.0, 0.0, 1.0]], [[1.0, 0.0, 0.0]])
    right = np.cross(upright, directions)
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    return np.stack([right, np.cross(-directions, right), -directions], axis=1)


def make_templates(
    mesh: OutlineMesh,
    centre: Float[np.ndarray, "3"],
    diameter: float,
    distance: float,
    rotations: Rotations,
) -> Templates:
    """Draw the part from every direction of view and choose points of each drawing.

    Args:
        mesh: Mesh of the part.
        centre: Point that the camera looks at, object frame, metres.
        diameter: Diameter of the part, metres.
        distance: Typical depth of the centre, metres.
        rotations: Object-to-camera rotations.
    """
    edges, distance = SharpEdges(mesh), max(distance, NEAREST * diameter)
    focal = DRAWN_PX * distance / diameter
    half = math.ceil(0.5 * DRAWN_PX / (1 - 0.5 * diameter / distance)) + MARGIN_PX
    K, size = camera_matrix(focal, focal, half, half), (2 * half, 2 * half)
    lines, inner = [], []
    for R in rotations:
        line, inside = _drawn(edges, centre, distance, R, K, size)
        lines.append(_spread(line, NUM_POINTS))
        inner.append(_spread(inside, NUM_INNER))
    rows = np.stack(lines)
    points = (rows[..., :2] - half) / DRAWN_PX
    return Templates(
        rotations,
        points,
        np.arctan2(rows[..., 3], rows[..., 2]),
        rows[..., 4] > 0,
        (np.stack(inner) - half) / DRAWN_PX,
        np.ptp(points, axis=1).max(axis=1),
        *_neighbours(rotations),
    )


def concatenate_templates(groups: Sequence[Templates]) -> Templates:
    """Concatenate groups of templates with equal numbers of views."""
    templates = Templates(*map(np.concatenate, zip(*groups, strict=True)))
    first = np.repeat(np.arange(len(groups)) * len(groups[0].points), len(groups[0].points))
    return templates._replace(neighbours=templates.neighbours + first[:, None])


def _neighbours(
    rotations: Rotations,
) -> tuple[Int[np.ndarray, "views neighbours"], Float[np.ndarray, "views neighbours"]]:
    """Return ``neighbours`` and ``twists`` of :class:`Templates`."""
    directions = rotations[:, 2]
    count = min(NUM_NEIGHBOURS, len(rotations) - 1)
    nearest = np.argsort(-directions @ directions.T, axis=1)[:, 1 : count + 1]
    between = np.einsum("nij,nkmj->nkim", rotations, rotations[nearest])
    sines = between[..., 1, 0] - between[..., 0, 1]
    return nearest, np.arctan2(sines, between[..., 0, 0] + between[..., 1, 1])


def _drawn(
    edges: SharpEdges,
    centre: Float[np.ndarray, "3"],
    distance: float,
    R: RotationMatrix,
    K: CameraMatrix,
    size: tuple[int, int],
) -> tuple[Float[np.ndarray, "points 5"], Float[np.ndarray, "inner 2"]]:
    """Draw a part from one direction, with its centre on the optical axis.

    Returns:
        Pixel, normal and kind (1: outline, 0: crease) of edge points; and pixels inside the
        outline, far from edges.
    """
    T_cam_obj = make_transform(R, np.array([0.0, 0.0, distance]) - R @ centre)
    posed_mesh = posed(edges.mesh, T_cam_obj, K)
    assert posed_mesh is not None  # the whole part is in front of the camera
    ids = edges.drawn(posed_mesh, size)
    mask = (ids >= 0).astype(np.uint8)
    contour = find_contour(edges.mesh, posed_mesh, mask, SPACING_PX)
    creases = edges.visible(posed_mesh, ids, SPACING_PX)
    outline = np.column_stack([contour.pixels, contour.normals, np.ones(len(contour))])
    lines = np.concatenate([outline, np.column_stack([creases, np.zeros(len(creases))])])
    columns, rows = np.rint(lines[:, :2]).astype(int).clip(0, np.array(size) - 1).T
    mask[rows, columns] = 0
    depth = cv2.distanceTransform(mask, cv2.DIST_L2, 3)
    v, u = np.nonzero(depth >= min(INNER_PX, 0.6 * float(depth.max())))
    chosen = np.linspace(0, len(u) - 1, min(len(u), MAX_INNER)).astype(int)
    return lines, np.column_stack([u[chosen], v[chosen]]).astype(np.float64)


def _spread(
    points: Float[np.ndarray, "points columns"], count: int
) -> Float[np.ndarray, "count columns"]:
    """Choose ``count`` points that are far from each other, with repetitions if there are fewer."""
    chosen = np.empty(count, np.int64)
    _farthest(points, chosen)
    return points[chosen]


@compiled()
def _farthest(points: Array, chosen: Array) -> None:
    """Write to ``chosen`` indices of points, each the farthest from all points before it."""
    distance, farthest = np.full(len(points), np.inf), 0
    for i in range(len(chosen)):
        if i >= len(points):
            chosen[i] = chosen[i - len(points)]
            continue
        chosen[i] = farthest
        x, y, best = points[farthest, 0], points[farthest, 1], -1.0
        for k in range(len(points)):
            dx, dy = points[k, 0] - x, points[k, 1] - y
            distance[k] = min(distance[k], dx * dx + dy * dy)
            if distance[k] > best:
                best, farthest = distance[k], k
