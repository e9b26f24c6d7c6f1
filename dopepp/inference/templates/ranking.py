"""Ranking of matches: each is moved to the best place nearby, and judged by what the image shows.

Edges alone do not separate the part from busy texture. Colours do: the part is even inside, and its
surroundings differ from it. A linear model of the features below ranks the matches; it was learned
from procedural parts (``benchmarks/learn_ranking.py``), and its numbers are ``ranking.json``.
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
from dopepp.drawing.pictures import Picture
from dopepp.inference.templates.matching import Matches, Pose2d
from dopepp.inference.templates.responses import Responses
from dopepp.inference.templates.views import Templates

FEATURES: Final = (
    "place",  # score of the match on the coarse image, standard deviations
    "edges",  # score at the best place nearby, standard deviations
    "response",  # mean response of the template's points there
    "supported",  # share of points with a response above SUPPORT
    "texture",  # mean of the strongest response at inner points
    "evenness",  # logarithm of the variance of the colours inside
    "contrast",  # difference of the colours on both sides of the outline, in [0, 1]
    "separation",  # difference of the colours outside from those inside, in [0, 1]
    "shown",  # share of the template's points on the image
    "extent",  # length of the view, diameters
)
"""Features of a match, in this order."""

SUPPORT: Final = 30
LEVEL: Final = 16.0  # difference, grey levels, at which a contrast is 0.5
EVEN: Final = 64.0  # variance of colours that counts as even
LEAST_INNER: Final = 8  # inner points on the image without which a match is rejected
ACROSS: Final = (2.5, 0.03)  # pixels and diameters between the outline and the compared colours
TURN: Final = math.radians(5.0)
GROWTH: Final = 0.03  # of the diameter in a step of the search


class RankingModel(NamedTuple):
    """What was learned about matches, and about the poses that refinement makes of them."""

    weights: Float[np.ndarray, "features"]  # of FEATURES
    bias: float  # makes the weighted sum the log odds that a picture's best match is right
    score: dict[str, float]  # RecoveryOptions of refined poses


@cache
def learned_ranking() -> RankingModel:
    """Return the model in the package."""
    path = files("dopepp.inference.templates").joinpath("ranking.json")
    values: dict[str, Any] = json.loads(path.read_text("utf-8"))
    if tuple(values["weights"]) != FEATURES:
        raise ValueError(f"{path} was learned from other features: run {values['command']}")
    return RankingModel(np.array(list(values["weights"].values())), values["bias"], values["score"])


def describe(
    matches: Matches, templates: Templates, responses: Responses, image: Picture, reach: float
) -> tuple[Pose2d, Float[np.ndarray, "matches features"]]:
    """Move matches to the best place nearby; return their poses and :data:`FEATURES` there.

    Args:
        matches: Matches in pixels of the image.
        templates: Templates of the part.
        responses: Responses of the image.
        image: RGB.
        reach: Largest distance of the first step, pixels.
    """
    poses, features = matches.poses.copy(), np.zeros((len(matches.poses), len(FEATURES)))
    lines = templates.points, templates.normals
    best = np.empty(len(poses))
    _search(responses, *lines, matches.views, poses, reach, best)
    inside = templates.is_outline, templates.inner
    _describe(responses, image, *lines, *inside, matches.views, poses, features)
    features[:, 0] = matches.scores
    features[:, 1] = (best - matches.means) / matches.deviations
    features[:, 2], features[:, 9] = best, templates.extents[matches.views]
    return poses, features


@compiled(fastmath=True)
def _response(
    maps: Array, points: Array, normals: Array, u: float, v: float, turn: float, scale: float
) -> float:
    """Return the mean response of a template's points."""
    bins, height, width = maps.shape
    c, s, total = scale * math.cos(turn), scale * math.sin(turn), 0
    for p in range(len(points)):
        x = int(u + c * points[p, 0] - s * points[p, 1] + 0.5)
        y = int(v + s * points[p, 0] + c * points[p, 1] + 0.5)
        if 0 <= x < width and 0 <= y < height:
            # Angles are above −4π, and the remainder must not be negative.
            total += maps[int((normals[p] + turn) * bins / math.pi + 8 * bins + 0.5) % bins, y, x]
    return total / len(points)


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
    """Move each pose to the highest response: first on a grid, then along each axis."""
    for i in range(len(views)):
        edges, angles, scale = points[views[i]], normals[views[i]], poses[i, 3]
        u, v, turn, most = poses[i, 0], poses[i, 1], poses[i, 2], -1e9
        at_u, at_v, at_turn = u, v, turn
        for k in range(-1, 2):
            for across in range(-2, 3):
                for down in range(-2, 3):
                    x, y, angle = u + across * reach / 2, v + down * reach / 2, turn + k * TURN
                    value = _response(maps, edges, angles, x, y, angle, scale)
                    if value > most:
                        most, at_u, at_v, at_turn = value, x, y, angle
        u, v, turn, step = at_u, at_v, at_turn, 1.0
        for _ in range(3):
            for axis in range(4):
                for sign in (-1.0, 1.0):
                    x = u + (sign * step * reach / 4 if axis == 0 else 0.0)
                    y = v + (sign * step * reach / 4 if axis == 1 else 0.0)
                    angle = turn + (sign * step * TURN / 2 if axis == 2 else 0.0)
                    size = scale * (1.0 + (sign * step * GROWTH if axis == 3 else 0.0))
                    value = _response(maps, edges, angles, x, y, angle, size)
                    if value > most:
                        most, u, v, turn, scale = value, x, y, angle, size
            step *= 0.6
        poses[i, 0], poses[i, 1], poses[i, 2], poses[i, 3] = u, v, turn, scale
        best[i] = most


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
    """Write the features that depend on the image at each pose."""
    bins, height, width = maps.shape
    mean, colours = np.zeros(3), np.zeros((inner.shape[1], 3))
    for i in range(len(views)):
        view, u, v, turn, scale = views[i], poses[i, 0], poses[i, 1], poses[i, 2], poses[i, 3]
        c, s = scale * math.cos(turn), scale * math.sin(turn)
        count, texture = 0, 0.0
        mean[:] = 0.0
        for p in range(inner.shape[1]):
            x = int(u + c * inner[view, p, 0] - s * inner[view, p, 1] + 0.5)
            y = int(v + s * inner[view, p, 0] + c * inner[view, p, 1] + 0.5)
            if not (0 <= x < width and 0 <= y < height):
                continue
            strongest = maps[0, y, x]
            for b in range(1, bins):
                strongest = max(strongest, maps[b, y, x])
            texture += strongest
            for k in range(3):
                colours[count, k] = image[y, x, k]
                mean[k] += colours[count, k]
            count += 1
        if count < LEAST_INNER:
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
            angle = normals[view, p] + turn
            b = int(angle * bins / math.pi + 8 * bins + 0.5) % bins
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
