import math

import pytest
import torch
from torch import nn

from dopepp.core.errors import UserError
from dopepp.models.heads import Cascade, MultiScale, SharedTrunk
from dopepp.models.layers import find_activation
from dopepp.models.network import build_network, network_cost
from tests.models.conftest import assert_weights, weights_of


def num_parameters(module):
    return sum(parameter.numel() for parameter in module.parameters())


@pytest.mark.parametrize("backbone", ["VGG19", "DSC", "Pyramid", "EfficientNetLite"])
@pytest.mark.parametrize("attention", ["Identity", "SE", "CBAM"])
@pytest.mark.parametrize("head", ["Cascade", "MultiScale", "SharedTrunk"])
@pytest.mark.parametrize("num_objects", [1, 2])
def test_every_combination_gives_stages_of_the_right_shape(
    make_spec, backbone, attention, head, num_objects
):
    num_stages = 1 if head == "SharedTrunk" else 2
    options = {"backbone_width": 0.125, "head_width": 0.125, "num_objects": num_objects}
    options |= {"head_stages": 2, "head_batch_norm": True} if num_stages == 2 else {}
    spec = make_spec(backbone, attention, head, **options)
    network = build_network(spec).eval()
    images = torch.randint(0, 256, (2, 3, 32, 64), dtype=torch.uint8)
    stages = network(images)
    assert len(stages) == num_stages
    for maps in stages:
        assert [part.shape for part in maps] == [(2, n * num_objects, 4, 8) for n in (9, 16)]
        assert all(part.isfinite().all() for part in maps)
    torch.testing.assert_close(stages[0], network(images.float())[0], rtol=0, atol=0)


@pytest.mark.parametrize(
    ("backbone", "head"),
    [("Pyramid", "SharedTrunk"), ("EfficientNetLite", "SharedTrunk"), ("DSC", "MultiScale"),
     ("VGG19", "Cascade")],
)  # fmt: skip
def test_the_copy_for_inference_gives_the_same_maps_without_batch_norm(make_spec, backbone, head):
    options = {"backbone_width": 0.125, "head_width": 0.125}
    options |= {} if head == "SharedTrunk" else {"head_batch_norm": True}
    network = build_network(make_spec(backbone, "CBAM", head, **options)).double()
    images = torch.randint(0, 256, (2, 3, 64, 64), dtype=torch.uint8)
    for norm in (module for module in network.modules() if isinstance(module, nn.BatchNorm2d)):
        for values, least in ((norm.running_var, 0.2), (norm.weight, 0.5), (norm.bias, -0.5)):
            nn.init.uniform_(values, least, least + 1)
        nn.init.normal_(norm.running_mean)
    before = weights_of(network)
    folded = network.for_inference()
    assert network.training
    assert_weights(network, before)
    assert not any(isinstance(layer, nn.BatchNorm2d) for layer in folded.modules())
    with torch.inference_mode():
        torch.testing.assert_close(folded(images)[-1], network.eval()(images)[-1])


@pytest.mark.parametrize("stages", [1, 2])
def test_every_scale_of_a_multi_scale_stage_has_its_own_maps(make_spec, stages):
    head = {"head_width": 0.125, "head_stages": stages, "head_batch_norm": True}
    network = build_network(make_spec(backbone_width=0.125, **head, head_maps="learned"))
    outputs = network(torch.randint(0, 256, (2, 3, 64, 96), dtype=torch.uint8))
    assert len(outputs) == 4 * stages  # a quarter, a half, full scale, fused
    for number, (belief, field) in enumerate(outputs):
        assert belief.shape == (2, 9, 8, 12)
        assert field.shape == (2, 16, 8, 12)
        # An untrained output is nearly the bias: an empty map.
        assert (network.activate(belief) - network.activate(belief.new_tensor(
            network.activate.initial_logit))).abs().max() < 0.1  # fmt: skip
        factor = (4, 2, 1, 1)[number % 4]
        coarse = belief[:, :, ::factor, ::factor]
        repeated = coarse.repeat_interleave(factor, 2).repeat_interleave(factor, 3)
        torch.testing.assert_close(belief, repeated)
    # The loss of the coarsest maps does not reach the fusion.
    outputs[0][0].sum().backward()
    branch = network.head.belief_branches[0]
    assert all(parameter.grad is None for parameter in network.head.field_branches.parameters())
    assert branch.down_quarter[-1].weight.grad is not None
    assert all(parameter.grad is None for parameter in branch.up_quarter.parameters())


@pytest.mark.parametrize(("options", "count"), [
    *(({"head_batch_norm": True, "head_maps": maps}, count) for maps, count in (
        (None, 6_573_419), ("plain", 5_152_694), ("learned", 5_152_694),
    )),
    # conf/model/dopepp_fast.yaml: 2.65 million at the quickstart's width.
    ({"backbone": "Pyramid", "attention": "Identity", "head": "SharedTrunk",
      "backbone_width": 0.5, "head_width": 0.5}, 2_645_305),
], ids=str)  # fmt: skip
def test_numbers_of_parameters(make_spec, options, count):
    assert num_parameters(build_network(make_spec(**options))) == count


def test_normalisation_is_imagenets_and_not_in_the_checkpoint(small_spec):
    network = build_network(small_spec)
    inputs_of_layer = []
    network.backbone.register_forward_pre_hook(lambda _, inputs: inputs_of_layer.append(inputs[0]))
    images = torch.randint(0, 256, (1, 3, 32, 32), dtype=torch.uint8)
    network.eval()(images)
    mean = torch.tensor([0.485, 0.456, 0.406])[:, None, None]
    std = torch.tensor([0.229, 0.224, 0.225])[:, None, None]
    torch.testing.assert_close(inputs_of_layer[0], (images / 255 - mean) / std)
    assert not {"mean", "std"} & network.state_dict().keys()


@pytest.mark.parametrize("spec", ["small_spec", "small_fast_spec"])
def test_channels_last_and_bf16_give_the_same_maps(request, spec):
    torch.manual_seed(0)
    network = build_network(request.getfixturevalue(spec)).eval()
    images = torch.randint(0, 256, (2, 3, 64, 64), dtype=torch.uint8)
    with torch.no_grad():
        expected = network.maps(images)[0]
        network = network.to(memory_format=torch.channels_last)
        images = images.to(memory_format=torch.channels_last)
        torch.testing.assert_close(network.maps(images)[0], expected)
        with torch.autocast("cpu", torch.bfloat16):
            belief = network.maps(images)[0]
    assert belief.dtype == torch.float32
    torch.testing.assert_close(belief, expected, atol=5e-3, rtol=0.1)


@pytest.mark.parametrize(
    "shape", [(1, 3, 40, 32), (1, 3, 32, 33), (1, 1, 32, 32), (1, 4, 32, 32), (3, 32, 32)]
)
def test_images_of_another_shape_are_refused(small_spec, shape):
    with pytest.raises(UserError, match=r"images of shape .* multiples of 32; fix: pad"):
        build_network(small_spec)(torch.zeros(shape))


@pytest.mark.parametrize("head", ["Cascade", "SharedTrunk"])
def test_sizes_are_multiples_of_the_backbones_and_the_heads(make_spec, head):
    widths = {"backbone_width": 0.125, "head_width": 0.125}
    network = build_network(make_spec(head=head, **widths)).eval()
    assert network.size_multiple == 8
    assert network(torch.zeros(1, 3, 40, 24))[-1][0].shape == (1, 9, 5, 3)
    network = build_network(make_spec("Pyramid", head=head, **widths)).eval()
    with pytest.raises(UserError, match="multiples of 32; fix: pad"):
        network(torch.zeros(1, 3, 40, 32))


def test_activations():
    logits = torch.tensor([-30.0, math.log(0.25), 0.0, 3.0])
    expected = torch.tensor([math.exp(-30), 0.25, 1.0, 1.0])
    torch.testing.assert_close(find_activation("exp")(logits), expected)
    assert torch.equal(find_activation("identity")(logits), logits)
    assert find_activation("exp")(logits.bfloat16()).dtype == torch.float32


@pytest.mark.parametrize(("activation", "expected"), [("identity", 0.0), ("exp", 0.01)])
@pytest.mark.parametrize("kind", [Cascade, MultiScale, SharedTrunk])
def test_an_untrained_head_gives_nearly_empty_maps(kind, activation, expected):
    torch.manual_seed(0)
    head = kind(128, 1, activation, **{} if kind is SharedTrunk else {"stages": 2})
    with torch.no_grad():
        stages = head(torch.randn(2, 128, 16, 16).relu())
    for belief, field in stages:
        difference = find_activation(activation)(belief) - expected
        # Under exp a logit off by 1.5 is a factor of 4.5 on a belief of 0.01.
        assert difference.abs().max() < (1.5 if activation == "identity" else 0.05)
        assert field.abs().max() < 1.5


def test_later_stages_read_activated_beliefs_and_the_field():
    head = Cascade(8, 1, "exp", stages=2, width=0.0625)
    inputs_of_layer = []
    head.belief_branches[1].register_forward_pre_hook(
        lambda _, inputs: inputs_of_layer.append(inputs[0])
    )
    features = torch.randn(1, 8, 4, 4)
    belief, field = head(features)[0]
    expected = torch.cat([features, belief.clamp(max=0).exp(), field], dim=1)
    torch.testing.assert_close(inputs_of_layer[0], expected)


def test_multiscale_has_the_paper_convolutions():
    # Per branch at width 128, biases included: 11 convs 3×3 down, then three convsets of 3 1×1 and
    # 2 3×3 (two of them begin at 256 channels), two more 1×1, and the output.
    three, first = 9 * 128 * 128 + 128, 128 * 128 + 128
    down = 11 * three
    convset = 3 * first + 2 * three
    up = 3 * convset + 2 * first + 2 * 128 * 128  # two convsets read 256 channels
    expected = sum(down + up + outputs * 129 for outputs in (9, 16))
    assert num_parameters(MultiScale(128, 1)) == expected


def test_belief_and_field_share_only_the_trunk():
    head = SharedTrunk(8, 2, channels=24, blocks=2)
    belief, field = head(torch.randn(1, 8, 8, 8))[0]
    assert (belief.shape, field.shape) == ((1, 18, 8, 8), (1, 32, 8, 8))
    belief.sum().backward()
    assert all(parameter.grad is None for parameter in head.field_branches.parameters())
    for part in (head.trunk, head.belief_branches):
        assert all(parameter.grad is not None for parameter in part.parameters())
    # A block's convolutions, the first's shortcut; a 3×3 and a 1×1 of each branch.
    weights = 9 * (8 * 24 + 5 * 24 * 24) + 8 * 24 + 24 * (18 + 32)
    assert sum(p.numel() for p in head.parameters() if p.ndim == 4) == weights


@pytest.mark.parametrize("half", [False, True])
def test_a_gradient_reaches_every_parameter_of_the_fast_network(small_fast_spec, half):
    torch.manual_seed(0)
    network = build_network(small_fast_spec).to(memory_format=torch.channels_last).train()
    images = torch.randint(0, 256, (4, 3, 64, 96), dtype=torch.uint8)
    with torch.autocast("cpu", torch.bfloat16, enabled=half):
        (logits, field), *others = network(images)
    assert not others
    (network.activate(logits).float().square().sum() + field.float().square().sum()).backward()
    for name, parameter in network.named_parameters():
        assert parameter.dtype == torch.float32
        assert parameter.grad is not None, name
        assert parameter.grad.isfinite().all(), name
        assert parameter.grad.abs().max() > 0, name


def test_he_initialisation_keeps_the_scale_without_batch_norm(make_spec):
    torch.manual_seed(0)
    network = build_network(make_spec(attention="Identity"))
    features = []
    network.backbone.register_forward_hook(lambda *arguments: features.append(arguments[-1]))
    with torch.no_grad():
        network(torch.randint(0, 256, (2, 3, 64, 64), dtype=torch.uint8))
    assert 0.05 < features[0].std() < 20


def macs_by_hooks(network, images):
    """Count while running: an output value takes one product per weight of its filter."""
    products = []
    for layer in network.modules():
        if isinstance(layer, (nn.Conv2d, nn.Linear)):
            layer.register_forward_hook(
                lambda layer, _, out: products.append(out.numel() * layer.weight[0].numel())
            )
    with torch.no_grad():
        network(images)
    return sum(products)


@pytest.mark.parametrize("attention", ["Identity", "SE", "CBAM"])
@pytest.mark.parametrize(
    ("backbone", "head"), [("DSC", "Cascade"), ("DSC", "MultiScale"), ("Pyramid", "SharedTrunk")]
)
def test_the_cost_equals_a_count_by_hooks(make_spec, backbone, attention, head):
    spec = make_spec(backbone, attention, head, backbone_width=0.125, head_width=0.125)
    network = build_network(spec).eval()
    _, gmacs = network_cost(network, (96, 64))
    assert gmacs * 1e9 == pytest.approx(macs_by_hooks(network, torch.zeros(1, 3, 64, 96)))


def test_most_of_dopes_compute_is_in_its_stages(make_spec):
    network = build_network(make_spec("VGG19", "Identity", "Cascade", "identity"))
    num_parameters, gmacs = network_cost(network, (416, 416))
    assert num_parameters == 50_267_350
    lighter = build_network(make_spec("DSC", "Identity", "Cascade", "identity"))
    _, backbone_swapped = network_cost(lighter, (416, 416))
    # 69 % of the compute is in the stages, whose parameters are used once per 52×52 cell.
    stages = sum(p.numel() for p in network.head.parameters() if p.ndim == 4) * 52 * 52 / 1e9
    assert stages / gmacs == pytest.approx(0.69, abs=0.01)
    assert backbone_swapped < gmacs


def test_measuring_the_cost_does_not_change_the_network(small_spec):
    network = build_network(small_spec).train()
    network.attention.eval()
    before = weights_of(network)
    network_cost(network, (32, 32))
    assert (network.training, network.attention.training) == (True, False)
    assert_weights(network, before)
    assert all(parameter.device.type == "cpu" for parameter in network.parameters())
