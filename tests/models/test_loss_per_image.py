from __future__ import annotations

import pytest
import torch

from dopepp.models.losses import MapMSE, SpatialCrossEntropy


@pytest.mark.parametrize("loss", [MapMSE(), SpatialCrossEntropy(1.0, field_weight=0.2)])
def test_losses_of_the_images_have_the_loss_as_their_mean(loss) -> None:
    generator = torch.Generator().manual_seed(3)
    belief, field = torch.rand(4, 9, 8, 8, generator=generator), torch.zeros(4, 16, 8, 8)
    field[:, :, 2:5, 2:5] = 0.7
    stages = [(torch.randn(4, 9, 8, 8, generator=generator), 0.1 * field) for _ in range(2)]
    stages[0][0].requires_grad_()
    images = loss.per_image(stages, belief, field)
    assert images.shape == (4,)
    assert not images.requires_grad
    assert images.mean().item() == pytest.approx(loss(stages, belief, field)[0].item(), rel=1e-5)


def test_an_image_is_charged_for_itself_alone() -> None:
    belief, field = torch.rand(3, 9, 8, 8), torch.ones(3, 16, 8, 8)
    wrong = belief.clone()
    wrong[1] += 0.5
    assert MapMSE().per_image([(wrong, field)], belief, field).tolist() == pytest.approx(
        [0, 0.25, 0]
    )
