"""Ranking of matches by edges and colours of the image.

Each match first moves to the nearby pose with the largest mean edge response. Because views are 8
degrees apart, the views of the best matches are then replaced by neighbouring views that have a
larger response.

Edges alone do not distinguish the part from busy texture, but colours do: the colours inside the
part are uniform, and differ from the colours around it. A linear model of :data:`FEATURES` ranks
the matches. Its weights were learned from procedural parts (``benchmarks/learn_ranking.py``) and
are in ``ranking.json``.

The compiled functions share the names of their arrays: ``maps`` are edge responses by orientation,
row and column; ``points`` (diameters) and ``normals`` (radians) are the edge points of a view or of
all views; ``poses`` has column, row, in-plane rotation and projected diameter of each match.
"""

from __future__ import annotations

import json
import math
from functools import cache
from importlib.resources import files
from typing import Any, Final, NamedTuple

import numpy as np
from jaxtyping import Float

from dopepp.core.compiled import Array, compiled
from dopepp.drawing.pictures import RGBImage
from dopepp.inference.templates.matching import Matches
from dopepp.inference.templates.responses import BINS, Responses
from dopepp.inference.templates.views import Templates

FEATURES: Final = (
    "place",  # score of the match on the coarse image, standard deviations
    "edges",  # score of the moved match, standard deviations
    "response",  # mean response of the template's points at this position
    "supported",  # share of points with a response above SUPPORT
    "texture",  # mean of the strongest response at inner points
    "evenness",  # logarithm of the variance of the colours inside; low for uniform colours
    "contrast",  # difference of the colours on both sides of the outline, in [0, 1]
    "separation",  # difference between the colours outside and the mean colour inside, in [0, 1]
    "shown",  # share of the template's points that lie on the image
    "extent",  # length of the view, diameters
)
"""Features of a match, in this order."""

SUPPORT: Final = 30  # response above which a point counts as supported
LEVEL: Final = 16.0  # difference of colours, grey levels, at which the contrast is 0.5
EVEN: Final = 64.0  # added to the variance of colours, so that noise counts as uniform
MIN_INNER: Final = 8  # smallest number of inner points on the image for features of a match
ACROSS: Final = (2.5, 0.03)  # pixels and diameters between the outline and the compared colours
ROLL_STEP: Final = math.radians(5.0)  # step of the in-plane rotation on the grid
GROWTH: Final = 0.03  # first relative step of the size
FEW: Final = 32  # number of a template's points compared on the grid: its first, far apart
REACH_PX: Final = 1.5  # first step of the position after a change of view
MAX_CHANGES: Final = 4  # largest number of changes of a match's view

Features = Float[np.ndarray, "matches features"]


class RankingModel(NamedTuple):
    """Learned model that ranks matches, and learned score of the poses refined from them."""

    weights: Float[np.ndarray, "features"]  # weight of each of FEATURES
    bias: float  # weighted sum + bias: log odds that the best match of an image is correct
    score: dict[str, float]  # RecoveryOptions that score the refined poses


@cache
def learned_ranking() -> RankingModel:
    """Return the model that ships with the package.

    Raises:
        ValueError: The model was fitted to other features than ``FEATURES``.
    """
    path = files("dopepp.inference.templates").joinpath("ranking.json")
    values: dict[str, Any] = json.loads(path.read_text("utf-8"))
    if tuple(values["weights"]) != FEATURES:
        raise ValueError(f"{path} was fitted to other features: run {values['command']}")
    return RankingModel(np.array(list(values["weights"].values())), values["bias"], values["score"])


def move_nearby(
    matches: Matches, templates: Templates, responses: Responses, image: RGBImage, reach: float
) -> tuple[Matches, Features]:
    """Move matches to nearby poses with the largest mean edge response.

    Args:
        matches: Matches in pixels of the image.
        templates: Templates of the part.
        responses: Responses of the image.
        image: RGB.
        reach: Distance from the match to the border of the searched grid, pixels.

    Returns:
        Moved matches, and their features.
    """
    poses, best = matches.poses.copy(), np.empty(len(matches.poses))
    _search(responses, templates.points, templates.normals, matches.views, poses, reach, best)
    matches = matches._replace(poses=poses)
    return matches, _features(matches, best, templates, responses, image)


def improve_views(
    matches: Matches, templates: Templates, responses: Responses, image: RGBImage
) -> tuple[Matches, Features]:
    """Replace the views of matches by neighbouring views with a larger mean edge response.

    Arguments and results are as in :func:`move_nearby`.
    """
    views, poses, best = matches.views.copy(), matches.poses.copy(), np.empty(len(matches.poses))
    lines = templates.points, templates.normals
    _improve_views(responses, *lines, templates.neighbours, templates.twists, views, poses, best)
    matches = matches._replace(views=views, poses=poses)
    return matches, _features(matches, best, templates, responses, image)


def _features(
    matches: Matches,
    best: Float[np.ndarray, "matches"],
    templates: Templates,
    responses: Responses,
    image: RGBImage,
) -> Features:
    """Return the features of matches; ``best`` are the mean responses of their points."""
    features = np.zeros((len(best), len(FEATURES)))
    lines = templates.points, templates.normals, templates.is_outline, templates.inner
    _describe(responses, image, *lines, matches.views, matches.poses, features)
    features[:, 0] = matches.scores
    features[:, 1] = (best - matches.means) / matches.deviations
    features[:, 2], features[:, 9] = best, templates.extents[matches.views]
    return features


@compiled(fastmath=True)
def _place(
    points: Array, normals: Array, roll: float, scale: float, offsets: Array, bins: Array
) -> None:
    """Rotate and scale a template: write the offsets of its points and their orientations.

    ``offsets`` (2, points) are relative to the template's centre, pixels.
    """
    c, s = scale * math.cos(roll), scale * math.sin(roll)
    for p in range(len(bins)):
        offsets[0, p] = c * points[p, 0] - s * points[p, 1]
        offsets[1, p] = s * points[p, 0] + c * points[p, 1]
        # Angles are above −4π, and the remainder must not be negative.
        bins[p] = int((normals[p] + roll) * BINS / math.pi + 8 * BINS + 0.5) % BINS


@compiled(fastmath=True)
def _response(
    maps: Array, offsets: Array, bins: Array, u: float, v: float, indices: Array
) -> float:
    """Return the mean edge response at the points of a template with its centre at pixel (u, v).

    ``indices`` is a workspace of 32-bit integers, as maps have less than 2³¹ elements. A separate
    loop computes the indices, so that the compiler vectorises it.
    """
    height, width, total = np.int32(maps.shape[1]), np.int32(maps.shape[2]), 0
    flat = maps.reshape(-1)
    for p in range(len(bins)):
        x, y = np.int32(u + offsets[0, p] + 0.5), np.int32(v + offsets[1, p] + 0.5)
        inside = (x >= 0) & (x < width) & (y >= 0) & (y < height)
        indices[p] = (bins[p] * height + y) * width + x if inside else np.int32(-1)
    for p in range(len(bins)):
        if indices[p] >= 0:
            total += flat[indices[p]]
    return total / len(bins)


@compiled()
def _workspace(count: int) -> tuple[Array, Array, Array]:
    """Return arrays for two placements of a template with ``count`` points.

    Returns:
        ``offsets`` and ``bins`` of :func:`_place` for both, and ``indices`` of :func:`_response`.
    """
    return np.empty((2, 2, count)), np.empty((2, count), np.int32), np.empty(count, np.int32)


@compiled(fastmath=True)
def _climb(
    maps: Array,
    points: Array,
    normals: Array,
    pose: Array,
    reach: float,
    rounds: int,
    workspace: tuple[Array, Array, Array],
) -> float:
    """Maximise the response over the four numbers of a pose, changing one number at a time.

    Args:
        maps: Responses.
        points: Points of the template.
        normals: Direction of each point's normal.
        pose: Pose, updated in place.
        reach: First step of the position, pixels.
        rounds: Number of rounds; each has smaller steps.
        workspace: Result of :func:`_workspace`.

    Returns:
        The highest response.
    """
    used, (offsets, bins, indices) = 0, workspace
    _place(points, normals, pose[2], pose[3], offsets[used], bins[used])
    most = _response(maps, offsets[used], bins[used], pose[0], pose[1], indices)
    steps = np.array([reach, reach, ROLL_STEP / 2, GROWTH * pose[3]])
    for _ in range(rounds):
        for axis in range(4):
            for sign in (-1.0, 1.0):
                pose[axis] += sign * steps[axis]
                trial = used
                if axis >= 2:  # the offsets depend on rotation and size only
                    trial = 1 - used
                    _place(points, normals, pose[2], pose[3], offsets[trial], bins[trial])
                value = _response(maps, offsets[trial], bins[trial], pose[0], pose[1], indices)
                if value > most:
                    most, used = value, trial
                else:
                    pose[axis] -= sign * steps[axis]
        steps *= 0.6
    return most


@compiled(fastmath=True)
def _search(
    maps: Array,
    points: Array,
    normals: Array,
    views: Array,
    poses: Array,
    reach: float,
    best: Array,
) -> None:
    """Move each match to the highest response nearby: first on a grid, then by :func:`_climb`.

    ``reach`` is half the side of the grid, pixels. ``poses`` is updated in place, and ``best`` is
    filled with the response of each match.
    """
    height, width = maps.shape[1], maps.shape[2]
    workspace = _workspace(points.shape[1])
    offsets, bins = workspace[0][0], workspace[1][0]
    columns, rows, sums = np.empty(5, np.int64), np.empty(5, np.int64), np.empty((5, 5), np.int64)
    for i in range(len(views)):
        edges, angles, scale = points[views[i]], normals[views[i]], poses[i, 3]
        u, v, roll, most = poses[i, 0], poses[i, 1], poses[i, 2], -FEW * 128 - 1
        for k in range(-1, 2):
            angle = roll + k * ROLL_STEP
            _place(edges, angles, angle, scale, offsets, bins[:FEW])
            sums[:] = 0
            for p in range(FEW):
                for n in range(5):
                    shift = (n - 2) * reach / 2
                    columns[n] = int(u + shift + offsets[0, p] + 0.5)
                    rows[n] = int(v + shift + offsets[1, p] + 0.5)
                for n in range(5):
                    for m in range(5):
                        x, y = columns[n], rows[m]
                        if 0 <= x < width and 0 <= y < height:
                            sums[n, m] += maps[bins[p], y, x]
            for n in range(5):
                for m in range(5):
                    if sums[n, m] > most:
                        most, poses[i, 2] = sums[n, m], angle
                        poses[i, 0], poses[i, 1] = u + (n - 2) * reach / 2, v + (m - 2) * reach / 2
        best[i] = _climb(maps, edges, angles, poses[i], reach / 4, 3, workspace)


@compiled(fastmath=True)
def _improve_views(
    maps: Array,
    points: Array,
    normals: Array,
    neighbours: Array,
    twists: Array,
    views: Array,
    poses: Array,
    responses: Array,
) -> None:
    """Replace the view of each match by the neighbour with the largest response, repeatedly.

    ``views`` and ``poses`` are updated in place, and ``responses`` is filled with the response of
    each match.
    """
    pose, best = np.empty(4), np.empty(4)
    workspace = _workspace(points.shape[1])
    for i in range(len(views)):
        best[:] = poses[i]
        most = _climb(maps, points[views[i]], normals[views[i]], best, REACH_PX, 2, workspace)
        for _ in range(MAX_CHANGES):
            view, chosen = views[i], views[i]
            poses[i] = best
            for k in range(neighbours.shape[1]):
                other = neighbours[view, k]
                pose[:] = poses[i]
                pose[2] += twists[view, k]
                value = _climb(maps, points[other], normals[other], pose, REACH_PX, 2, workspace)
                if value > most:
                    most, chosen = value, other
                    best[:] = pose
            if chosen == view:
                break
            views[i] = chosen
        poses[i], responses[i] = best, most


@compiled(fastmath=True)
def _describe(
    maps: Array,
    image: Array,
    points: Array,
    normals: Array,
    is_outline: Array,
    inner: Array,
    views: Array,
    poses: Array,
    features: Array,
) -> None:
    """Write to ``features`` each match's image features, except the mean response."""
    height, width = maps.shape[1], maps.shape[2]
    mean, colours = np.zeros(3), np.zeros((inner.shape[1], 3))
    for i in range(len(views)):
        view, u, v, roll, scale = views[i], poses[i, 0], poses[i, 1], poses[i, 2], poses[i, 3]
        c, s = scale * math.cos(roll), scale * math.sin(roll)
        count, texture = 0, 0.0
        mean[:] = 0.0
        for p in range(inner.shape[1]):
            x = int(u + c * inner[view, p, 0] - s * inner[view, p, 1] + 0.5)
            y = int(v + s * inner[view, p, 0] + c * inner[view, p, 1] + 0.5)
            if not (0 <= x < width and 0 <= y < height):
                continue
            strongest = maps[0, y, x]
            for b in range(1, BINS):
                strongest = max(strongest, maps[b, y, x])
            texture += strongest
            for k in range(3):
                colours[count, k] = image[y, x, k]
                mean[k] += colours[count, k]
            count += 1
        if count < MIN_INNER:
            continue
        variance = EVEN
        for k in range(3):
            mean[k] /= count
            for p in range(count):
                variance += (colours[p, k] - mean[k]) ** 2 / count
        contrast, separation, compared, supported, shown = 0.0, 0.0, 0, 0, 0
        across = max(ACROSS[0], ACROSS[1] * scale)
        for p in range(points.shape[1]):
            x = u + c * points[view, p, 0] - s * points[view, p, 1]
            y = v + s * points[view, p, 0] + c * points[view, p, 1]
            if not (0 <= x < width and 0 <= y < height):
                continue
            angle = normals[view, p] + roll
            b = int(angle * BINS / math.pi + 8 * BINS + 0.5) % BINS
            supported += maps[b, int(y), int(x)] > SUPPORT
            shown += 1
            if not is_outline[view, p]:
                continue
            dx, dy = across * math.cos(angle), across * math.sin(angle)
            left, top, right, low = int(x - dx), int(y - dy), int(x + dx), int(y + dy)
            if (
                min(left, top, right, low) < 0
                or max(left, right) >= width
                or max(top, low) >= height
            ):
                continue
            most, away = 0.0, 0.0
            for k in range(3):
                beyond = float(image[low, right, k])
                most = max(most, abs(beyond - image[top, left, k]))
                away += (beyond - mean[k]) ** 2
            contrast += most / (most + LEVEL)
            separation += away / (away + 2 * variance)
            compared += 1
        features[i, 3], features[i, 4] = supported / max(shown, 1), texture / count
        features[i, 5] = math.log(variance)
        features[i, 6] = contrast / max(compared, 1)
        features[i, 7] = separation / max(compared, 1)
        features[i, 8] = shown / points.shape[1]
