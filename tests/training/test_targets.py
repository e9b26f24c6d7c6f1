from dataclasses import replace

import pytest
import torch

from dopepp.data.batch import PADDING, Batch
from dopepp.maps.codec import MapGeometry
from dopepp.training.targets import Targets, draw_maps


def draw(batch: Batch, num_objects: int = 1) -> Targets:
    return draw_maps(batch, batch.keypoints, num_objects, MapGeometry(8))


def test_a_peak_per_keypoint_in_the_cell_that_holds_it(batch):
    belief, field = draw(batch)
    assert belief.shape == (2, 9, 16, 16)
    assert field.shape == (2, 16, 16, 16)
    inside = ((batch.keypoints[:, 0] >= 0) & (batch.keypoints[:, 0] <= 127)).all(-1)
    assert (belief.amax((2, 3))[inside] > 0.7).all()
    cell = (batch.keypoints[:, 0] + 0.5).div(8, rounding_mode="floor")
    expected = cell[..., 1] * 16 + cell[..., 0]
    assert torch.equal(belief.flatten(2).argmax(2)[inside], expected[inside].long())


@pytest.mark.parametrize(
    ("visible", "index", "drawn"),
    [((0.0999, 0.1001), (0, 0), [False, True]), ((1.0, 1.0), (0, PADDING), [True, False])],
)
def test_hardly_visible_instances_and_padding_leave_empty_channels(visible, index, drawn, batch):
    changed = replace(
        batch,
        visible_fraction=torch.tensor(visible)[:, None],
        object_index=torch.tensor(index)[:, None],
    )
    for maps in draw(changed):
        assert maps.flatten(1).any(dim=1).tolist() == drawn


def test_an_instance_fills_its_own_objects_channels_only(batch):
    belief, field = draw(replace(batch, object_index=torch.tensor([[0], [1]])), num_objects=2)
    filled = [maps.unflatten(1, (2, -1)).flatten(2).any(dim=2).tolist() for maps in (belief, field)]
    assert filled == [[[True, False], [False, True]]] * 2
