"""Agreement of an image with a part drawn at a pose: a check that needs no labels.

The part's outline and creases are drawn at the pose. Across each contour pixel, the image gradient
along the contour's normal is sampled from inside to outside. At a correct pose the strongest edge
lies at the contour; otherwise it may lie anywhere. Each profile is compared with its own maximum,
so strong and weak contrasts count equally.
"""

from __future__ import annotations

from typing import Final

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int

from dopepp.drawing.pictures import Mask, RGBImage, Size
from dopepp.geometry.camera import CameraMatrix, Transform, transform
from dopepp.virtual.renderers.raster.visibility import draw_alone, project_object
from dopepp.virtual.scene import NEAR, SceneObject
from dopepp.virtual.surface import Surface

MAX_POINTS: Final = 1500  # largest number of evaluated contour pixels
FLOOR: Final = 2.0  # gradient of noise, grey levels per pixel


def agreement(image: RGBImage, K: CameraMatrix, T_cam_obj: Transform, surface: Surface) -> float:
    """Return how well an image's edges lie on a part's outline and creases, in [0, 1].

    It is the mean ratio of the gradient at a contour pixel to the largest along its normal. A part
    that is not in front of the camera, or has no contour within the image, has agreement 0.
    """
    if transform(T_cam_obj, surface.hull)[:, 2].min() <= NEAR:
        return 0.0
    contour, extent = _contour(SceneObject(surface, T_cam_obj), K, image.shape[1::-1])
    if not len(contour):
        return 0.0
    reach = max(6, round(0.2 * extent))  # pixels to each side of the contour
    profiles = _profiles(image, contour, reach)
    offsets = np.arange(-reach, reach + 1)
    total = 0.0
    # Widths relative to the reach: the narrow kernel ranks good poses, the wide kernel bad poses.
    for width in (0.12, 0.4):
        kernel = np.exp(-0.5 * (offsets / (width * reach)) ** 2)
        shifted = cv2.filter2D(profiles, -1, kernel[None], borderType=cv2.BORDER_CONSTANT)
        best = shifted.max(axis=1) + FLOOR**2 * kernel.sum()
        total += float(np.mean(shifted[:, reach] / best))
    return total / 2


def _contour(
    item: SceneObject, K: CameraMatrix, size: Size
) -> tuple[Float[np.ndarray, "points 4"], float]:
    """Return (x, y, normal) of contour pixels and the longer side of the part's box, pixels."""
    projected = project_object(item, K)
    box = projected.box(size)
    if box is None:
        return np.empty((0, 4)), 0.0
    # A frame of one empty pixel, so that the outline is inside the canvas.
    left, top, right, bottom = box[0] - 1, box[1] - 1, box[2] + 1, box[3] + 1
    inverse_depth, ids = draw_alone(item, projected.hom, (left, top, right, bottom))
    borders = _borders(item, np.where(inverse_depth > 0, ids, -1))
    edges = np.logical_or(*borders)
    rows, columns = np.nonzero(edges)
    # The contour lies in the middle between a pixel and its neighbours.
    beside, below = 0.5 * borders[:, rows, columns] / borders[:, rows, columns].sum(axis=0)
    x, y = columns + left + beside, rows + top + below
    inside = (x > 0) & (y > 0) & (x < size[0] - 1) & (y < size[1] - 1)
    normals = _normals(edges)[rows, columns]
    points = np.column_stack([x, y, normals])[inside]
    points = points[:: -(-len(points) // MAX_POINTS) or 1]
    x0, y0, x1, y1 = projected.extent
    return points, max(x1 - x0, y1 - y0)


def _borders(
    item: SceneObject, ids: Int[np.ndarray, "height width"]
) -> Bool[np.ndarray, "2 height width"]:
    """Return whether a contour separates each pixel from its right, and from its lower neighbour.

    A contour is the outline, or a crease where the normal turns by over 26°.
    """
    a, b, c = transform(item.T_cam_obj, item.surface.vertices)[item.surface.faces].swapaxes(0, 1)
    normals = np.cross(b - a, c - a)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-20)
    drawn = normals[ids]
    drawn[ids < 0] = 0.0
    borders = np.zeros((2, *ids.shape), bool)
    for border, (first, second) in (
        (borders[0], (np.s_[:, :-1], np.s_[:, 1:])),
        (borders[1], (np.s_[:-1], np.s_[1:])),
    ):
        crease = (drawn[first] * drawn[second]).sum(axis=-1) < 0.9
        border[first] = crease & ((ids[first] >= 0) | (ids[second] >= 0))
    return borders


def _normals(edges: Mask) -> Float[np.ndarray, "height width 2"]:
    """Return unit normals of lines in a mask: the main axis of the blurred structure tensor."""
    soft = cv2.GaussianBlur(edges.astype(np.float32), (0, 0), 1.0)
    gx, gy = cv2.Sobel(soft, cv2.CV_32F, 1, 0), cv2.Sobel(soft, cv2.CV_32F, 0, 1)
    xx, xy, yy = (cv2.GaussianBlur(g, (0, 0), 2.0) for g in (gx * gx, gx * gy, gy * gy))
    angle = 0.5 * np.arctan2(2 * xy, xx - yy)
    return np.stack([np.cos(angle), np.sin(angle)], axis=-1)


def _profiles(
    image: RGBImage, contour: Float[np.ndarray, "points 4"], reach: int
) -> Float[np.ndarray, "points offsets"]:
    """Return squared gradients, (grey levels/pixel)², at −reach to reach pixels along normals."""
    # Blurred by a pixel against noise.
    soft = cv2.GaussianBlur(image, (0, 0), 1.0).astype(np.float32)
    # Scharr's filter weighs 16 on each side, two pixels apart.
    gx = cv2.Scharr(soft, cv2.CV_32F, 1, 0, scale=1 / 32)
    gy = cv2.Scharr(soft, cv2.CV_32F, 0, 1, scale=1 / 32)
    offsets = np.arange(-reach, reach + 1)
    x = (contour[:, 0, None] + offsets * contour[:, 2, None]).astype(np.float32)
    y = (contour[:, 1, None] + offsets * contour[:, 3, None]).astype(np.float32)
    along_x, along_y = (
        cv2.remap(g, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT) for g in (gx, gy)
    )
    along = along_x * contour[:, None, 2, None] + along_y * contour[:, None, 3, None]
    return np.asarray((along**2).sum(axis=-1), np.float64)
