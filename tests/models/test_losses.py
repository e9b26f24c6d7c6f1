import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from dopepp.models.layers import find_activation
from dopepp.models.losses import MapMSE, SpatialCrossEntropy

SIGMA = 1.5
# Finite logit of an empty belief, far below the float32 resolution of any sum.
NOTHING = -60.0


def gaussian(x, y):
    grid = torch.arange(16, dtype=torch.float32)
    squared = (grid[None, :] - x) ** 2 + (grid[:, None] - y) ** 2
    return torch.exp(-squared / (2 * SIGMA**2))


def targets(num_objects=1):
    belief = torch.stack([gaussian(3 + c % 9, 12 - c % 9) for c in range(9 * num_objects)])[None]
    field = torch.zeros(1, 16 * num_objects, 16, 16)
    field[:, 0::2, 4:7, 4:7] = 0.6
    field[:, 1::2, 4:7, 4:7] = -0.8
    return belief, field


def test_perfect_maps_cost_nothing():
    belief, field = targets(2)
    total, parts = MapMSE()([(belief, field)], belief, field)
    assert total == 0
    assert parts.keys() == {"belief", "field"}
    logits = belief.clamp(min=math.exp(NOTHING)).log()
    total, parts = SpatialCrossEntropy(SIGMA)([(logits, field)], belief, field)
    assert abs(total.item()) < 1e-5
    assert parts.keys() == {"where", "count", "field"}
    assert not any(part.requires_grad for part in parts.values())


def test_mse_is_the_sum_over_stages_of_both_errors():
    belief, field = targets()
    stages = [(belief + 0.5, field - 0.1), (belief - 0.2, field)]
    total, parts = MapMSE()(stages, belief, field)
    assert float(parts["belief"]) == pytest.approx(0.25 + 0.04)
    assert float(parts["field"]) == pytest.approx(0.01)
    assert total.item() == pytest.approx(0.30)


@given(st.integers(0, 1000), st.floats(0, 15), st.floats(0, 15), st.floats(-8, 0), st.booleans())
def test_terms_are_the_poisson_divergence(seed, x, y, level, second):
    """The sum of Σ e^z − g·z − g + g·log g over the cells, in Gaussians, is where + count."""
    generator = torch.Generator().manual_seed(seed)
    target = gaussian(x, y)
    if second:
        target = torch.maximum(target, gaussian(15 - x, y))
    logits = level + torch.randn(16, 16, generator=generator)
    z, g = logits.double(), target.double()
    expected = (z.exp() - g * z - g + torch.xlogy(g, g)).sum() / (2 * math.pi * SIGMA**2)
    mass = z.exp().sum() / (2 * math.pi * SIGMA**2)
    field = torch.zeros(1, 16, 16, 16)
    _, parts = SpatialCrossEntropy(SIGMA)([(logits[None, None], field)], target[None, None], field)
    result = float(parts["where"] + parts["count"])
    if mass < math.e**2:
        assert result == pytest.approx(float(expected), rel=1e-3, abs=1e-4)
    else:  # the exponential continues as its tangent
        assert result <= float(expected) + 1e-3


def test_an_absent_keypoint_costs_the_predicted_mass():
    nothing, field = torch.zeros(1, 9, 16, 16), torch.zeros(1, 16, 16, 16)
    logits = torch.full((1, 9, 16, 16), math.log(0.01))
    loss = SpatialCrossEntropy(SIGMA, count_weight=2.0)
    _, parts = loss([(logits, field)], nothing, field)
    assert float(parts["where"]) == 0
    expected = 2.0 * 0.01 * 256 / (2 * math.pi * SIGMA**2)
    assert float(parts["count"]) == pytest.approx(expected, rel=1e-5)
    total, _ = loss([(torch.full_like(logits, NOTHING), field)], nothing, field)
    assert total.item() < 1e-6


@pytest.mark.parametrize("value", [-1e4, -200.0, 50.0, 1e4])
def test_gradients_stay_bounded_for_wild_logits(value):
    belief, field = targets()
    belief[:, 4] = 0
    logits = torch.full((1, 9, 16, 16), value, requires_grad=True)
    total, _ = SpatialCrossEntropy(SIGMA)([(logits, field)], belief, field)
    total.backward()
    assert torch.isfinite(total)
    assert torch.isfinite(logits.grad).all()
    assert logits.grad.sum((2, 3)).abs().max() < 10 / 9 * math.e**2


def test_training_leaves_the_plateau_within_a_few_steps():
    belief, field = targets()
    start = torch.full((1, 9, 16, 16), find_activation("exp").initial_logit)
    logits = start.clone().requires_grad_()
    optimizer = torch.optim.SGD([logits], lr=20.0)
    for _ in range(50):
        optimizer.zero_grad()
        SpatialCrossEntropy(SIGMA)([(logits, field)], belief, field)[0].backward()
        optimizer.step()
    activated = find_activation("exp")(logits.detach()).flatten(2)
    assert torch.equal(activated.argmax(-1), belief.flatten(2).argmax(-1))
    assert activated.amax(-1).min() > 0.5


def test_field_error_counts_only_inside_the_discs():
    belief, target = targets()
    inside = (target != 0).float()
    logits = belief.clamp(min=math.exp(NOTHING)).log()
    loss = SpatialCrossEntropy(SIGMA, field_weight=3.0)
    _, parts = loss([(logits, target + 0.2)], belief, target)
    # Smooth L1 of 0.2 is 0.02, twice per vector; the cells outside are off by 0.2 as well.
    assert float(parts["field"]) == pytest.approx(3.0 * 0.04, rel=1e-4)
    _, parts = SpatialCrossEntropy(SIGMA)([(logits, target + 10 * (1 - inside))], belief, target)
    assert float(parts["field"]) == 0
    _, parts = SpatialCrossEntropy(SIGMA)([(belief, target)], belief, torch.zeros_like(target))
    assert float(parts["field"]) == 0  # without discs


@pytest.mark.parametrize("loss", [MapMSE(), SpatialCrossEntropy(SIGMA)])
def test_terms_are_float32_under_autocast_and_stages_add_up(loss):
    belief, field = targets()
    stage = (belief.bfloat16().requires_grad_(), field.bfloat16())
    with torch.autocast("cpu", torch.bfloat16):
        first, _ = loss([stage], belief, field)
        two, parts = loss([stage, stage], belief, field)
    assert first.dtype == torch.float32
    assert two.item() == pytest.approx(2 * first.item())
    assert two.item() == pytest.approx(sum(float(part) for part in parts.values()))
    two.backward()


@pytest.mark.parametrize("loss", [MapMSE(), SpatialCrossEntropy(1.0, field_weight=0.2)])
def test_the_loss_of_an_image_does_not_depend_on_the_other_images(loss):
    generator = torch.Generator().manual_seed(3)
    belief, field = torch.rand(4, 9, 8, 8, generator=generator), torch.zeros(4, 16, 8, 8)
    field[:, :, 2:5, 2:5] = 0.7
    field[1, 4:], field[2] = 0, 0  # fewer discs, no disc
    stages = [(torch.randn(4, 9, 8, 8, generator=generator), 0.1 * field) for _ in range(2)]
    stages[0][0].requires_grad_()
    calls = []
    with loss.register_forward_hook(lambda *_: calls.append(1)):  # as job=lr_finder does
        images = loss.per_image(stages, belief, field)
    assert not calls
    assert (images.shape, images.requires_grad) == ((4,), False)
    for k, alone in enumerate(images):
        maps = [tuple(item[k : k + 1] for item in pair) for pair in (*stages, (belief, field))]
        assert alone.item() == pytest.approx(loss(maps[:2], *maps[2])[0].item(), rel=1e-5)
