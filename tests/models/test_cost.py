import pytest
import torch
from torch import nn

from dopepp.models.network import network_cost
from dopepp.models.spec import build_network


def macs_by_hooks(network: nn.Module, images: torch.Tensor) -> int:
    """Count by running: every output value of a layer takes one filter's worth of products."""
    total = 0

    def count(layer: nn.Module, _: object, output: torch.Tensor) -> None:
        nonlocal total
        total += output.numel() * layer.weight[0].numel()

    for layer in network.modules():
        if isinstance(layer, (nn.Conv2d, nn.Linear)):
            layer.register_forward_hook(count)
    with torch.no_grad():
        network(images)
    return total


@pytest.mark.parametrize("attention", ["Identity", "SE", "CBAM"])
@pytest.mark.parametrize("head", ["Cascade", "MultiScale"])
def test_agrees_with_counting_by_hooks(make_spec, attention, head):
    spec = make_spec(attention=attention, head=head, backbone_width=0.125, head_width=0.125)
    network = build_network(spec).eval()
    _, gmacs = network_cost(network, (96, 64))
    assert gmacs * 1e9 == pytest.approx(macs_by_hooks(network, torch.zeros(1, 3, 64, 96)))


def test_most_of_dopes_compute_is_in_its_stages(make_spec):
    network = build_network(make_spec("VGG19", "Identity", "Cascade", "identity"))
    num_parameters, gmacs = network_cost(network, (416, 416))
    assert num_parameters == 50_267_350
    lighter = build_network(make_spec("DSC", "Identity", "Cascade", "identity"))
    _, backbone_swapped = network_cost(lighter, (416, 416))
    # The design: 69 % in the stages. Six stages of parameters, each used once per 52×52 cell.
    stages = sum(p.numel() for p in network.head.parameters() if p.ndim == 4) * 52 * 52 / 1e9
    assert stages / gmacs == pytest.approx(0.69, abs=0.01)
    assert backbone_swapped < gmacs


def test_leaves_the_network_as_it_was(small_spec):
    network = build_network(small_spec).train()
    network.attention.eval()
    before = {name: value.clone() for name, value in network.state_dict().items()}
    network_cost(network, (32, 32))
    assert network.training
    assert not network.attention.training
    assert all(parameter.device.type == "cpu" for parameter in network.parameters())
    for name, value in network.state_dict().items():
        assert torch.equal(value, before[name])
