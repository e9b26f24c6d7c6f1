import math

import numpy as np
import torch
from torch.testing import assert_close

from dopepp.maps import MapGeometry, encode

GEOMETRY = MapGeometry(stride=8, sigma=1.3, field_radius=2.5)


def by_hand(keypoints, objects, count, size):
    """Compute the maps cell by cell from their definition."""
    (height, width), g = size, GEOMETRY
    beliefs = np.zeros((len(keypoints), 9 * count, height, width))
    fields = np.zeros((len(keypoints), 16 * count, height, width))
    for b, i, j in np.ndindex(len(keypoints), height, width):
        cell = np.array([g.stride * j, g.stride * i]) + (g.stride - 1) / 2
        nearest = {}
        for c, points in zip(objects[b], keypoints[b], strict=True):
            if c < 0:
                continue
            for k in range(9):
                border = np.array([width, height]) * g.stride - 0.5
                if not ((points[k] > -0.5) & (points[k] < border)).all():
                    continue
                distance = math.dist(cell, points[k]) / g.stride
                value = math.exp(-(distance**2) / (2 * g.sigma**2))
                beliefs[b, 9 * c + k, i, j] = max(beliefs[b, 9 * c + k, i, j], value)
                channel = 16 * c + 2 * k
                closest = min(g.field_radius, nearest.get(channel, np.inf))
                if k < 8 and distance <= closest and np.isfinite(points[8]).all():
                    nearest[channel] = distance
                    vector = points[8] - points[k]
                    fields[b, channel : channel + 2, i, j] = vector / np.linalg.norm(vector)
    return beliefs, fields


def test_maps_agree_with_their_definition():
    """Several images, objects and instances, padding, absent and off-map keypoints."""
    rng = np.random.default_rng(0)
    keypoints = rng.uniform(-30, 150, (3, 4, 9, 2))
    # Discs overlap, and each corner has another direction, so the vector identifies its corner.
    keypoints[0, 1] = keypoints[0, 0] + rng.uniform(-12, 12, (9, 2))
    keypoints[0, 2, 8] = keypoints[1, 0, 3] = np.nan
    keypoints[1, 1, 8] = (900.0, -700.0)
    keypoints[1, 2] = (-500.0, 40.0)  # a whole instance beside the map
    # Absent keypoints, then keypoints beside and on the border of the map.
    keypoints[2, 2, :5] = [[np.nan, 40], [np.inf, 40], [-0.6, 40], [40, 88], [1e30, 0]]
    keypoints[2, 2, 5:7] = [[-0.4, 40], [40, 87.4]]
    objects = np.array([[0, 0, 1, -1], [1, 1, 1, 0], [-1, -1, 0, 1]])
    expected = by_hand(keypoints, objects, 2, (11, 15))
    result = encode(torch.tensor(keypoints), torch.tensor(objects), 2, (11, 15), GEOMETRY)
    for ours, theirs in zip(result, expected, strict=True):
        assert ours.dtype == torch.float32
        assert_close(ours, torch.tensor(theirs).float(), atol=2e-5, rtol=0)


def test_maps_without_an_instance_are_zero():
    none = torch.zeros(2, 0, 9, 2), torch.zeros(2, 0, dtype=torch.long)
    belief, field = encode(*none, 2, (12, 10), GEOMETRY)
    assert torch.equal(belief, torch.zeros(2, 18, 12, 10))
    assert torch.equal(field, torch.zeros(2, 32, 12, 10))


def test_a_corner_on_its_centroid_has_no_direction():
    """The centre of cell (i, j) is pixel (8j + 3.5, 8i + 3.5)."""
    keypoints = torch.tensor([43.5, 19.5]).expand(1, 1, 9, 2)
    belief, field = encode(keypoints, torch.zeros(1, 1, dtype=torch.long), 1, (6, 9), GEOMETRY)
    assert (belief[0, :, 2, 5] == 1).all()
    assert not field.any()
