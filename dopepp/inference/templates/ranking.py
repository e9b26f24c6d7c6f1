"""Ranking of matches by edges and colours of the image.

Each match first moves to the nearby pose with the largest mean edge response. Because views are 8
degrees apart, the views of the best matches are then replaced by neighbouring views that have a
larger response.

Edges alone do not distinguish the part from busy texture, but colours do: the colours inside the
part are uniform, and differ from the colours around it. A linear model of :data:`FEATURES` ranks
the matches. Its weights were learned from procedural parts (``benchmarks/learn_ranking.py``) and
are in ``ranking.json``.
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
from dopepp.inference.templates.local_search import replace_views, search_nearby
from dopepp.inference.templates.matching import Matches
from dopepp.inference.templates.responses import BINS, Responses, orientation_bin
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
    search_nearby(responses, templates, matches.views, poses, reach, best)
    matches = matches._replace(poses=poses)
    return matches, _features(matches, best, templates, responses, image)


def improve_views(
    matches: Matches, templates: Templates, responses: Responses, image: RGBImage
) -> tuple[Matches, Features]:
    """Replace the views of matches by neighbouring views with a larger mean edge response.

    Arguments and results are as in :func:`move_nearby`.
    """
    views, poses, best = matches.views.copy(), matches.poses.copy(), np.empty(len(matches.poses))
    replace_views(responses, templates, views, poses, best)
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
    _describe(responses, image, templates, matches, features)
    features[:, 0] = matches.scores
    features[:, 1] = (best - matches.means) / matches.deviations
    features[:, 2], features[:, 9] = best, templates.extents[matches.views]
    return features


@compiled(fastmath=True)
def _describe(
    maps: Array, image: Array, templates: Templates, matches: Matches, features: Array
) -> None:
    """Write to ``features`` each match's image features, except the mean response."""
    points, normals = templates.points, templates.normals
    is_outline, inner = templates.is_outline, templates.inner
    views, poses = matches.views, matches.poses
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
            supported += maps[orientation_bin(angle), int(y), int(x)] > SUPPORT
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
